"""Mechanisms by name, by file and from a description."""

import json
import math
import re

import pytest
import torch
from catalogue import FIVE_BAR, NAMES, UR10, make
from five_bar import FiveBar

from ccnn_torch.errors import InputError
from ccnn_torch.files.yaml_file import parse_yaml
from ccnn_torch.mechanisms import Tripod, load_mechanism, mechanism_from_description


def test_by_name_with_keys():
    assert load_mechanism("tripod", L=1.2).nominal.tolist() == [1.2, 0.3]
    with pytest.raises(InputError, match="did you mean 'tripod'"):
        load_mechanism("tripot")
    with pytest.raises(InputError, match="known: tripod, machine_tool, five_bar"):
        load_mechanism("xyz")
    with pytest.raises(InputError, match="'radius'; it takes L, r"):
        load_mechanism("tripod", radius=3)


def test_keys_with_units():
    bar = load_mechanism("five_bar", l="220 mm", L="0.28", a=0.08)
    assert bar.nominal[:3].tolist() == [0.22, 0.28, -0.08]
    assert torch.equal(mechanism_from_description(bar.describe()).nominal, bar.nominal)
    assert load_mechanism("delta_linear", lean="2 deg").nominal[2] == math.radians(2)
    for value in ("long", [0.2], None):
        with pytest.raises(InputError, match=r"mechanism 'five_bar': l: '.*' is no number with a unit"):
            load_mechanism("framed", mechanism="five_bar", keys={"l": value})
    with pytest.raises(InputError, match="mechanism 'five_bar': l is in 'deg', an angle, but must be a length"):
        load_mechanism("five_bar", l="220 deg")


@pytest.mark.parametrize("name", ["framed", "partial", "instrument", "pair", "machine"])
def test_a_mechanism_around_another_says_what_to_write(name, tmp_path, monkeypatch):
    with pytest.raises(InputError, match=f"'{name}': needs .*; write e.g. mechanism_keys: {{.*}} into the") as refused:
        load_mechanism(name)
    monkeypatch.chdir(tmp_path)
    for file in ("my_arm", "left", "right"):
        (tmp_path / f"{file}.yaml").write_text(re.sub(r"unknown[^\n]*", "identity", UR10))
    said = str(refused.value)
    keys = parse_yaml(said[said.index("{") : said.rindex("}") + 1], "said")
    assert len(load_mechanism(name, **keys).geometry) > 9


def test_users_file(tmp_path):
    assert load_mechanism(f"{FIVE_BAR}:FiveBar", crank=0.45).nominal.tolist() == [0.25, 0.45, 0.6]
    with pytest.raises(InputError, match="has no class 'SixBar'; it has FiveBar"):
        load_mechanism(f"{FIVE_BAR}:SixBar")
    with pytest.raises(InputError, match="there is no file"):
        load_mechanism("nowhere.py:Thing")
    broken = tmp_path / "broken.py"
    broken.write_text("def f(:\n")
    with pytest.raises(InputError, match=r"broken.py line 1 is no valid Python"):
        load_mechanism(f"{broken}:f")
    broken.write_text("import no_such_module_at_all\n")
    with pytest.raises(InputError, match="imports something that is not installed"):
        load_mechanism(f"{broken}:f")
    broken.write_text("class Thing:\n    pass\n")
    with pytest.raises(InputError, match="derive the class from"):
        load_mechanism(f"{broken}:Thing")


@pytest.mark.parametrize("name", NAMES)
def test_description_is_json_and_exact(name, tmp_path):
    original = make(name, tmp_path)
    shifted = original.with_nominal(original.nominal + torch.tensor(1 / 3, dtype=torch.float64))
    for mechanism in (original, shifted):
        description = json.loads(json.dumps(mechanism.describe()))
        twin = mechanism_from_description(description, allow_code=True)
        assert torch.equal(twin.nominal, mechanism.nominal) and type(twin).__name__ == type(mechanism).__name__
        assert twin.describe() == mechanism.describe()


def test_an_arms_description_needs_no_file(tmp_path):
    path = tmp_path / "arm.yaml"
    path.write_text(UR10)
    description = load_mechanism(str(path), orientation="none").describe()
    path.unlink()
    twin = mechanism_from_description(description)
    assert twin.orientation == "none" and twin.unknown_frames == ("base", "tool")


def test_faulty_descriptions(tmp_path):
    with pytest.raises(InputError, match="lacks 'spec'"):
        mechanism_from_description({})
    description = load_mechanism("tripod").describe()
    with pytest.raises(InputError, match="check radius"):
        mechanism_from_description({**description, "parameters": {"L": 1.0, "r": 0.3, "radius": 1.0}})


def test_a_copy_leaves_the_hooks_behind():
    tripod = load_mechanism("tripod")
    tripod.inverse_kinematics.register_forward_hook(lambda module, args, output: output + 1)
    twin = tripod.with_nominal(tripod.nominal * 1.01)
    pose = tripod.home_pose
    torch.testing.assert_close(tripod.inverse_kinematics(pose), tripod.solve_inverse(pose) + 1)
    assert torch.equal(twin.inverse_kinematics(pose), twin.solve_inverse(pose))
    assert not torch.equal(twin.solve_inverse(pose), tripod.solve_inverse(pose))


