"""Constant errors of frames, tool, measuring device and parameters."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.coordinates import plausible_error
from ccnn_torch.effects.columns import (
    TWIST,
    caused_by,
    inside,
    own_parameters,
    parameter_columns,
    shown_columns,
    twist_columns,
)
from ccnn_torch.effects.protocol import Coefficient, Effect
from ccnn_torch.effects.situation import Situation, where_moved
from ccnn_torch.mechanisms import Mechanism, Partial, Seen, SerialArm, sees_directions
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector

# Ten arc seconds and three [rad]: a tube that bends, and a tenth of what air at sea level refracts at 45°.
_TUBE, _TANGENT = 5e-5, 3e-5
# Sine of the elevation below which refraction is no tangent of the zenith distance any more.
_LOWEST = 0.05


class Flexure(Effect):
    """Δz = TF sin z + TX tan z towards the zenith, z = zenith distance: the terms of those names in TPOINT.

    The first is a tube that bends in proportion to what of its weight is across it; the second one that bends more, or
    refraction of the air that is corrected for too little.
    """

    name = "flexure"
    kind = "pose"
    description = "a tube that bends under its own weight, or refraction of the air"

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """A machine whose rows are directions."""
        return "" if sees_directions(mechanism) else "directions: unit vectors in x, y, z"

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """Of both laws, at the horizon and at 45°."""
        return Coefficient("TF", "rad", _TUBE), Coefficient("TX", "rad", _TANGENT)

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x 3 x 2`."""
        seen, up = torch.nn.functional.normalize(situation.platform[0], dim=-1), -situation.down
        high = (seen @ up)[..., None]
        rise = up - high * seen
        return torch.stack([rise, rise / high.clamp_min(_LOWEST)], -1)


_SCALE = {"m": 1e-3, "rad": 1e-3}


class Frame(Effect):
    """Δposition = t + ω x (position - middle of the workspace), Δrotation = ω, in the base frame."""

    name = "frame"
    kind = "pose"
    description = "the measuring device's frame: a shift and a turn of the whole machine against it"

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """A base frame that is known; an unknown one is fitted before anything else."""
        unknown = "base" in getattr(mechanism, "unknown_frames", ())
        return "a known base frame, which is fitted to the records here" if unknown else ""

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """As many of shift and turn as the pose shows."""
        return tuple(Coefficient(*TWIST[k], _SCALE[TWIST[k][1]]) for k in shown_columns(situation, frame_columns))

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x c x m`."""
        return frame_columns(situation)[..., shown_columns(situation, frame_columns)]


def frame_columns(situation: Situation) -> Tensor:
    """Shifts along and turns about the axes of the base frame, `... x s x c x 6`."""
    position = situation.platform[0]
    machine = inside(situation.mechanism)
    middle = machine.frame(machine.home_pose)[0]
    axes = torch.eye(3, dtype=position.dtype).expand(*position.shape, 3)
    return twist_columns(situation, position - middle, axes)


class Tool(Effect):
    """Δposition = R t, Δrotation = R ω: a shift and a turn in the platform's own axes R."""

    name = "tool"
    kind = "pose"
    description = "the measured point on the platform: a shift and a turn of the tool or target against it"

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """A platform that turns, and a tool frame that is known; an unknown one is fitted before anything else."""
        if "tool" in getattr(mechanism, "unknown_frames", ()):
            return "a known tool frame, which is fitted to the records here"
        if sees_directions(mechanism):
            return "positions: to directions a shift of the tool is an error of the last link"
        whole = inside(mechanism)
        if not isinstance(whole, SerialArm) and whole.frame(whole.home_pose)[1] is None:
            return "a platform that turns: on this one a shift of the tool is a shift of the frame"
        return ""

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """As many of shift and turn as the pose shows."""
        return tuple(Coefficient(*TWIST[k], _SCALE[TWIST[k][1]]) for k in shown_columns(situation, _tool_columns))

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x c x m`."""
        return _tool_columns(situation)[..., shown_columns(situation, _tool_columns)]


def _tool_columns(situation: Situation) -> Tensor:
    position, rotation = situation.platform
    axes = torch.eye(3, dtype=position.dtype).expand(*position.shape, 3) if rotation is None else rotation
    return twist_columns(situation, torch.zeros_like(position), axes)


_AXES = "xyz"
_PAIRS = ((0, 1), (0, 2), (1, 2))
_COEFFICIENTS = (
    *(Coefficient(f"scale {a}", "1", 3e-4) for a in _AXES),
    *(Coefficient(f"shear {_AXES[i]}{_AXES[j]}", "rad", 3e-4) for i, j in _PAIRS),
    *(Coefficient(f"lean {_AXES[i]}{_AXES[j]}", "rad", 1e-4, secondary=True) for i, j in _PAIRS),
    *(Coefficient(f"zero {a}", "m", 1e-4, secondary=True) for a in _AXES),
    *(Coefficient(f"scale r{a}", "1", 1e-3, secondary=True) for a in _AXES),
)


class Instrument(Effect):
    """Δposition = S (position - middle of the workspace) + z, S symmetric: no rigid motion but by what is secondary.

    What the device shows as constant it has not scaled, whatever the machine did.

    The diagonal of S are errors of scale, beside it is half the angle by which two axes are not square. Secondary:
    lean, the other half, a turn, since the device aligns one of the two axes with the machine and not their bisector;
    z, since its own zero is not the middle of the workspace; and a scale of the measured angles where the machine's
    angles are measured as such (not by the frames of an arm).
    """

    name = "instrument"
    kind = "pose"
    description = "the measuring device itself: errors of scale and axes that are not square"

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """Positions."""
        if sees_directions(mechanism):
            return "positions: directions have no scale"
        poses = not isinstance(mechanism, Seen) or isinstance(mechanism, Partial)
        return "" if poses else f"measured poses: {mechanism.name} is seen by an instrument with parameters of its own"

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """Scale of each axis and shear of each pair that the pose shows; zeros and angular scales as secondary ones."""
        return tuple(_COEFFICIENTS[k] for k in shown_columns(situation, _instrument_columns))

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x c x m`."""
        return _instrument_columns(situation)[..., shown_columns(situation, _instrument_columns)]


