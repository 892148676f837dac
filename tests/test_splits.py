"""Splits against numpy one-liners, and what no split may do."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st

from ccnn_torch.config.split import HeldOutConfig, held_out_notes
from ccnn_torch.diagnosis.shrink.held_out import folds
from ccnn_torch.errors import InputError
from ccnn_torch.records.splits import Split, fold_splits, split_rows


def sets(split: Split) -> tuple[set[int], set[int], set[int]]:
    return set(split.train.tolist()), set(split.validation.tolist()), set(split.test.tolist())


def positions(rows: int = 200, seed: int = 0) -> torch.Tensor:
    """Forty poses, each reached `rows / 40` times within 0.2 mm, stretched along (1, 2, -3)."""
    rng = np.random.default_rng(seed)
    poses = np.round(rng.permutation(np.linspace(-0.2, 0.2, 40))[:, None] * [1, 2, -3] / 0.005) * 0.005
    return torch.from_numpy(np.repeat(poses, rows // 40, axis=0) + rng.uniform(-2e-4, 2e-4, (rows, 3)))


@pytest.mark.parametrize("rows, seed", [(1495, 0), (125, 7), (2978, 0)])
def test_random_is_the_first_70_percent_of_the_permutation(rows: int, seed: int) -> None:
    permutation = np.random.default_rng(seed).permutation(rows)
    split = split_rows(torch.zeros(rows, 3, dtype=torch.float64), "random", test=0.3, validation=0.0, seed=seed)
    assert sets(split) == (set(permutation[: int(0.7 * rows)]), set(), set(permutation[int(0.7 * rows) :]))
    split = split_rows(torch.zeros(rows, 3, dtype=torch.float64), "random", test=0.3, validation=0.2, seed=seed)
    rest = permutation[: int(0.7 * rows)]
    cut = int(0.8 * len(rest))
    assert sets(split) == (set(rest[:cut]), set(rest[cut:]), set(permutation[int(0.7 * rows) :]))


def test_readings_of_one_target_are_held_out_together() -> None:
    """Five cycles over twelve targets: a target that was trained on is no new one."""
    targets = torch.arange(12, dtype=torch.float64).repeat(5)[:, None].expand(-1, 2)
    split = split_rows(torch.zeros(60, 3), "random", test=0.25, validation=0.2, seed=1, targets=targets)
    parts = [set(targets[rows, 0].tolist()) for rows in (split.train, split.validation, split.test)]
    assert [len(part) for part in parts] == [7, 2, 3] and len(set.union(*parts)) == 12
    assert held_out_notes(HeldOutConfig(), len(split.test), split) == [
        "Held out: the 15 rows of 3 of 12 targets, so that no target is in both parts."
    ]
    for fold in fold_splits(split, "random", 3, 0):
        assert not set(targets[fold.train, 0].tolist()) & set(targets[fold.validation, 0].tolist())
    dealt = folds(targets, 0)
    assert len(set(zip(targets[:, 0].tolist(), dealt.tolist(), strict=True))) == 12 and len(dealt.unique()) == 5
    # Every row another target, or too few of them: rows are drawn as ever.
    for other in (torch.arange(60.0)[:, None], torch.arange(60)[:, None] % 3):
        alone = split_rows(torch.zeros(60, 3), test=0.25, validation=0.2, seed=1, targets=other)
        assert alone.groups is None and sets(alone) == sets(split_rows(torch.zeros(60, 3), test=0.25, seed=1))


@pytest.mark.parametrize("rows, test, expected", [(125, 0.2, 25), (152, 27 / 152, 27), (10, 0.3, 3), (10, 0.1, 1)])
def test_counts_are_those_meant(rows: int, test: float, expected: int) -> None:
    assert len(split_rows(torch.zeros(rows, 1), test=test, validation=0).test) == expected


def test_group_is_cells_of_5_mm_drawn_at_random() -> None:
    where = positions()
    _, cell = np.unique(np.round(where.numpy() * 200), axis=0, return_inverse=True)
    held = np.random.default_rng(4).permutation(cell.max() + 1)[int(0.7 * (cell.max() + 1)) :]
    for by in (None, "position:5mm", "position: 0.5 cm"):
        split = split_rows(where, "group", by, test=0.3, validation=0.2, seed=4)
        assert sets(split)[2] == set(np.flatnonzero(np.isin(cell, held)))
    train, validation, test = (set(cell[list(part)]) for part in sets(split))
    assert not (train & validation or train & test or validation & test)


def test_group_by_columns() -> None:
    robot, placement = np.repeat([1.0, 2.0, 3.0, 4.0], 10), np.tile([0.0, 1.0], 20)
    columns = {"robot": robot, "placement": placement}
    nowhere = torch.zeros(40, 0, dtype=torch.float64)
    split = split_rows(nowhere, "group", "robot", columns, test=0.25, validation=0.34, seed=1)
    order = np.random.default_rng(1).permutation(4) + 1
    expected = (np.isin(robot, order[:1]), np.isin(robot, order[1:3]), np.isin(robot, order[3:]))
    assert sets(split) == tuple(set(np.flatnonzero(rows)) for rows in expected)
    both = split_rows(nowhere, "group", ["robot", "placement"], columns, test=0.25, validation=0.34, seed=1)
    pattern = split_rows(
        nowhere, "group", "goal_*", {"goal_x": robot, "row": np.arange(40.0), "goal_y": placement}, 0.25, 0.34, seed=1
    )
    assert sets(pattern) == sets(both)
    assert len(both.test) == 10 and {len(set(zip(robot[p], placement[p], strict=True))) for p in both.test[None]} == {2}


def test_group_by_column_and_cell() -> None:
    where = positions()
    turn = torch.arange(200, dtype=torch.float64) % 2
    split = split_rows(where, "group", ["position:5mm", "turn"], {"turn": turn}, test=0.5, validation=0, seed=0)
    cell = np.unique(np.round(where.numpy() * 200), axis=0, return_inverse=True)[1].reshape(-1)
    key = cell * 2 + turn.numpy()
    held = np.unique(key)[np.random.default_rng(0).permutation(len(np.unique(key)))[len(np.unique(key)) // 2 :]]
    assert sets(split)[2] == set(np.flatnonzero(np.isin(key, held)))


def test_block_is_the_far_end_of_the_principal_direction() -> None:
    where = positions()
    along = where.numpy() @ np.array([1, 2, -3])  # the largest component counts as negative
    split = split_rows(where, "block", test=0.3, validation=0.2, seed=0)
    order = np.argsort(along, kind="stable")
    assert sets(split)[2] == set(order[-60:])  # 200 rows in fives: no group stands across a border
    assert sets(split)[1] == set(order[110:140]) and sets(split)[0] == set(order[:110])
    assert sets(split_rows(where, "block", seed=9)) == sets(split_rows(where, "block", seed=0))


@settings(deadline=None)
@given(
    st.integers(20, 60),
    st.sampled_from([("random", None), ("group", None), ("group", "c"), ("block", None), ("block", "c")]),
    st.floats(0.1, 0.4),
    st.floats(0.1, 0.4),
    st.integers(0, 2**32),
)
def test_every_row_once_and_no_group_torn(
    rows: int, how: tuple[str, str | None], test: float, validation: float, seed: int
) -> None:
    kind, by = how
    rng = np.random.default_rng(seed)
    where = torch.from_numpy(rng.integers(0, 40, (rows, 2)) * 0.005 + rng.uniform(-0.002, 0.002, (rows, 2)))
    columns = {"c": rng.integers(0, 30, rows).astype(float)}
    try:
        split = split_rows(where, kind, by, columns, test, validation, seed)
    except InputError as error:
        assert "too few" in str(error)
        return
    parts = sets(split)
    assert sorted(index for part in parts for index in part) == list(range(rows))
    assert all(part.dtype == torch.int64 and bool((part.diff() > 0).all()) for part in (split.train, split.test))
    if kind != "random":
        key = (
            columns["c"]
            if by
            else np.unique(np.round(where.numpy() / 0.005), axis=0, return_inverse=True)[1].reshape(-1)
        )
        seen = [set(key[list(part)]) for part in parts]
        assert not (seen[0] & seen[1] or seen[0] & seen[2] or seen[1] & seen[2])
    again = split_rows(where, kind, by, columns, test, validation, seed)
    assert sets(again) == parts


@pytest.mark.parametrize("by_column", [False, True])
def test_rows_that_are_held_out_by_name(by_column: bool) -> None:
    robot = np.arange(200.0) % 4
    wanted: dict[str, object] = {"test": torch.from_numpy((robot == 1) | (robot == 3))}
    if by_column:
        wanted = {"kind": "column", "by": ["robot"], "columns": {"robot": robot}, "test_values": [3.0, 1.0]}
    first, second = (split_rows(positions(), **wanted, seed=seed) for seed in (0, 1))  # type: ignore[arg-type]
    np.testing.assert_array_equal(first.test.numpy(), np.flatnonzero(robot % 2 == 1))
    assert torch.equal(first.test, second.test) and not torch.equal(first.validation, second.validation)
    assert (len(first.train), len(first.validation)) == (80, 20)
    assert sorted(torch.cat([first.train, first.validation, first.test]).tolist()) == list(range(200))
    folds = fold_splits(first, "random", 5, seed=0)
    assert all(torch.equal(fold.test, first.test) for fold in folds)
    held = torch.cat([fold.validation for fold in folds])
    assert sorted(held.tolist()) == np.flatnonzero(robot % 2 == 0).tolist()


def test_groups_stay_whole_beside_the_test_rows() -> None:
    groups = np.arange(200.0) // 10
    held = torch.arange(200) >= 150
    split = split_rows(positions(), "group", "g", {"g": groups}, test=held, seed=3)
    assert torch.equal(split.test, torch.arange(150, 200)) and len(split.validation) == 30
    assert not set(groups[split.train]) & set(groups[split.validation])
    for fold in fold_splits(split, "group", 3, seed=0):
        assert not set(groups[fold.train]) & set(groups[fold.validation])


def test_global_random_state_is_left_alone() -> None:
    np.random.seed(0)  # noqa: NPY002 - the global state is what this test watches
    before = np.random.get_state()[1].tolist()  # noqa: NPY002
    split_rows(positions(), "group", seed=3)
    assert np.random.get_state()[1].tolist() == before  # noqa: NPY002


@pytest.mark.parametrize(
    "keys, parts",
    [
        ({"kind": "grup"}, ("split.kind", "'grup'", "'group'")),
        ({"kind": "time"}, ("split.kind", "'time'", "random, group, block, column")),
        ({"kind": "random", "by": "robot"}, ("split.by", "'robot'", "split.kind=group")),
        ({"kind": "group", "by": "robott"}, ("split.by", "'robott'", "'robot'")),
        ({"kind": "group", "by": "zzz"}, ("split.by", "'zzz'", "robot, gaps")),
        ({"kind": "group", "by": ["robot", "zzz"]}, ("split.by", "'zzz'")),
        ({"kind": "group", "by": "gaps"}, ("split.by", "'gaps'", "row 3")),
        ({"kind": "group", "by": "position"}, ("split.by", "'position'", "position:5mm")),
        ({"kind": "group", "by": "position:mm"}, ("split.by", "position:5mm")),
        ({"kind": "group", "by": "position:0mm"}, ("split.by", "position:5mm")),
        ({"kind": "group", "by": "position:5deg"}, ("split.by", "'deg'", "a length")),
        ({"kind": "column", "by": "robot", "test_values": [7.0]}, ("no row has 7 in 'robot'", "0, 1, 2, 3, 4, 5, 6")),
        ({"kind": "column", "by": "one", "test_values": [1.0]}, ("every row has one of them in 'one'",)),
        ({"kind": "column", "by": "gaps", "test_values": [1.0]}, ("split.by", "'gaps'", "row 3")),
        ({"kind": "column", "by": "robott", "test_values": [1.0]}, ("split.by", "did you mean 'robot'")),
        ({"kind": "column", "by": ["robot", "one"], "test_values": [1.0]}, ("one column",)),
        ({"kind": "column", "by": "robot"}, ("test_values go with split.kind=column",)),
        ({"kind": "group", "test_values": [1.0]}, ("test_values go with split.kind=column",)),
        ({"kind": "block", "test": torch.arange(200) < 9}, ("test rows that are given",)),
        ({"test": torch.arange(200) < 200}, ("0 rows beside the test rows", "no training row")),
        ({"test": 0.0}, ("split.test", "0 is not a share")),
        ({"test": 1.0}, ("split.test", "1 is not a share")),
        ({"test": float("nan")}, ("split.test", "nan is not a share")),
        ({"validation": 1.0}, ("split.validation",)),
        ({"validation": -0.1}, ("split.validation", "-0.1")),
        ({"kind": "group", "by": "one"}, ("1 groups are too few", "no training row")),
        ({"test": 0.999}, ("200 rows are too few", "no training row")),
        (
            {"kind": "block", "by": "halves", "test": 0.4, "validation": 0.1},
            ("2 groups of 200 rows", "no validation row"),
        ),
    ],
)
def test_bad_split(keys: dict[str, str | float | Sequence[str]], parts: tuple[str, ...]) -> None:
    columns = {"robot": np.arange(200.0) % 7, "gaps": np.where(np.arange(200) == 2, np.nan, 1.0), "one": np.ones(200)}
    columns["halves"] = (positions()[:, 0] > 0).double().numpy()
    with pytest.raises(InputError) as caught:
        split_rows(positions(), columns=columns, **keys)  # type: ignore[arg-type]
    assert all(part in str(caught.value) for part in parts), str(caught.value)


@pytest.mark.parametrize("kind, key", [("group", "split.by"), ("block", "split.kind")])
def test_pose_without_position(kind: str, key: str) -> None:
    with pytest.raises(InputError, match=key):
        split_rows(torch.zeros(50, 0), kind, "c" if kind == "block" else None, {"c": np.arange(50.0)})
