"""The pages of the documentation hold what the code holds."""

from __future__ import annotations

import ast
import inspect
import re
import runpy
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer

from ccnn_torch.cli.application import app
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.mechanisms.registry import REGISTRY
from ccnn_torch.motion.servo import KEYS

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "ccnn_torch"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), *sorted((ROOT / "docs").glob("*/*.md"))]
TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
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
        if re.fullmatch(
            r"[\d\s.,()eE*/+-]+|(2 \* )?OUTSIDE|[\d\s(),/-]*_TAIL[\s/,\d_TAIL()-]*|math\.log\([\d.e-]+\)", text
        ):
            parts = node.value.elts if isinstance(node.value, ast.Tuple) else [node.value]
            yield ", ".join(names), ", ".join(map(ast.unparse, parts))


def test_every_constant_of_the_diagnosis_is_in_the_table_with_its_value() -> None:
    table = re.findall(r"^\| `([^`]+)` \| `([^`]+)` \| `([^`]+)` \| .+ \| .+ \|$", CONSTANTS.read_text(), re.M)
    code = {
        (path.relative_to(PACKAGE).with_suffix("").as_posix(), names, value)
        for pattern in ("evidence/*.py", "diagnosis/**/*.py", "motion/*.py")
        for path in PACKAGE.glob(pattern)
        if "page" not in path.relative_to(PACKAGE).parts
        for names, value in numeric_constants(path)
    }
    assert set(table) == code
    assert len(table) > 100


def test_the_table_of_parallel_machines_is_that_of_the_registry() -> None:
    """Joints, pose, keys and a leg's parameters of each; and the table of conventions has the same machines."""
    page = (ROOT / "docs" / "how_to" / "mechanisms.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| (q1[^|]+) \| ([^|]+) \| ([^|]+) \| ([^|]+) \|$", page, re.M)
    conventions = re.findall(r"^\| `(\w+)` \| [^|]+ \| [^|]+ \| [^|]+ \|$", page, re.M)
    wanted = [name for name in REGISTRY if name not in ("serial", "framed", "partial", "instrument", "pair", "machine")]
    assert sorted(row[0] for row in rows) == sorted(conventions) == sorted(wanted)
    for name, joints, pose, keys, parameters in rows:
        machine = load_mechanism(name)
        first, *_, last = (joint.name for joint in machine.joints)
        between = ".." if len(machine.joints) > 2 else ", "
        assert joints == f"{first}{between}{last} [{machine.joints[0].unit}]"
        assert re.findall(r"\w+(?=[,\s])", re.sub(r"\[\w+\]", ",", pose)) == [c.name for c in machine.pose]
        assert keys.split(", ") == [*inspect.signature(REGISTRY[name]).parameters]
        shown = [p for p in parameters.partition(";")[0].split(", ") if p != "none"]
        legs = {g.name for g in machine.geometry if g.leg == 1}
        ones = [{p[:k] + "1" + p[k + 1 :] for k, mark in enumerate(p) if mark == "i"} & legs for p in shown]
        assert all(map(len, ones)) and set().union(*ones) == legs


def test_the_table_of_the_servo_has_the_keys_with_their_units() -> None:
    page = (ROOT / "docs" / "how_to" / "motion.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| (\S+) \| (.+) \|$", page.partition("### Keys of the servo")[2], re.M)
    shown = {key: f"{meaning} [{unit}]".replace("·", "*").replace("\\|", "|") for key, unit, meaning in rows}
    assert {key: shown[key] for key in KEYS} == KEYS


def blocks(page: Path, language: str) -> list[str]:
    """The fenced blocks of a page in one language."""
    fenced = re.findall(r"^```(\S*)\n(.*?)^```$", page.read_text(encoding="utf-8"), re.M | re.S)
    return [text for written, text in fenced if written == language]


@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
def test_python_in_tutorials_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    for number, code in enumerate(blocks(page, "python")):
        file = tmp_path / f"block_{number}.py"
        file.write_text(code, encoding="utf-8")
        runpy.run_path(str(file))


def test_every_command_on_the_pages_is_one_that_there_is() -> None:
    group = typer.main.get_command(app)
    parsed = 0
    for page in PAGES:
        if page.parent.name == "reference":
            continue
        text = "\n".join(blocks(page, "bash") + blocks(page, "{screen}") + blocks(page, ""))
        for line in text.replace("\\\n", " ").splitlines():
            command = line.partition("&& ccnn ")[2] or (line[5:] if line.startswith("ccnn ") else "")
            if not command:
                continue
            name, *words = shlex.split(command, comments=True)
            assert name in group.commands, f"{page.name}: {line}"  # type: ignore[attr-defined]
            if "--help" not in words and "--keys" not in words:
                group.commands[name].make_context(name, words)  # type: ignore[attr-defined]
                parsed += 1
    assert parsed > 25


def test_every_public_name_has_one_line_in_the_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    from reference.generate import first_line, public_names

    lines = {f"{package}.{name}": first_line(thing) for package, own in public_names().items() for name, thing in own}
    assert len(lines) > 100
    for name, line in lines.items():
        assert line.endswith(".") and len(line) <= 140, f"{name}: {line}"
        assert not re.search(r"(^|[^\w`])_\w", line), f"{name}: {line}"
