"""The 2-DoF over-constrained mechanism (four RSR limbs and an SS limb) of the real inverse kinematics paper."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import newton as _numeric
from ccnn_torch.mechanisms.machines.closed_forms import crank_angle
from ccnn_torch.mechanisms.mechanism import Mechanism
from ccnn_torch.mechanisms.pose import frame_jacobian
from ccnn_torch.numerics.batching import expand_leading, stack_last
from ccnn_torch.numerics.least_squares import jacobian_of
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector, rotation_vector_to_matrix

_COMMON = 4
_ERRORS = (
    *((name, "m") for name in ("dBx", "dBy", "dBz")),
    *((name, "rad") for name in ("dalpha", "dgamma")),
    *((name, "m") for name in ("dl1_", "dl2_", "dAx", "dAy", "dAz")),
    ("dtheta", "rad"),
)
# Table 2 has errors of 0.2° on average and up to 0.4°.
_SCALE = {"m": 1e-3, "rad": 4e-3}
_QUARTER_TURNS = (0.0, 0.5 * math.pi, math.pi, 1.5 * math.pi)


class Overconstrained2Dof(Mechanism):
    """Joints q1, q2 [rad] (β1, β2), pose phi, theta [rad]: azimuth and tilt of the platform (Sun et al. 2018).

    The platform turns by eq. 4, about (-sin phi, cos phi, 0) by theta, and the centre of its S joint is at r of eq. 7.
    The paper calls that centre and the origin of the measured platform frame both C_E. They are h_s apart: measured is
    the upper surface, from which the joints A_j hang down by h_s (eq. 10). Only then is eq. 12 without errors eq. 6,
    and only then do the R joints on the platform close on eqs. 4 and 7. So the frame's origin here (`frame`, and what
    `joints_of_frame` takes) is r' = r + h_s w. With origin="joint" the origin is r itself, eq. 7 put into the appendix
    as it is printed; the limbs of such a machine do not close, so that it has no `as_built`.

    Parameters: a, h, l, h_s [m] of the machine, and of limb j the eleven errors of Table 2, nominally 0: dBxj, dByj,
    dBzj (⁰δx, ⁰δy, ⁰δz), dalphaj, dgammaj (⁰δα, ⁰δγ), dl1_j, dl2_j (Δl1, Δl2), dAxj, dAyj, dAzj (⁶δx, ⁶δy, ⁶δz) and
    dthetaj (Δθ: the crank is at the commanded angle plus this). All are in the axes of the limb: those of limb 2
    are those of limb 1 turned by 90° about z, for ⁰δ and ⁶δ alike, as in the appendix.

    The sampling box is all of phi and tilts from 0.05 to 1 rad: phi has no value at theta = 0.
    """

    def __init__(
        self, a: float = 0.150, h: float = 0.402, l: float = 0.317, h_s: float = 0.080, origin: str = "surface"
    ) -> None:
        """a: radius of the joints; h: length of the SS limb; l: of the links; h_s: of the platform's height [m].

        Raises:
            InputError: an origin that is neither "surface" nor "joint".
        """
        if origin not in ("surface", "joint"):
            raise InputError(f"overconstrained_2dof: origin is 'surface' or 'joint', got '{origin}'")
        self.origin = origin
        geometry = [Parameter(name, "m", value) for name, value in (("a", a), ("h", h), ("l", l), ("h_s", h_s))]
        for leg in (1, 2):
            geometry += [Parameter(f"{name}{leg}", unit, 0.0, leg, _SCALE[unit]) for name, unit in _ERRORS]
        super().__init__(
            name="overconstrained_2dof",
            joints=[Coordinate(q, "rad") for q in ("q1", "q2")],
            pose=[Coordinate("phi", "rad"), Coordinate("theta", "rad")],
            geometry=geometry,
            low=(0.0, 0.05),
            high=(2 * math.pi, 1.0),
            keys={"origin": origin},
        )

    def solve_inverse(self, pose: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None) -> Tensor:
        """Eq. 13 at the frame of eqs. 4 and 7, links outward; NaN where a limb does not reach."""
        values = self.resolve(parameters)
        return self.joints_of_frame(*self._placed(_tilt(pose), values), values)

    def joints_of_frame(self, position: Tensor, rotation: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Joints of a measured platform frame, wherever it is: a machine as built turns a little about w as well.

        Args:
            position: r', origin of the platform frame, `... x 3` [m].
            rotation: R, `... x 3 x 3`.
            parameters: `... x k` [SI], nominal when None.

        Returns:
            β_j - Δθ_j with β_j of eq. 13, `... x 2` [rad]; NaN where a limb does not reach.
        """
        values = self.resolve(parameters)
        limbs = values[..., _COMMON:].reshape(*values.shape[:-1], 2, len(_ERRORS))
        return _cranks(position, rotation, values[..., :_COMMON], limbs) - limbs[..., -1]

    def forward_kinematics(
        self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None
    ) -> Tensor:
        """Newton on eq. 13 in (theta cos phi, theta sin phi), from no tilt; phi in [0, 2 pi), theta >= 0.

        NaN where it leaves the assembly mode.
        """
        values = self.resolve(parameters)
        start = None if guess is None else _tilt(guess)
        return _untilt(self._solve_tilt(joints, values, start))

    def jacobian(self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None) -> Tensor:
        """See `Mechanism.jacobian`; also right at theta = 0, where phi has no value."""
        values = self.resolve(parameters)
        start = None if guess is None else _tilt(guess)
        others = (values,) if start is None else (values, start)
        return frame_jacobian(
            lambda q: self._placed(self._solve_tilt(q, values, start), self.nominal), expand_leading(joints, *others)
        )

    def frame(self, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Origin of the platform frame r' [m] of the nominal machine, and R of eq. 4."""
        return self._placed(_tilt(pose), self.nominal)

    def pose_near(self, position: Tensor, rotation: Tensor | None) -> Tensor:
        """Eq. 17: azimuth and tilt of a measured frame, `... x 2` [rad]; its torsion is left out."""
        if rotation is None:
            raise InputError("overconstrained_2dof: a frame needs its rotation; positions alone do not give phi, theta")
        x, y, z = rotation[..., :, 2].unbind(-1)
        return stack_last(torch.remainder(torch.atan2(y, x), 2 * torch.pi), torch.atan2(torch.hypot(x, y), z))

    def reachable(self, pose: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Within reach of both limbs, in the assembly mode of the pose without tilt; `...`, bool."""
        return self._same_mode(_tilt(pose), self.resolve(parameters))

    def as_built(self, joints: Tensor, parameters: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Platform frame of the machine with its errors and all its limbs, which leaves eqs. 4 and 7 a little.

        Limbs 1 and 2 close exactly (eq. 12, and each upper link square to its R joint on the platform), and so does the
        SS limb. These are five conditions; the sixth freedom, mainly a turn about w, is held by the passive limbs 3 and
        4. They are without errors and cannot both close: the sum of their misfits along the R joints on the platform is
        zero, which is where two equally stiff limbs would hold it.

        Args:
            joints: `... x 2` [rad].
            parameters: `... x k` [SI], nominal when None.

        Returns:
            r' `... x 3` [m] and R `... x 3 x 3`; NaN where the machine cannot be assembled.

        Raises:
            InputError: origin="joint", a machine whose limbs do not close.
        """
        if self.origin != "surface":
            raise InputError("overconstrained_2dof: with origin='joint' the limbs do not close; use origin='surface'")
        values = self.resolve(parameters)
        position, rotation = self._placed(self._solve_tilt(joints, values, None), values)
        start = torch.cat([position, matrix_to_rotation_vector(rotation)], dim=-1)
        frame = _numeric.solve(_misfits, start, (joints, values))
        return frame[..., :3], rotation_vector_to_matrix(frame[..., 3:])

    def _placed(self, tilt: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
        """Platform frame of eqs. 4 and 7; tilt: (theta cos phi, theta sin phi), `... x 2` [rad]."""
        zero = torch.zeros_like(tilt[..., 0])
        half = rotation_vector_to_matrix(stack_last(-tilt[..., 1] / 2, tilt[..., 0] / 2, zero))
        rotation = half @ half
        position = values[..., 1, None] * half[..., :, 2]
        if self.origin == "surface":
            position = position + values[..., 3, None] * rotation[..., :, 2]
        return position, rotation

    def _solve_tilt(self, joints: Tensor, values: Tensor, start: Tensor | None) -> Tensor:
        def closure(tilt: Tensor, joints: Tensor, values: Tensor) -> Tensor:
            return self.wrap(self.joints_of_frame(*self._placed(tilt, values), values) - joints)

        tilt = _numeric.solve(closure, torch.zeros(2, dtype=joints.dtype) if start is None else start, (joints, values))
        return torch.where(self._same_mode(tilt.detach(), values.detach())[..., None], tilt, torch.nan)

    def _same_mode(self, tilt: Tensor, values: Tensor) -> Tensor:
        """det(∂q/∂tilt) > 0 as at no tilt, which changes at a singularity, and a tilt of half a turn at most."""
        joints, slope = jacobian_of(
            lambda t: self.joints_of_frame(*self._placed(t, values), values), expand_leading(tilt, values)
        )
        real = torch.isfinite(joints).all(-1)
        determinant: Tensor = torch.linalg.det(torch.where(real[..., None, None], slope, 0.0))
        half_turn: Tensor = torch.linalg.vector_norm(tilt, dim=-1) <= torch.pi
        return real & (determinant > 0) & half_turn


def _tilt(pose: Tensor) -> Tensor:
    phi, theta = pose.unbind(-1)
    return stack_last(theta * torch.cos(phi), theta * torch.sin(phi))


def _untilt(tilt: Tensor) -> Tensor:
    x, y = tilt.unbind(-1)
    return stack_last(torch.remainder(torch.atan2(y, x), 2 * torch.pi), torch.hypot(x, y))


def _cranks(position: Tensor, rotation: Tensor, common: Tensor, limbs: Tensor) -> Tensor:
    """Angles β of the limbs' cranks by eq. 13, `... x j` [rad]; limbs: `... x j x 11`, from limb 1 on."""
    gap, _, lower, upper, (sa, ca, sg, cg) = _limbs(position, rotation, common, limbs)
    x, y, z = gap.unbind(-1)
    cosine = 2 * lower * (x * cg + y * ca * sg + z * sa * sg)
    sine = 2 * lower * (y * sa - z * ca)
    return crank_angle(cosine, sine, lower**2 + (gap**2).sum(-1) - upper**2, -1.0)


def _limbs(
    position: Tensor, rotation: Tensor, common: Tensor, limbs: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, tuple[Tensor, ...]]:
    """Of each limb, in its own axes: λ = B_j - r' - R A_j, as the appendix has it but for the turn by 90° from limb to
    limb, `... x j x 3`; the axis of the R joint on the platform, likewise; the lengths of lower and upper link; and
    sine and cosine of δα and of δγ."""
    a, _, l, h_s = (c[..., None] for c in common.unbind(-1))
    dbx, dby, dbz, alpha, gamma, dl1, dl2, dax, day, daz, _ = limbs.unbind(-1)
    turns = _turns(limbs.shape[-2])
    platform = turns.mT @ rotation[..., None, :, :] @ turns
    joint = turns.mT @ position[..., None, :, None] + platform @ stack_last(a + dax, day, daz - h_s)[..., None]
    gap = stack_last(a + dbx, dby, dbz) - joint[..., 0]
    leans = torch.sin(alpha), torch.cos(alpha), torch.sin(gamma), torch.cos(gamma)
    return gap, platform[..., :, 1], l + dl1, l + dl2, leans


def _misfits(frame: Tensor, joints: Tensor, values: Tensor) -> Tensor:
    """What `as_built` brings to zero, `... x 6` [m]. frame: r' and the rotation vector, `... x 6`."""
    position, rotation = frame[..., :3], rotation_vector_to_matrix(frame[..., 3:])
    errors = values[..., _COMMON:].reshape(*values.shape[:-1], 2, len(_ERRORS))
    limbs = torch.cat([errors, torch.zeros_like(errors)], dim=-2)
    common = values[..., :_COMMON]
    passive = _cranks(position, rotation, common, limbs)[..., 2:]
    active = joints + errors[..., -1]
    lead = torch.broadcast_shapes(passive.shape, active.shape)  # type: ignore[no-untyped-call]
    crank = torch.cat([active.expand(lead), passive.expand(lead)], dim=-1)
    gap, axis, lower, upper, (sa, ca, sg, cg) = _limbs(position, rotation, common, limbs)
    sb, cb = torch.sin(crank), torch.cos(crank)
    # w'_1 = Rx(δα) Rz(δγ) Ry(β) e1, whose products with λ are the appendix's A and B.
    along = stack_last(cb * cg, cb * ca * sg + sb * sa, cb * sa * sg - sb * ca)
    link = gap + lower[..., None] * along
    upper = upper[..., :2]
    length = ((link[..., :2, :] ** 2).sum(-1) - upper**2) / (2 * upper)
    square = -(link * axis).sum(-1)
    arm = position - values[..., 3, None] * rotation[..., :, 2]
    reach = ((arm**2).sum(-1) - values[..., 1] ** 2) / (2 * values[..., 1])
    held = square[..., 2] + square[..., 3]
    return torch.cat([length, square[..., :2], stack_last(reach, held)], dim=-1)


def _turns(count: int) -> Tensor:
    """Turn about z from the axes of limb 1 to those of each limb, `count x 3 x 3`."""
    angles = torch.tensor(_QUARTER_TURNS[:count], dtype=torch.float64)
    zero, one = torch.zeros_like(angles), torch.ones_like(angles)
    s, c = torch.sin(angles), torch.cos(angles)
    return torch.stack([c, -s, zero, s, c, zero, zero, zero, one], dim=-1).reshape(count, 3, 3)
