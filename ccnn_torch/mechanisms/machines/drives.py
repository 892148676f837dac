"""What drives do to the joints beside what was commanded: leads, couplings, tables of pitch errors."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.errors import InputError


class Drives:
    """Joints as the drives move them: q + Σ c_ij q_j e_i + t(q).

    A table t has a joint's error where it was measured, positive where the joint goes too far, linear between, and the
    last value beyond.
    """

    def __init__(self, drives: Sequence[Sequence[int]], tables: Sequence[Sequence[Sequence[float]] | None]) -> None:
        """Take joints i, j from 1 of each drive, and of each of `n` joints the table [SI] or None.

        Raises:
            InputError: a table without two places in ascending order, or with another number of errors.
        """
        n = len(tables)
        eye = torch.eye(n, dtype=torch.float64)
        which = torch.tensor([[i - 1, j - 1] for i, j in drives], dtype=torch.int64).reshape(-1, 2)
        self._to, self._by = eye[which[:, 0]], eye[which[:, 1]]
        first, parts = torch.zeros(n, dtype=torch.float64), []
        for i, table in enumerate(tables):
            if table is None:
                continue
            places, errors = (torch.tensor(list(row), dtype=torch.float64) for row in table)
            if len(places) < 2 or len(places) != len(errors) or bool((places.diff() <= 0).any()):
                raise InputError(
                    f"pitch_errors: q{i + 1}: needs as many errors as places, two or more, and the places ascending"
                )
            first[i] = errors[0]
            parts += [(i, p, w, e / w) for p, w, e in zip(places, places.diff(), errors.diff(), strict=False)]
        self._first = first
        self._joint = eye[[p[0] for p in parts]]
        self._place, self._width, self._slope = (torch.tensor([p[k] for p in parts]).double() for k in (1, 2, 3))
        self.count = len(drives)
        self.curved = bool(parts)

    def of(self, joints: Tensor) -> Tensor:
        """q_j of every drive at joints `... x n`, `... x d`."""
        return joints @ self._by.mT

    def moved(self, joints: Tensor, own: Tensor) -> Tensor:
        """The joints as driven, `... x n`; own: c, `... x d`."""
        moved: Tensor = joints + (own * self.of(joints)) @ self._to
        if not len(self._joint):
            return moved
        along = torch.minimum((joints @ self._joint.mT - self._place).clamp_min(0.0), self._width)
        return moved + self._first + (along * self._slope) @ self._joint

    def coupled(self, joints: Tensor | None, own: Tensor) -> Tensor:
        """How joints move for each unit of the commands, `... x n x n`; joints may be None where nothing is curved."""
        n = self._first.shape[0]
        spread = (self._to[:, :, None] * self._by[:, None, :]).flatten(1)
        matrix = (own @ spread).reshape(*own.shape[:-1], n, n) + torch.eye(n, dtype=own.dtype)
        if joints is None or not len(self._joint):
            return matrix
        along = joints @ self._joint.mT - self._place
        inside = torch.lt(torch.zeros_like(along), along) & torch.lt(along, self._width)
        diagonal = torch.where(inside, self._slope, torch.zeros_like(along)) @ self._joint
        return matrix + diagonal[..., None] * torch.eye(n, dtype=own.dtype)
