"""`results.csv`: every figure of `results.json` as one row, in SI."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from ccnn_torch.report.results.base import Spread
from ccnn_torch.report.results.run import Before, MethodPose, Mse, RmsMax, RunResults

HEADER = ("method", "split", "quantity", "joint", "unit", "median", "low", "high")
Row = tuple[str, str, str, str, str, float | None, float | None, float | None]
_OF_A_METHOD = (
    ("ratio_to_floor", "test", "1"),
    ("coverage", "test", "1"),
    ("seconds", "", "s"),
    ("evaluations", "", "1"),
    ("converged", "", "1"),
)


def long_table(results: RunResults) -> Iterator[Row]:
    """Rows of (method, split, quantity, joint, unit, median, low, high); `joint` is empty where it means nothing."""
    units = {joint.name: joint.unit for joint in results.joints}
    units["all"] = results.joints[0].unit
    best = results.best_method or ""

    def row(method: str, split: str, quantity: str, joint: str, unit: str, spread: Spread) -> Row:
        return (method, split, quantity, joint, unit, spread.median, spread.low, spread.high)

    def pose(method: str, kind: str, unit: str, figures: RmsMax | MethodPose) -> Iterator[Row]:
        for measure in ("rms", "max"):
            yield row(method, "test", f"{kind}_{measure}", "", unit, figures[measure])

    def before(split: str, figures: dict[str, Before]) -> Iterator[Row]:
        for joint, block in figures.items():
            for quantity, spread in block.spread.items():
                yield row("before", split, quantity, joint, units[joint], spread)

    yield from before("train", results.before_train or {})
    yield from before("test", results.before)
    methods = results.methods
    tests = {name: method.test for name, method in methods.items()}
    tests["constant"] = tests.get("constant") or results.constant.test
    errors: dict[str, Mapping[str, Mse] | None] = dict(tests)
    if results.floor is not None:
        errors |= {f"floor_{kind}": results.floor[kind] for kind in ("realised", "expected", "with_unlearnable")}
    for method, joints in errors.items():
        for joint, measures in (joints or {}).items():
            for quantity, spread in measures:
                unit = units[joint] if quantity == "mae" or units[joint] == "1" else f"{units[joint]}^2"
                yield row(method, "test", quantity, joint, unit, spread)
    trained = {name: block for name, block in methods.items() if block.test is not None}
    for method, block in ({"constant": results.constant} | trained).items():
        for quantity, split, unit in _OF_A_METHOD:
            if block[quantity] is not None:
                yield row(method, split, quantity, "", unit, block[quantity])
        for joint, spread in block.sd.items():
            yield row(method, "test", "sd", joint, units[joint], spread)
        for kind, left in block.pose.items():
            # That of the best method is written below, with the error before compensation.
            if left is not None and method != best:
                yield from pose(method, kind, left.unit, left)
    for kind, figures in results.pose:
        for when in ("before", "after", "explained", "geometry", "effects", "not_compensable"):
            if figures is not None and figures[when] is not None:
                yield from pose(best if when == "after" else when, kind, figures.unit, figures[when])