def test_a_directly_made_mechanism_describes_itself():
    assert Tripod(L=1.1).describe()["spec"] == "tripod"
    bar = FiveBar(crank=0.45)
    twin = mechanism_from_description(json.loads(json.dumps(bar.describe())), allow_code=True)
    assert torch.equal(twin.nominal, bar.nominal)
    homeless = type("Homeless", (FiveBar,), {"__module__": "__nowhere__"})()
    with pytest.raises(InputError, match="Homeless is not defined in a file"):
        homeless.describe()


def test_a_fitted_base_moves_the_box(tmp_path):
    arm = make("ur10", tmp_path)
    moved = arm.nominal.clone()
    moved[:3] = 10.0
    twin = arm.with_nominal(moved)
    torch.testing.assert_close(twin.bounds[0][:3], arm.bounds[0][:3] + 10.0)
    torch.testing.assert_close(twin.home_pose[:3], arm.home_pose[:3] + 10.0)


def _users_class(tmp_path, **changed):
    """A sliding point on a line, with one part changed; solve_inverse alone, the rest numerical."""
    parts = {
        "joints": '[Coordinate("q1", "m")]',
        "pose": '[Coordinate("x", "m")]',
        "geometry": '[Parameter("d", "m", 0.1, 1)]',
        "box": "(0.0,), (1.0,)",
        "call": "super().__init__",
        "inverse": "pose - self.resolve(parameters)",
        "extra": "",
    }
    parts.update(changed)
    path = tmp_path / "own.py"
    path.write_text(
        "import torch\n"
        "from ccnn_torch.coordinates import Coordinate, Parameter\n"
        "from ccnn_torch.mechanisms import Mechanism\n\n\n"
        "class Slide(Mechanism):\n"
        "    def __init__(self):\n"
        f"        {parts['call']}('slide', {parts['joints']}, {parts['pose']}, {parts['geometry']}, {parts['box']})\n\n"
        "    def solve_inverse(self, pose, parameters=None, guess=None):\n"
        f"        return {parts['inverse']}\n"
        f"{parts['extra']}"
    )
    return f"{path}:Slide"


_CLOSURE = "\n    def closure(self, pose, joints, parameters=None):\n        return {}\n"
_FORWARD = "\n    def forward_kinematics(self, joints, parameters=None, guess=None):\n        return {}\n"


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"joints": '[Coordinate("a", "m")]'}, r"its joints must be named q1, not \['a'\]"),
        ({"pose": '[Coordinate("x", "mm")]'}, r"in m or rad, not x\[mm\]"),
        (
            {
                "geometry": '[Parameter("d", "m", 0.1), Parameter("d", "m", 0.1)]',
                "inverse": "pose - self.resolve(parameters)[..., :1]",
            },
            "its geometry has the name 'd' twice",
        ),
        ({"geometry": '[Parameter("d", "m", 0.1, 3)]'}, "'d' belongs to leg 3; legs are numbered from 1 to 1"),
        ({"box": "(1.0,), (0.0,)"}, "low and high need 1 numbers each, low below high"),
        ({"call": "len"}, "own.py:Slide: fails at line 8: TypeError"),
        ({"inverse": "pose - self.nominal"}, r"gives shape \(3, 1\) for 3 poses and 2 sets of parameters"),
        (
            {"inverse": "pose - self.resolve(parameters).length"},
            "own.py:Slide: fails at line 11: AttributeError: .* no attribute",
        ),
        ({"inverse": "torch.sqrt(self.resolve(parameters) - 1 - pose)"}, "its home pose has no joints"),
        ({"inverse": "(pose - self.resolve(parameters)).float()"}, "gives torch.float32, expected torch.float64"),
        ({"extra": _CLOSURE.format("pose + joints")}, "closure is .* expected 0"),
        ({"extra": _CLOSURE.format("(pose - joints).sum()")}, r"closure returned shape \(\) for 2 x 3"),
        ({"extra": _CLOSURE.format("(pose - joints)[..., 0]")}, r"returned shape \(2, 3\) .* expected \(2, 3, N\)"),
        ({"extra": _CLOSURE.format("[pose - joints]")}, r"closure returned a list .* stack them along the last dim"),
        ({"extra": _FORWARD.format("joints")}, "misses it by 0.1"),
        ({"extra": _FORWARD.format("self.home_pose")}, r"forward_kinematics gives shape \(1,\)"),
    ],
)
def test_a_users_mechanism_that_breaks_the_protocol(tmp_path, changed, sentence):
    with pytest.raises(InputError, match=sentence) as caught:
        load_mechanism(_users_class(tmp_path, **changed))
    assert "\n" not in str(caught.value)


def test_a_users_mechanism_that_keeps_the_protocol(tmp_path):
    slide = load_mechanism(_users_class(tmp_path))
    assert slide.solve_inverse(slide.home_pose).tolist() == [0.4]
