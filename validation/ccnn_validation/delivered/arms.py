"""Open chains as they were built: frames, links, zeros, gears or screws, and what a machine may have beside them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ccnn_validation.delivered.chain import Chain, chain_pose, joint_places
from ccnn_validation.delivered.machine import Block, Covariates, Files, Machine, Pose
from ccnn_validation.delivered.rotation import Array

_SHIFT, _TURN, _ZERO = 4e-4, 5e-4, 6e-4
"""Standard deviations of a link's errors [m], [rad], and of a turning joint's zero [rad]."""
_GEAR = (50e-6, 300e-6)
"""Amplitude of the first harmonic of a turn [rad]; the second has a third of it."""
_LEAD = 2e-4
"""Relative error of the lead of a sliding joint's screw."""
_MASS = 6.0
"""Mass of a link and of the tool [kg], known to 30 %."""
_REFERENCE_TEMPERATURE = 20.0


def arm(
    kind: str,
    seed: int,
    rng: np.random.Generator,
    chain: Chain,
    files: Files,
    box: tuple[Array, Array],
    wrist: int,
    tool: float,
    extras: tuple[str, ...],
    noise: tuple[float, float],
) -> Machine:
    """A chain with errors drawn from the generator.

    Args:
        kind, seed, extras, noise, wrist: as of `Machine`.
        rng: random numbers.
        chain, files: the maker's machine.
        box: lowest and highest measured joints [rad or m].
        tool: distance of the measured point from the flange [m].
    """
    turning = np.array([unit == "rad" for unit in chain.units])
    count = len(turning)
    blocks = [_base(rng), _tool(rng, tool), _links(rng, count), _zeros(rng, turning), _gears(rng, turning)]
    blocks += [_EXTRAS[name](rng, turning) for name in extras]
    if "sag" in extras:
        blocks.append(_drawn("masses", np.ones(count), 0.3 * np.ones(count), rng))

    torques = _Torques(chain)

    def model(values: Mapping[str, Array], joints: Array, covariates: Covariates) -> Pose:
        moved = joints + _joint_errors(torques, turning, values, joints, covariates)
        growth = None
        if "thermal" in values:
            growth = (covariates["temperature"] - _REFERENCE_TEMPERATURE)[:, None] * values["thermal"]
        return Pose(*chain_pose(chain, moved, values["base_frame"], values["tool_frame"], values["links"], growth))

    return Machine(
        kind, seed, extras, chain.units, box[0], box[1], wrist, tuple(blocks), model, noise, files
    )  # fmt: skip


def _joint_errors(
    torques: _Torques, turning: Array, values: Mapping[str, Array], joints: Array, covariates: Covariates
) -> Array:
    """How far the joints are from their command, `s x n`; the first gear number of a sliding joint is its lead."""
    gears = values["gears"]
    waves = sum(gears[:, 2 * k - 2] * np.sin(k * joints) + gears[:, 2 * k - 1] * np.cos(k * joints) for k in (1, 2))
    errors = values["zeros"] + np.where(turning, waves, gears[:, 0] * joints)
    if "backlash" in values:
        signs = np.stack([covariates[f"direction{i + 1}"] for i in range(joints.shape[1])], -1)
        errors = errors - values["backlash"] * signs / 2
    if "sag" in values:
        errors = errors + values["sag"] * torques.at(joints)[0] @ (_MASS * values["masses"])
    if "payload" in values:
        errors = errors + values["payload"] * torques.at(joints)[1] * covariates["load_z"][:, None]
    return np.asarray(errors)


class _Torques:
    """Torques about the joints of a chain, kept for the joints that were asked last: a fit asks for them again."""

    def __init__(self, chain: Chain) -> None:
        self._chain, self._kept, self._asked = chain, (np.zeros(0), np.zeros(0)), b""

    def at(self, joints: Array) -> tuple[Array, Array]:
        """Torque of each link's weight for 1 kg, `s x n x n` [N m / kg], and of a vertical force, `s x n` [N m / N].

        A link's mass is halfway to the next joint, the last one's at the flange.
        """
        asked = joints.tobytes()
        if asked != self._asked:
            self._kept, self._asked = self._found(joints), asked
        return self._kept

    def _found(self, joints: Array) -> tuple[Array, Array]:
        origins, axes, flange = joint_places(self._chain, joints)
        following = np.concatenate([origins[:, 1:], flange[:, None]], 1)
        centres = (origins + following) / 2
        centres[:, -1] = flange
        levers = centres[:, None] - origins[:, :, None]
        up = np.cross(axes[:, :, None], levers)[..., 2]
        load = np.cross(axes, flange[:, None] - origins)[..., 2]
        return -9.81 * np.triu(np.ones(up.shape[1:])) * up, load


