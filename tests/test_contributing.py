"""The worked examples of CONTRIBUTING.md are lines of the files that they name."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parent.parent


def test_the_examples_are_lines_of_the_code() -> None:
    examples = re.findall(r"<!-- code: (\S+) -->\n```python\n(.*?)```", (ROOT / "CONTRIBUTING.md").read_text(), re.S)
    assert len(examples) == 4
    for path, code in examples:
        lines = {line.strip() for line in (ROOT / path).read_text().splitlines()}
        shown = [line.strip() for line in code.splitlines() if line.strip() and "…" not in line]
        assert len(shown) > 5 and not [line for line in shown if line not in lines], path
