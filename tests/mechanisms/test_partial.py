"""A machine of whose pose an instrument shows a part: causes act on all of it, and show in what is measured."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from arm_text import arm_text
from torch import Tensor

from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.effects import Effect, Situation, default_gravity, make_effect
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Mechanism, Partial, as_measured, load_mechanism, mechanism_from_description
from ccnn_torch.records import load_records, write_table

NONE = torch.zeros(0, dtype=torch.float64)


def _columns(effect: Effect, rows: Situation) -> dict[str, Tensor]:
    """Change of the frame by each coefficient, `s x c`."""
    basis = effect.basis(rows, NONE)
    by = {"joints": lambda: rows.jacobian @ basis, "parameters": lambda: rows.parameter_jacobian @ basis}
    changed = by.get(effect.kind, lambda: basis)()
    return {c.name: changed[..., k] for k, c in enumerate(effect.coefficients(rows))}


@pytest.mark.parametrize("seen", [["x", "y", "z"], ["z"], ["rx", "rz"]])
def test_causes_of_a_machine_that_is_seen_in_part_are_those_of_the_whole_machine(seen: list[str]) -> None:
    """Weight, load and the lever of the tool act on what is not measured, too."""
    whole = load_mechanism("stewart")
    joints = whole.sample_joints(6, torch.Generator().manual_seed(1))
    loads = {f"load_{c.name}": torch.linspace(-3, 5, 6, dtype=torch.float64) for c in whole.pose}
    rows = [Situation(m, joints, loads, default_gravity(whole)) for m in (whole, Partial(whole, seen))]
    channels = [k for k, c in enumerate(whole.pose) if c.name in seen]
    for name in ("geometry", "tool", "frame", "gravity", "compliance", "joint_gain"):
        of_whole, of_part = (_columns(make_effect(name), own) for own in rows)
        assert of_part and set(of_part) <= set(of_whole), name
        for label, column in of_part.items():
            expected, size = of_whole[label][:, channels], float(of_whole[label].abs().max())
            if set(seen) & {"rx", "rz"} and whole.pose[0].name not in seen:
                # The rate of a rotation vector is not that of its entries: only small turns are alike.
                assert float((column[:, channels] - expected).abs().max()) < 0.4 * size, (name, label)
            else:
                torch.testing.assert_close(column[:, channels], expected, rtol=0, atol=1e-12 * size)


def test_joints_of_a_part_of_the_pose_are_the_nearest_and_the_description_builds_it_again() -> None:
    whole = load_mechanism("delta")
    part = Partial(whole, ["z"])
    joints = whole.sample_joints(5, torch.Generator().manual_seed(0))
    wanted = part.forward_kinematics(joints) + 2e-4
    found = part.nearest_joints(wanted, None, joints, 0.04)
    torch.testing.assert_close(part.forward_kinematics(found), wanted, rtol=0, atol=1e-10)
    slope = part.jacobian(joints)[:, 2]
    least = 2e-4 * slope.norm(dim=-1).reciprocal()
    assert float(((found - joints).norm(dim=-1) / least).max()) < 1.01
    again = mechanism_from_description(part.describe())
    torch.testing.assert_close(again.forward_kinematics(joints), part.forward_kinematics(joints), rtol=0, atol=0)
    with pytest.raises(InputError, match="no pose coordinate 'w'; it has x, y, z"):
        Partial(whole, ["w"])


def _file(folder: Path, machine: Mechanism, pose: dict[str, Tensor]) -> Path:
    joints = machine.sample_joints(12, torch.Generator().manual_seed(0))
    columns = {f"{j.name}[{j.unit}]": joints[:, k].numpy() for k, j in enumerate(machine.joints)}
    write_table(folder / "rows.csv", columns | {name: values.numpy() for name, values in pose.items()})
    return folder / "rows.csv"


def test_records_may_hold_a_part_of_the_pose_but_no_misspelt_column(tmp_path: Path) -> None:
    machine, z = load_mechanism("delta"), torch.linspace(-0.4, -0.3, 12, dtype=torch.float64)
    records = load_records(_file(tmp_path, machine, {"z[m]": z}), machine, learns=False)
    assert [c.name for c in records.pose_coordinates] == ["z"]
    assert any("only z was measured" in note for note in records.notes)
    measured = as_measured(machine, records.pose_coordinates)
    assert isinstance(measured, Partial) and [c.name for c in measured.pose] == ["z"]
    assert as_measured(machine, machine.pose) is machine
    misspelt = _file(tmp_path, machine, {"z[m]": z, "yy[m]": z, "x[m]": z})
    with pytest.raises(InputError, match="there is no column 'y'; 'yy' is the nearest there"):
        load_records(misspelt, machine, learns=False)
    arm = load_mechanism(str(Path(__file__).parents[2] / "experiments" / "data" / "ur10.yaml"))
    turns = {f"r{a}[rad]": 0.1 * z for a in "xyz"}
    # An angle is never proposed for a length.
    shown = load_records(_file(tmp_path, arm, turns), arm, learns=False)
    with pytest.raises(
        InputError, match=r"the base and the tool of .* are fitted to whole poses; give x, y, z as well"
    ):
        as_measured(arm, shown.pose_coordinates)


class Cables(Mechanism):
    """A point in the plane on four cables: no pose closes all loops exactly."""

    def __init__(self) -> None:
        places = [(-1.5, -1.0), (1.5, -1.0), (1.5, 1.0), (-1.5, 1.0)]
        named = [(f"A{'xy'[i]}{k + 1}", place[i], k) for k, place in enumerate(places) for i in (0, 1)]
        super().__init__(
            name="cables",
            joints=[Coordinate(f"q{k}", "m") for k in range(1, 5)],
            pose=[Coordinate("x", "m"), Coordinate("y", "m")],
            geometry=[Parameter(name, "m", value, k + 1) for name, value, k in named],
            low=(-0.9, -0.6),
            high=(0.9, 0.6),
            home_joints=[3.25**0.5] * 4,
        )

    def closure(self, pose: Tensor, joints: Tensor, parameters: Tensor | None = None) -> Tensor:
        values = self.resolve(parameters)
        places = values.reshape(*values.shape[:-1], 4, 2)
        length: Tensor = (pose[..., None, :] - places).norm(dim=-1)
        return length - joints


def test_more_drives_than_coordinates_have_the_pose_that_closes_best() -> None:
    machine = Cables()
    pose = machine.sample_workspace(6, torch.Generator().manual_seed(0))
    joints = machine.solve_inverse(pose)
    torch.testing.assert_close(machine.forward_kinematics(joints), pose, rtol=0, atol=1e-9)
    off = joints + 1e-4 * torch.tensor([1.0, -1.0, 1.0, 1.0], dtype=torch.float64)
    found = machine.forward_kinematics(off)
    slope = (found[:, None] - machine.nominal.reshape(4, 2)) / machine.closure(found, torch.zeros(4)).unsqueeze(-1)
    # Normal equations of least squares.
    torch.testing.assert_close(
        (slope.mT @ machine.closure(found, off)[..., None])[..., 0], torch.zeros_like(found), rtol=0, atol=1e-9
    )


def test_what_bends_and_gives_shows_in_wires_as_it_moves_the_hook(tmp_path: Path) -> None:
    """By the difference of distances themselves; a wire was once read as if its distance were the first coordinate."""
    (tmp_path / "arm.yaml").write_text(arm_text("base_frame: identity\ntool_frame: [0.03, 0, 0.12, 0, 0, 0]\n"))
    wires = load_mechanism("instrument", mechanism=str(tmp_path / "arm.yaml"), kind="wire", anchors=2, zero=0)
    own = [p.name for p in wires.geometry]
    values = dict(zip(own, wires.nominal.tolist(), strict=True))
    eyes = {"anchor1": (1.4, -0.8, 0.2), "anchor2": (1.2, 1.0, 0.1)}
    wires.set_parameters(values | {f"{n}_{a}": v for n, at in eyes.items() for a, v in zip("xyz", at, strict=True)})
    arm = load_mechanism(str(tmp_path / "arm.yaml"))
    joints = arm.sample_joints(8, torch.Generator().manual_seed(3))
    pull = {"load_z": torch.linspace(-80, -20, 8, dtype=torch.float64), "load_x": torch.full((8,), 7.0).double()}
    which = torch.tensor([1.0, 2] * 4, dtype=torch.float64)
    guess = torch.stack([torch.ones(8, dtype=torch.float64), which], -1)
    seen = Situation(wires, joints, pull, default_gravity(arm), guess=guess)
    whole = Situation(arm, joints, pull, default_gravity(arm))
    anchors = torch.tensor([eyes[f"anchor{int(n)}"] for n in which], dtype=torch.float64)
    for name in ("compliance", "bending", "gravity", "frame"):
        effect = make_effect(name)
        names = [c.name for c in effect.coefficients(seen)]
        assert names == [c.name for c in effect.coefficients(whole)], name
        shown = {n: moved for n, moved in _columns(effect, whole).items() if float(moved.abs().max()) > 1e-12}
        for label, moved in shown.items():
            there = arm.forward_kinematics(joints)[:, :3] - anchors
            step = 1e-6 / float(moved.abs().max())
            far = [torch.linalg.vector_norm(there + sign * step * moved[:, :3], dim=-1) for sign in (1, -1)]
            expected = (far[0] - far[1]) / (2 * step)
            found = _columns(effect, seen)[label][:, 0]
            torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-7 * float(moved.abs().max()), msg=label)


def test_a_part_has_the_numbers_of_its_machine_and_not_those_of_the_drawing() -> None:
    """Rows of y and z alone were off by millimetres of a machine whose base frame had been fitted."""
    framed = load_mechanism("framed", mechanism="delta", base=True)
    fitted = framed.with_nominal(framed.nominal + 1e-3)
    joints = framed.sample_joints(4, torch.Generator().manual_seed(0))
    part = Partial(fitted, ["y", "z"])
    torch.testing.assert_close(part.nominal, fitted.nominal, rtol=0, atol=0)
    torch.testing.assert_close(part.forward_kinematics(joints, part.nominal), part.forward_kinematics(joints))
