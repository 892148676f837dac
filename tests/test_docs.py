"""The pages of the documentation hold what the code holds."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parent.parent
DIAGNOSIS = ROOT / "ccnn_torch" / "diagnosis"
CONSTANTS = ROOT / "docs" / "explanation" / "diagnosis_constants.md"


def numeric_constants(path: Path) -> Iterator[tuple[str, str]]:
    """Names and value of every assignment of numbers to names in capitals, as the table writes them."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if not isinstance(node, ast.Assign):
            continue
        names = [name.id for name in ast.walk(node.targets[0]) if isinstance(name, ast.Name)]
        if not names or not all(name.lstrip("_").isupper() for name in names):
            continue
        text = ast.unparse(node.value)
        if re.fullmatch(r"[\d\s.,()eE*/+-]+|(2 \* )?LOG_PRIOR|math\.log\([\d.e-]+\)", text):
            yield ", ".join(names), text.strip("()") if isinstance(node.value, ast.Tuple) else text


def test_every_constant_of_the_diagnosis_is_in_the_table_with_its_value() -> None:
    table = re.findall(r"^\| `([^`]+)` \| `([^`]+)` \| `([^`]+)` \| .+ \| .+ \|$", CONSTANTS.read_text(), re.M)
    code = {
        (path.relative_to(DIAGNOSIS).with_suffix("").as_posix(), names, value)
        for path in DIAGNOSIS.rglob("*.py")
        if "page" not in path.parts
        for names, value in numeric_constants(path)
    }
    assert set(table) == code
    assert len(table) > 100
