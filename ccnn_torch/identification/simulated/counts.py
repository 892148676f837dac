"""How many measurements are needed: the study repeated with other numbers of poses (Table 3 of the 5R paper)."""

from __future__ import annotations

from typing import Any

from ccnn_torch.identification.config import IdentifyConfig, base_method
from ccnn_torch.identification.judge import commanded
from ccnn_torch.identification.pose_errors import figures
from ccnn_torch.identification.simulated.machines import simulate
from ccnn_torch.identification.solve import QUICK, Outcome, free_values, run_method, select
from ccnn_torch.mechanisms import Mechanism


def count_study(config: IdentifyConfig, mechanism: Mechanism) -> list[dict[str, Any]]:
    """For each number of poses and each quick method: pose error under its exact commands, and parameter deviations."""
    if config.simulate is None:
        return []
    answer = []
    for poses in config.simulate.counts:
        measured = simulate(config, mechanism, poses)
        block: dict[str, Any] = {"poses": poses, "methods": {}}
        for method in (m for m in config.methods if base_method(m) in QUICK):
            outcome: Outcome = run_method(method, measured, config)
            found = commanded(measured, outcome.values, outcome.machines)
            assert found is not None and measured.truth is not None
            gap = free_values(select(measured, config), outcome.values - measured.truth[outcome.machines])
            block["methods"][method] = figures(
                {"position": found.exact.position.square().mean(-1).sqrt(), "deviation": gap.abs().mean(-1)}
            )
        answer.append(block)
    return answer