def _drawn(name: str, nominal: Array, spread: Array, rng: np.random.Generator, weak: float = 2.0) -> Block:
    """A block about its nominal values; the reference's prior is `weak` times as wide as the draw."""
    true = nominal + spread * rng.normal(size=nominal.shape)
    return Block(name, nominal, true, np.maximum(weak * spread, 1e-9), nominal)


def _frame(name: str, true: Array) -> Block:
    return Block(name, np.zeros(6), true, np.ones(6), true)


def _base(rng: np.random.Generator) -> Block:
    """Where the base is in the tracker's frame, whose z axis is plumb."""
    tilt = rng.normal(0, 2e-3, 2)
    return _frame("base_frame", np.array([*rng.uniform(-2, 2, 3), *tilt, rng.uniform(-2.5, 2.5)]))


def _tool(rng: np.random.Generator, distance: float) -> Block:
    return _frame("tool_frame", np.array([*rng.normal(0, 0.03, 2), distance, *rng.uniform(-0.8, 0.8, 3)]))


def _links(rng: np.random.Generator, count: int) -> Block:
    return _drawn("links", np.zeros((count, 6)), np.tile([_SHIFT] * 3 + [_TURN] * 3, (count, 1)), rng)


def _zeros(rng: np.random.Generator, turning: Array) -> Block:
    return _drawn("zeros", np.zeros(len(turning)), np.where(turning, _ZERO, _SHIFT), rng)


def _gears(rng: np.random.Generator, turning: Array) -> Block:
    """Sine and cosine of one and two periods a turn; a screw's relative lead in the first place."""
    count = len(turning)
    size = np.exp(rng.uniform(np.log(_GEAR[0]), np.log(_GEAR[1]), count))
    phase = rng.uniform(0, 2 * np.pi, (2, count))
    true = np.stack(
        [
            size * np.cos(phase[0]),
            size * np.sin(phase[0]),
            size / 3 * np.cos(phase[1]),
            size / 3 * np.sin(phase[1]),
        ],
        -1,
    )
    prior = np.tile([2e-4, 2e-4, 1e-4, 1e-4], (count, 1))
    screw = np.stack([_LEAD * rng.normal(size=count), *np.zeros((3, count))], -1)
    true, prior = np.where(turning[:, None], true, screw), np.where(turning[:, None], prior, [2 * _LEAD, *[1e-9] * 3])
    return Block("gears", np.zeros((count, 4)), true, prior, np.zeros((count, 4)))


def _compliances(name: str, rng: np.random.Generator, turning: Array) -> Block:
    """Rotation of a joint for each N m about it, larger towards the wrist [rad/(N m)]."""
    count = len(turning)
    size = np.exp(rng.uniform(np.log(1e-6), np.log(4e-6), count)) * np.where(np.arange(count) < 3, 1, 3) * turning
    prior = np.where(turning, 1e-5, 1e-12)
    return Block(name, np.zeros(count), size, prior, np.zeros(count))


def _sag(rng: np.random.Generator, turning: Array) -> Block:
    return _compliances("sag", rng, turning)


def _payload(rng: np.random.Generator, turning: Array) -> Block:
    return _compliances("payload", rng, turning)


def _backlash(rng: np.random.Generator, turning: Array) -> Block:
    size = np.where(turning, rng.uniform(50e-6, 200e-6, len(turning)), rng.uniform(5e-6, 20e-6, len(turning)))
    return Block("backlash", np.zeros(len(turning)), size, np.where(turning, 3e-4, 3e-5), np.zeros(len(turning)))


def _thermal(rng: np.random.Generator, turning: Array) -> Block:
    size = 1.2e-5 + rng.normal(0, 3e-6, len(turning))
    return Block("thermal", np.zeros(len(turning)), size, np.full(len(turning), 3e-5), np.zeros(len(turning)))


_EXTRAS = {"sag": _sag, "payload": _payload, "backlash": _backlash, "thermal": _thermal}
