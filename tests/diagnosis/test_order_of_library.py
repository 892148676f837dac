"""Which of the names that do the same is told, on made-up posteriors."""

from types import SimpleNamespace
from typing import Any

import torch

from ccnn_torch.diagnosis.verdict.judgement import in_order_of_library
from ccnn_torch.evidence.judge import Explanation, Verdict


def told(columns: list[list[float]], sets: list[tuple[str, ...]], names: list[str]) -> tuple[str, ...]:
    """Names told of equally probable sets, the first of which the verdict has; columns: one of each name."""
    groups = [torch.tensor([i]) for i in range(len(names))]
    dictionary = SimpleNamespace(columns=torch.tensor(columns, dtype=torch.float64).mT[:, None, :], groups=groups)
    analysis: Any = SimpleNamespace(dictionary=dictionary)
    every = [
        Explanation(frozenset(s), (), 0.5, SimpleNamespace(members=tuple(map(names.index, s)), log_evidence=0.0))
        for s in sets
    ]
    verdict: Any = Verdict(every[0], {}, 0.5, False, ())
    chosen = in_order_of_library(analysis, verdict, every, every).chosen
    return tuple(sorted(chosen.names))


NAMES = ["geometry", "instrument", "gravity"]
ONE, OTHER, BOTH = [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]


def test_of_names_that_do_the_same_the_first_of_the_library_is_told() -> None:
    assert told([ONE, ONE, OTHER], [("instrument",), ("geometry",)], NAMES) == ("geometry",)
    assert told([ONE, OTHER, OTHER], [("instrument",), ("geometry",)], NAMES) == ("instrument",)


def test_a_redundant_set_stays_where_no_smaller_one_was_found() -> None:
    # Gravity can do what the other two do together; the only other set is as large.
    sets = [("geometry", "instrument", "gravity"), ("geometry", "joint_offset", "gravity")]
    assert told([ONE, OTHER, BOTH, OTHER], sets, [*NAMES, "joint_offset"]) == ("geometry", "gravity", "instrument")
