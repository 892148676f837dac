"""Functions that several effects share: columns by joint, typical sizes by unit, motions about a point."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from ccnn_torch.effects.protocol import Effect
from ccnn_torch.effects.situation import Situation
from ccnn_torch.mechanisms import Framed, Instrument, Mechanism, Seen, SerialArm
from ccnn_torch.numerics.rotations import skew

_SHOWN = 1e-9

TWIST = (("x", "m"), ("y", "m"), ("z", "m"), ("rx", "rad"), ("ry", "rad"), ("rz", "rad"))
"""A small shift and a small turn, as names and units of its six numbers."""


def by_joint(values: Tensor, joints: Sequence[int] | None = None) -> Tensor:
    """Columns that move one joint each: those of the first joint, then those of the second …

    Args:
        values: change of each joint per unit of its own coefficients, `... x s x n x m`.
        joints: numbers, from 0, of the joints that have columns; None = all.

    Returns:
        `... x s x n x (number of joints · m)`.
    """
    n, m = values.shape[-2:]
    eye = torch.eye(n, dtype=values.dtype, device=values.device).unsqueeze(-1)
    blocks = values.unsqueeze(-2) * eye
    if joints is not None and list(joints) != list(range(n)):
        blocks = blocks[..., list(joints), :]
    return blocks.reshape(*values.shape[:-1], blocks.shape[-2] * m)


def of_rows(values: Tensor, rows: Tensor | None, dim: int = -2) -> Tensor:
    """Some of the rows, which count along `dim`; all where rows is None."""
    return values if rows is None else values.index_select(dim, rows)


class OfJoints(Effect):
    """An effect each of whose coefficients moves one joint, by its motor: those of the first joint come first."""

    kind = "joints"

    @abstractmethod
    def moves(self, situation: Situation, shape: Tensor, rows: Tensor | None = None) -> Tensor:
        """Change of each joint's motor per unit of its own coefficients, `... x t x n x m`; rows: which, `t`; None =
        all."""

    def moving(self, situation: Situation) -> list[int]:
        """Numbers, from 0, of the joints that have coefficients."""
        return [*range(situation.joints.shape[-1])]

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x n x (joints that have coefficients · m)`."""
        return situation.joints_by(self.of_motors(situation, shape))

    def of_motors(self, situation: Situation, shape: Tensor) -> Tensor:
        """The same of the motors, where joints have motors in common; each column moves one of them."""
        return by_joint(self.moves(situation, shape), self.moving(situation))

    def one_by_one(self, situation: Situation, shape: Tensor, rows: Tensor | None = None) -> Tensor:
        """The same in some of the rows, without its zeros: what each coefficient does to the motor that it moves.

        rows: which, `t`; None = all. Returns `... x t x (joints that have coefficients · m)`.
        """
        return self.moves(situation, shape, rows)[..., self.moving(situation), :].flatten(-2)


def inside(mechanism: Mechanism) -> Mechanism:
    """The machine itself, of which perhaps not all is measured."""
    return mechanism.mechanism if isinstance(mechanism, Seen) else mechanism


def own_parameters(mechanism: Mechanism) -> list[int]:
    """Numbers of the parameters that are the mechanism's own: not those of its base frame and tool frame.

    Of what it is seen through those that have a cause of their own, such as a camera's focal length.
    """
    if isinstance(mechanism, Seen):
        first = len(mechanism.mechanism.geometry)
        more = [k for k, p in enumerate(mechanism.geometry) if k >= first and p.cause is not None]
        return [*own_parameters(mechanism.mechanism), *more]
    first, last = 0, len(mechanism.geometry)
    if isinstance(mechanism, SerialArm):
        return list(range(6, last - 6))
    if isinstance(mechanism, Framed):
        first, last = (6 if mechanism.base else 0), last - (6 if mechanism.tool else 0)
    return list(range(first, last))


def caused_by(mechanism: Mechanism, cause: str) -> list[int]:
    """Numbers of the mechanism's own parameters that are wrong by this cause, ``geometry`` where they name none."""
    own = ((k, mechanism.geometry[k]) for k in own_parameters(mechanism))
    return [k for k, p in own if (p.cause or "geometry") == cause and not p.held]


def parameter_columns(situation: Situation, cause: str) -> Tensor:
    """Change of the mechanism's parameters by one in each of those that `caused_by` gives, `... x s x k x m`."""
    chosen = torch.eye(len(situation.mechanism.geometry), dtype=situation.joints.dtype, device=situation.joints.device)
    chosen = chosen[:, caused_by(situation.mechanism, cause)]
    return chosen.expand(*situation.joints.shape[:-1], *chosen.shape)


def twist_columns(situation: Situation, arm: Tensor, axes: Tensor) -> Tensor:
    """Change of the measured frame by a shift along and a turn about three axes, as far as the pose shows it.

    Args:
        situation: `... x s` rows.
        arm: from the point that the turn leaves where it is to the measured point, `... x s x 3` [m].
        axes: unit vectors in its columns, `... x s x 3 x 3`.

    Returns:
        `... x s x c x 6`.
    """
    shift = torch.cat([axes, -skew(arm) @ axes], -1)
    turn = torch.cat([torch.zeros_like(axes), axes], -1)
    return as_shown(situation, torch.cat([shift, turn], -2))


def as_shown(situation: Situation, motion: Tensor) -> Tensor:
    """Small shifts of the measured point and turns of its frame `... x s x 6 x m` [m, rad], as the pose or the
    instruments show them, `... x s x c x m`."""
    if isinstance(situation.mechanism, Instrument):
        return situation.by_place @ motion
    return situation.visible @ motion[..., : situation.visible.shape[-1], :]


def shown_columns(situation: Situation, columns: Callable[[Situation], Tensor]) -> list[int]:
    """Numbers of the columns that change what is measured anywhere in the workspace, for any rows.

    Args:
        situation: whose mechanism counts.
        columns: rows -> `... x s x c x m`.
    """
    samples = situation.samples
    # Kept with the samples: a graph that is traced can ask no values.
    known: dict[Callable[[Situation], Tensor], list[int]] = samples.__dict__.setdefault("_shown", {})
    if columns not in known:
        largest = torch.nan_to_num(columns(samples)).abs().amax((-3, -2))
        known[columns] = torch.nonzero(largest > _SHOWN).flatten().tolist()
    return known[columns]
