"""Inverse kinematics as a module of its own, for torch forward hooks to sit on."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import Tensor, nn

if TYPE_CHECKING:
    from ccnn_torch.mechanisms._mechanism import Mechanism

__all__ = ["InverseKinematics"]


class InverseKinematics(nn.Module):
    """The module that torch forward hooks sit on; it only calls `mechanism.solve_inverse`."""

    def __init__(self, mechanism: Mechanism) -> None:
        super().__init__()
        # A bound method, not the module itself: a child that holds its parent as a submodule would never end.
        self._solve = mechanism.solve_inverse

    def forward(
        self,
        pose: Tensor,
        parameters: Tensor | None = None,
        guess: Tensor | None = None,
        covariates: Tensor | None = None,
        **ignored: object,
    ) -> Tensor:
        """Joints of a pose, as `Mechanism.solve_inverse`.

        `covariates` and further keywords are there for the hooks: the nominal kinematics do not depend on them.
        """
        return self._solve(pose, parameters, guess)
