"""Records that went wrong in any way, through every command that reads them."""

from __future__ import annotations

import pytest
from hypothesis import given, strategies as st

from fuzz.mutate import change_table, table_changes
from fuzz.oracle import judged

pytestmark = pytest.mark.fuzz
CASES = 8

_QUICK = ["save_models=false", "save_report=false", "--quiet"]
COMMANDS = [
    ["check", "--records", "r.csv", "--mechanism", "M"],
    ["run", "c.yaml", "records=r.csv", "mechanism=M", "methods=[constant]", "geometry=none", "out=o", *_QUICK],
    ["run", "c.yaml", "records=r.csv", "mechanism=M", "methods=[grnn]", "geometry=identify", "out=o", *_QUICK],
    ["run", "c.yaml", "records=r.csv", "mechanism=M", "methods=[constant]", "split.kind=block", "out=o", *_QUICK],
    ["identify", "c.yaml", "records=r.csv", "mechanism=M", "methods=[lm]", "save_report=false", "out=o", "--quiet"],
    ["new", "r.csv", "--mechanism", "M", "--units", "mm,deg", "--out", "n.yaml"],
    [
        "diagnose",
        "--records",
        "r.csv",
        "--mechanism",
        "M",
        "effects=[frame,joint_offset]",
        "network=false",
        "--out",
        "o",
    ],
]


@given(
    name=st.sampled_from(["tripod", "five_bar", "arm"]),
    command=st.sampled_from(COMMANDS),
    changes=table_changes,
    separator=st.sampled_from([",", ";", "\t"]),
    encoding=st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "cp1252"]),
)
def test_records(bases, fresh, name, command, changes, separator, encoding) -> None:
    cells = change_table(bases[name], changes)
    with fresh() as folder:
        text = "\n".join(separator.join(row) for row in cells)
        (folder / "r.csv").write_bytes(text.encode(encoding, errors="replace"))
        (folder / "c.yaml").write_text("name: fuzz\n")
        mechanism = "arm.yaml" if name == "arm" else name
        judged([word.replace("M", mechanism) if word in ("M", "mechanism=M") else word for word in command], folder)
