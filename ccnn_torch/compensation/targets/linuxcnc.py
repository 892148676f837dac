"""A form and the nominal kinematics as a kinematics component of LinuxCNC: one file for `halcompile`."""

from __future__ import annotations

import torch
from torch import Tensor

from ccnn_torch.compensation.targets.c99 import c_compensation, c_constants, c_dialect, c_function
from ccnn_torch.compensation.targets.form import Form, Program
from ccnn_torch.compensation.targets.from_model import traced_program
from ccnn_torch.compensation.targets.printing import costs, filled, print_program, wrapped
from ccnn_torch.display import identifiers, plain, visible
from ccnn_torch.errors import MethodFailedError
from ccnn_torch.mechanisms import Mechanism, SerialArm

_ANGLES = ("a", "b", "c")


def print_linuxcnc(form: Form | None, mechanism: Mechanism, source: str) -> dict[str, str]:
    """Contents of the files by name.

    Args:
        form: of the compensation; None where the mechanism's own parameters are corrected.

    Raises:
        MethodFailedError: the mechanism has no direction in closed form, or the form is not in double.
    """
    if form is not None and form.dtype != "float64":
        raise MethodFailedError("linuxcnc computes in double; leave out --dtype float32")
    dialect, nominal = c_dialect("float64"), _closed_form(mechanism)
    text = print_program(nominal, dialect, {})
    serial = isinstance(mechanism, SerialArm)
    covariates = form.covariates if form else []
    names = identifiers([header.partition("[")[0] for header in covariates])
    pins = [(f"in_{name}", plain(header)) for name, header in zip(names, covariates, strict=True)]
    code = [c_constants(name, values, dialect) for name, values in text.tables.items()] + [c_function(nominal, text)]
    home = mechanism.home_joints if serial else mechanism.home_pose
    about = wrapped([f"Kinematics of {source}.", *(costs(form) if form else [])])
    component = filled(
        "ccnnkins.comp.jinja",
        about="\n".join(f" * {line}" for line in about),
        joints=len(mechanism.joints),
        covariates=max(len(covariates), 1),
        pins=pins,
        axes=wrapped([f"Axes: {_axes(mechanism)}."]),
        rows=len(mechanism.joints) if not serial else 6 if mechanism.orientation == "rotation_vector" else 3,
        found=12 if serial else len(mechanism.joints),
        units=["CCNN_UNITS_PER_METRE" if j.unit == "m" else "CCNN_DEGREES" for j in mechanism.joints],
        home=[dialect.literal(v) for v in home.tolist()],
        source=c_compensation(form, "static ") if form else "",
        nominal="\n\n".join(code).replace("table", "nominal_table"),
        serial=serial,
        vector=_is_vector(mechanism),
        fields=[] if serial or _is_vector(mechanism) else [(f, _unit(f)) for f in _fields(mechanism).values()],
    )
    readme = filled("linuxcnc.md.jinja", joints=len(mechanism.joints), axes=plain(_axes(mechanism)), pins=pins)
    return {"ccnnkins.comp": component, "README.md": readme}


def _closed_form(mechanism: Mechanism) -> Program:
    serial = isinstance(mechanism, SerialArm)
    example = (mechanism.home_joints if serial else mechanism.home_pose).unsqueeze(0)
    if not serial and len(mechanism.pose) != len(mechanism.joints):
        raise MethodFailedError(f"linuxcnc needs as many joints as pose coordinates; '{mechanism.name}' has others")

    def nominal(given: Tensor) -> Tensor:
        """Position and rotation of an arm at joints; joints of the others at a pose."""
        if not isinstance(mechanism, SerialArm):
            return mechanism.solve_inverse(given)
        position, rotation = mechanism.forward_frame(given)
        return torch.cat([position, rotation.flatten(-2)], -1)

    try:
        if type(mechanism).solve_inverse is Mechanism.solve_inverse:
            raise MethodFailedError("they are solved by iteration")
        return traced_program(nominal, (example,), "nominal", ("given",), ["found"])
    # What torch raises where a number decides how often something is done.
    except (MethodFailedError, RuntimeError) as reason:
        told = reason if isinstance(reason, MethodFailedError) else "they are solved by iteration"
        raise MethodFailedError(
            f"the inverse kinematics of '{mechanism.name}' are no closed form that linuxcnc could have ({told}); "
            "export the compensation alone as c99"
        ) from None


def _fields(mechanism: Mechanism) -> dict[str, str]:
    """Pose coordinate -> its part of LinuxCNC's pose: lengths by their names, angles in order.

    Raises:
        MethodFailedError: there is a length that is not x, y or z, or a fourth angle.
    """
    lengths = {c.name: f"tran.{c.name}" for c in mechanism.pose if c.unit == "m" and c.name in ("x", "y", "z")}
    angles = dict(zip([c.name for c in mechanism.pose if c.unit == "rad"], _ANGLES, strict=False))
    for c in mechanism.pose:
        if c.name not in lengths | angles:
            raise MethodFailedError(
                f"linuxcnc has lengths x, y, z [m] and three angles [rad]; '{mechanism.name}' has {visible(c.header)}"
            )
    return {c.name: (lengths | angles)[c.name] for c in mechanism.pose}


def _axes(mechanism: Mechanism) -> str:
    if isinstance(mechanism, SerialArm):
        if mechanism.orientation != "rotation_vector":
            return (
                "X, Y, Z alone, in the frame in which the machine was measured. Its records have no orientation: what "
                "A, B, C command is not followed, and what they show is that of the nominal arm"
            )
        return "X, Y, Z in the frame in which the machine was measured, A, B, C: roll, pitch, yaw"
    if _is_vector(mechanism):
        return "X, Y, Z, and A, B, C: roll, pitch, yaw of the platform"
    served = ", ".join(f"{field.removeprefix('tran.').upper()} = {n}" for n, field in _fields(mechanism).items())
    return f"{served}; others are not followed"


def _is_vector(mechanism: Mechanism) -> bool:
    return [c.name for c in mechanism.pose][-3:] == ["rx", "ry", "rz"]


def _unit(field: str) -> str:
    return "CCNN_UNITS_PER_METRE" if field.startswith("tran") else "CCNN_DEGREES"
