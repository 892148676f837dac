"""Inverse kinematics as a torch module, for forward hooks."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor, nn


class InverseKinematics(nn.Module):
    """The module that torch forward hooks sit on; it only calls `solve_inverse` of its mechanism."""

    def __init__(self, solve_inverse: Callable[..., Tensor]) -> None:
        super().__init__()
        # A bound method, not the mechanism: a child that holds its parent as a submodule would never end.
        self._solve = solve_inverse

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
