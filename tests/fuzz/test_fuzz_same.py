"""The same records written in other ways give the same figures: no silent wrong number."""

from __future__ import annotations

import json
import math

import pytest
from hypothesis import given, strategies as st

from fuzz.oracle import judged

pytestmark = pytest.mark.fuzz
CASES = 1
FACTORS = {"m": ("mm", 1e3), "rad": ("deg", 180 / math.pi)}


def figures(folder, text, name, encoding="utf-8", effects="none"):
    (folder / "r.csv").write_bytes(text.encode(encoding))
    (folder / "c.yaml").write_text("name: same\n")
    mechanism = "arm.yaml" if name == "arm" else name
    # To identify the links of an arm takes seconds; its frames are fitted in either case.
    geometry = "none" if name == "arm" else "identify"
    words = ["run", "c.yaml", "records=r.csv", f"mechanism={mechanism}", "methods=[constant]", f"geometry={geometry}"]
    words.append(f"effects={effects}")
    out = f"o{len(list(folder.iterdir()))}"
    outcome = judged([*words, f"out={out}", "save_models=false", "save_report=false", "--quiet"], folder)
    assert outcome.code == 0, outcome
    position = json.loads((folder / out / "results.json").read_text())["pose"]["position"]
    return [position[key]["rms"]["median"] for key in ("before", "after")]


@given(
    name=st.sampled_from(["tripod", "five_bar", "arm"]),
    other_units=st.booleans(),
    order=st.randoms(use_true_random=False),
    separator=st.sampled_from([",", ";", "\t"]),
    decimal_comma=st.booleans(),
    encoding=st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "cp1252"]),
)
def test_the_same_rows(bases, fresh, name, other_units, order, separator, decimal_comma, encoding) -> None:
    cells = bases[name]
    columns = list(map(list, zip(*cells, strict=True)))
    if other_units:
        for column in columns:
            label, _, unit = column[0].rstrip("]").partition("[")
            if unit in FACTORS:
                other, factor = FACTORS[unit]
                column[:] = [f"{label}[{other}]", *(repr(float(v) * factor) for v in column[1:])]
    order.shuffle(columns)
    changed = separator.join if not decimal_comma or separator == "," else None
    lines = [(changed or separator.join)(row) for row in zip(*columns, strict=True)]
    if changed is None:
        lines = [lines[0], *(line.replace(".", ",") for line in lines[1:])]
    with fresh() as folder:
        plain = figures(folder, "\n".join(",".join(row) for row in cells), name)
        other = figures(folder, "\n".join(lines), name, encoding)
    assert other == pytest.approx(plain, rel=1e-6, abs=1e-12)


@given(row=st.integers(0, 29), channel=st.integers(0, 2), size=st.sampled_from([0.05, -0.2, 0.5]))
def test_one_gross_outlier_in_training_moves_no_figure(bases, fresh, row, channel, size) -> None:
    cells = [list(line) for line in bases["arm"]]
    with fresh() as folder:
        plain = figures(folder, "\n".join(",".join(line) for line in cells), "arm", effects="[joint_offset]")
        place = cells[0].index(["x[m]", "y[m]", "z[m]"][channel])
        cells[row + 1][place] = repr(float(cells[row + 1][place]) + size)
        moved = figures(folder, "\n".join(",".join(line) for line in cells), "arm", effects="[joint_offset]")
    # In training, a fit has one row in 21 less, which moves a figure by some per cent; held out, the row stands in the
    # figures as it was measured, which only makes them larger.
    assert moved[0] == pytest.approx(plain[0], rel=0.15) or moved[0] > 0.9 * abs(size) / math.sqrt(9)