def _instrument_columns(situation: Situation) -> Tensor:
    """`... x s x c x 15`, columns as in `_COEFFICIENTS`."""
    mechanism = situation.mechanism
    position, rotation = situation.platform
    if situation.guess is not None:
        position = where_moved(position, mechanism.frame(situation.guess)[0])
    from_middle = position - mechanism.frame(mechanism.home_pose)[0]
    shear = [torch.zeros_like(from_middle) for _ in _PAIRS]
    for column, (i, j) in zip(shear, _PAIRS, strict=True):
        column[..., i] = from_middle[..., j] / 2
        column[..., j] = from_middle[..., i] / 2
    lean = [column.clone() for column in shear]
    for column, (i, _) in zip(lean, _PAIRS, strict=True):
        column[..., i] = -column[..., i]
    zero = torch.zeros(*position.shape, 3, dtype=position.dtype)
    shift = torch.eye(3, dtype=position.dtype).expand_as(zero)
    linear = torch.cat([torch.diag_embed(from_middle), torch.stack(shear, -1), torch.stack(lean, -1), shift, zero], -1)
    if situation.visible.shape[-1] == 3:
        return situation.visible @ linear
    angles = torch.zeros_like(position)
    if rotation is not None and not mechanism.orientations:
        angles = matrix_to_rotation_vector(rotation)
    turning = torch.cat([zero, zero, zero, zero, torch.diag_embed(angles)], -1)
    return situation.visible @ torch.cat([linear, turning], -2)


class Geometry(Effect):
    """Δp_k = c_k, p = the mechanism's own lengths, angles and gains; base and tool frames are effects of their own.

    A parameter that names another cause (a simulator's stiffness) is a candidate of its own: `ParameterCause`.
    """

    name = "geometry"
    kind = "parameters"
    description = "lengths, places and angles of the machine as built that differ from its drawing"

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """Parameters."""
        return "" if caused_by(mechanism, self.name) else f"geometric parameters: mechanism '{mechanism.name}' has none"

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """One a parameter."""
        mechanism = situation.mechanism
        chosen = caused_by(mechanism, self.name)
        arm = inside(mechanism)
        joint_of = arm.joint_of if isinstance(arm, SerialArm) else {}
        return tuple(
            Coefficient(p.name, p.unit, plausible_error(p), joint=joint_of.get(p.name), leg=p.leg)
            for p in (mechanism.geometry[k] for k in chosen)
        )

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """Columns of the identity at every row, `... x s x k x m`."""
        return parameter_columns(situation, self.name)


PARAMETER = "parameter "
"""What the names of these effects begin with, before the cause's own."""


class ParameterCause(Effect):
    """Δp_k = c_k for the parameters of one cause."""

    kind = "parameters"

    def __init__(self, cause: str) -> None:
        """cause: as the mechanism's parameters name it."""
        self.cause = cause
        self.name = f"{PARAMETER}{cause}"
        self.description = f"another value of {cause} than the model's"

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """A parameter of this cause."""
        return "" if caused_by(mechanism, self.cause) else f"a parameter of this cause: {mechanism.name} has none"

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """One a parameter."""
        geometry = situation.mechanism.geometry
        chosen = [geometry[k] for k in caused_by(situation.mechanism, self.cause)]
        return tuple(Coefficient(p.name, p.unit, plausible_error(p), leg=p.leg) for p in chosen)

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """Columns of the identity at every row, `... x s x k x m`."""
        return parameter_columns(situation, self.cause)


def parameter_causes(mechanism: Mechanism) -> list[ParameterCause]:
    """One for each cause that the mechanism's parameters name, in their order; none for most mechanisms."""
    causes = [mechanism.geometry[k].cause for k in own_parameters(mechanism)]
    return [ParameterCause(c) for c in dict.fromkeys(causes) if c not in (None, "geometry")]
