"""The worked examples of CONTRIBUTING.md are lines of the files that they name, and these are there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


def test_the_examples_are_lines_of_the_code() -> None:
    examples = re.findall(r"<!-- code: (\S+) -->\n```python\n(.*?)```", (ROOT / "CONTRIBUTING.md").read_text(), re.S)
    assert len(examples) == 4
    for path, code in examples:
        lines = {line.strip() for line in (ROOT / path).read_text().splitlines()}
        shown = [line.strip() for line in code.splitlines() if line.strip() and "…" not in line]
        assert len(shown) > 5 and not [line for line in shown if line not in lines], path


@pytest.mark.parametrize("page", ["CONTRIBUTING.md", "docs/architecture.md"])
def test_every_path_that_is_named_is_there(page: str) -> None:
    prose = re.sub(r"^```.*?^```$", "", (ROOT / page).read_text(), flags=re.M | re.S)
    words = [word for code in re.findall(r"`([^`]+)`", prose) for word in code.split()]
    words += re.findall(r"\]\(([^)#:]+)\)", prose)
    # NAME stands for any name, path/to/file.py for a user's file, and a bare job.py for that of any folder.
    paths = {w for w in words if re.fullmatch(r"[\w.]+/[\w./]*", w) and "NAME" not in w and "path/to" not in w}
    assert len(paths) > 15
    # `rows/` of a paragraph on a folder is that in it.
    there = [f"/{place.relative_to(ROOT).as_posix()}" for place in (ROOT / "ccnn_torch").rglob("*")]
    ends = [f"/{path.rstrip('/')}" for path in paths if not (ROOT / path).exists()]
    assert not [end for end in ends if not any(place.endswith(end) for place in there)]
