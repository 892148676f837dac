"""Trial of a simulator before use: determinism, independence of rows, response to commands."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ccnn_torch.coordinates import Condition
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms.simulators.calls import Calls, described
from ccnn_torch.mechanisms.simulators.simulator import Simulator

_ROWS = 4
# Of the change over a step: what differs by more from call to call spoils every derivative.
_REPEATS = 0.01


def try_simulator(simulator: Simulator, calls: Calls, home: Tensor, joints: Tensor, nominal: Tensor) -> None:
    """Ask twice about the same rows, the second time in the reverse order and with another row among them.

    Args:
        home: a configuration with a pose, `n` [SI].
        joints: configurations, `s x n` [SI].
        nominal: parameters, `k` [SI].
    """
    some = torch.cat([joints[:_ROWS], home[None]])
    usual = [c.usual for c in simulator.covariates if isinstance(c, Condition)]
    fixed = torch.cat([torch.tensor(usual, dtype=torch.float64), nominal])
    rows = torch.cat([some, fixed.expand(len(some), -1)], -1).numpy()
    first = calls.ask(rows)
    again = calls.ask(rows[::-1][1:])[::-1]
    step = simulator.step * torch.tensor([j.high - j.low for j in simulator.joints], dtype=torch.float64) / 2
    moved = np.concatenate([calls.ask(rows + np.eye(1, rows.shape[1], i) * float(s)) for i, s in enumerate(step)])
    change = np.abs(moved.reshape(len(step), *first.shape) - first)
    typical = float(np.nanmedian(change.max(axis=(0, 2))))
    if not typical > 0:
        raise InputError(
            f"simulator '{simulator.name}': no joint changes the pose, by steps of {float(step[0]):.2g}; check that "
            "simulate uses its commands, or give a larger step"
        )
    apart = np.nan_to_num(np.abs(again - first[: len(again)]), nan=0.0).max(-1)
    worst = int(apart.argmax())
    if apart[worst] > _REPEATS * typical:
        at = described(simulator, some[worst], {})
        raise InputError(
            f"simulator '{simulator.name}' is not deterministic: evaluated twice at {at} it gave poses that differ by "
            f"{apart[worst]:.2g} m or rad, and a step of a joint changes them by {typical:.2g}; seed its random "
            "numbers, let no row depend on others or on earlier calls, or give a larger step"
        )
