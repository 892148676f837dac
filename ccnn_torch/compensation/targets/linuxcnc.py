"""A form and the nominal kinematics as a kinematics component of LinuxCNC: one file for `halcompile`."""

from __future__ import annotations

import re
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ccnn_torch.compensation.targets.c99 import c_constants, c_dialect, c_function, print_c99
from ccnn_torch.compensation.targets.form import Form, Program
from ccnn_torch.compensation.targets.from_model import traced_program
from ccnn_torch.compensation.targets.golden import Golden
from ccnn_torch.compensation.targets.linuxcnc_text import COMPONENT, NOTHING, ONE_WAY, README, SERIAL_WAY, VECTOR
from ccnn_torch.compensation.targets.printing import costs, print_program, wrapped
from ccnn_torch.errors import MethodFailedError
from ccnn_torch.mechanisms import Mechanism, SerialArm

__all__ = ["print_linuxcnc"]

_ANGLES = ("a", "b", "c")


class _Nominal(nn.Module):
    """The closed direction of a mechanism: joints -> position and rotation of an arm, pose -> joints of the others."""

    def __init__(self, mechanism: Mechanism) -> None:
        super().__init__()
        # In a tuple, so that its buffers count as constants.
        self._mechanism = (mechanism,)

    def forward(self, given: Tensor) -> Tensor:
        (mechanism,) = self._mechanism
        if not isinstance(mechanism, SerialArm):
            return mechanism.solve_inverse(given)
        position, rotation = mechanism.forward_frame(given)
        return torch.cat([position, rotation.flatten(-2)], -1)


def print_linuxcnc(proven: tuple[Form, Golden] | None, mechanism: Mechanism, source: str) -> dict[str, str]:
    """Contents of the files by name.

    Args:
        proven: form and golden vectors of the compensation; None where the mechanism's own parameters are corrected.
        mechanism: whose kinematics are written.
        source: where the numbers came from.

    Raises:
        MethodFailedError: the mechanism has no direction in closed form, or the form is not in double.
    """
    form = proven[0] if proven else None
    if form is not None and form.dtype != "float64":
        raise MethodFailedError("linuxcnc computes in double; leave out --dtype float32")
    dialect, nominal = c_dialect("float64"), _closed_form(mechanism)
    text = print_program(nominal, dialect, {})
    n, serial = len(mechanism.joints), isinstance(mechanism, SerialArm)
    covariates = form.covariates if form else []
    m = len(covariates)
    code = [c_constants(name, values, dialect) for name, values in text.tables.items()] + [c_function(nominal, text)]
    home = mechanism.home_joints if serial else mechanism.home_pose
    rows = n if not serial else 3 if mechanism.orientation == "none" else 6
    values = {
        "@ABOUT@": "\n".join(
            f" * {line}" for line in wrapped([f"Kinematics of {source}.", *(costs(form) if form else [])])
        ),
        "@N@": str(n),
        "@K@": str(m),
        "@M@": str(max(m, 1)),
        "@P@": str(rows),
        "@UNITS@": ", ".join("CCNN_UNITS_PER_METRE" if j.unit == "m" else "CCNN_DEGREES" for j in mechanism.joints),
        "@HOME@": ", ".join(repr(v) for v in home.tolist()),
        "@PINS@": "".join(f'pin in float {_pin(h)} "{h}";\n' for h in covariates),
        "@READ@": "".join(f"    ccnn_covariates[{k}] = {_pin(h)};\n" for k, h in enumerate(covariates)),
        "@UNREAD@": ", ".join(["NAN"] * max(m, 1)),
        "@SOURCE@": _compensation(*proven) if proven else NOTHING,
        "@NOMINAL@": "\n\n".join(code).replace("table", "nominal_table"),
        "@WAYS@": SERIAL_WAY if serial else ONE_WAY + _world(mechanism),
    }
    found = COMPONENT
    for key, value in values.items():
        found = found.replace(key, value)
    return {"ccnnkins.comp": found, "README.md": README.format(count=n, axes=_axes(mechanism))}


def _compensation(form: Form, golden: Golden) -> str:
    """The C source with its functions static."""
    source = print_c99(form, golden)["compensator.c"].partition("#include <stddef.h>\n")[2]
    return re.sub(r"^int ccnn_", "static int ccnn_", source, flags=re.MULTILINE)


def _pin(header: str) -> str:
    return "in_" + header.partition("[")[0]


def _closed_form(mechanism: Mechanism) -> Program:
    serial = isinstance(mechanism, SerialArm)
    example = (mechanism.home_joints if serial else mechanism.home_pose).unsqueeze(0)
    if not serial and len(mechanism.pose) != len(mechanism.joints):
        raise MethodFailedError(f"linuxcnc needs as many joints as pose coordinates; '{mechanism.name}' has others")
    try:
        if type(mechanism).solve_inverse is Mechanism.solve_inverse:
            raise MethodFailedError("they are solved by iteration")
        return traced_program(_Nominal(mechanism), (example,), "nominal", ("given",), ["found"])
    # What torch raises where a number decides how often something is done.
    except (MethodFailedError, RuntimeError) as reason:
        told = reason if isinstance(reason, MethodFailedError) else "they are solved by iteration"
        raise MethodFailedError(
            f"the inverse kinematics of '{mechanism.name}' are no closed form that linuxcnc could have ({told}); "
            "export the compensation alone as c99"
        ) from None


def _fields(mechanism: Mechanism) -> dict[str, str]:
    """Pose coordinate -> its part of LinuxCNC's pose: lengths by their names, angles in order."""
    names = [c.name for c in mechanism.pose]
    angles = iter(_ANGLES)
    return {n: f"tran.{n}" if n in ("x", "y", "z") else next(angles) for n in names}


def _axes(mechanism: Mechanism) -> str:
    if isinstance(mechanism, SerialArm):
        return "X, Y, Z in the frame in which the machine was measured" + (
            ", A, B, C: roll, pitch, yaw" if mechanism.orientation != "none" else ""
        )
    if _is_vector(mechanism):
        return "X, Y, Z, and A, B, C: roll, pitch, yaw of the platform"
    return ", ".join(f"{field.removeprefix('tran.').upper()} = {name}" for name, field in _fields(mechanism).items())


def _is_vector(mechanism: Mechanism) -> bool:
    return [c.name for c in mechanism.pose][-3:] == ["rx", "ry", "rz"]


def _world(mechanism: Mechanism) -> str:
    """From LinuxCNC's pose to the mechanism's, and back."""
    if _is_vector(mechanism):
        return VECTOR
    there: Sequence[str] = [
        f"    pose[{k}] = world->{field} / {_unit(field)};" for k, field in enumerate(_fields(mechanism).values())
    ]
    back = [f"    world->{field} = pose[{k}] * {_unit(field)};" for k, field in enumerate(_fields(mechanism).values())]
    parts = (
        ("static void ccnn_from_world(const EmcPose *world, double pose[])", there),
        (
            "static void ccnn_to_world(const double pose[], EmcPose *world)",
            back,
        ),
    )
    return "\n".join("\n".join([head, "{", *lines, "}", ""]) for head, lines in parts)


def _unit(field: str) -> str:
    return "CCNN_UNITS_PER_METRE" if field.startswith("tran") else "CCNN_DEGREES"
