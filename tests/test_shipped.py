"""What the repository ships works as it stands: the README's example, the trained tripod compensator, the floors."""

from __future__ import annotations

import ast
import hashlib
import json
import runpy
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import torch
from frozen import frozen

from ccnn_torch.compensation import load_model
from ccnn_torch.simulation.case_study import build_case

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "ccnn_torch"
SHIPPED = ROOT / "checkpoints" / "tripod"

# A package imports only from lower floors; on its own floor only what stands before it here.
# A module may import those that stand before it; a folder stands where its longest entry is.
FLOORS = [
    [
        "doors",
        "version",
        "errors",
        "coordinates",
        "units",
        "display",
        "spelling",
        "files",
        "plugins",
        "numerics",
        "records",
    ],
    ["mechanisms", "pseudoerror"],
    ["learners/protocol", "training", "evolution", "learners", "effects"],
    ["identification/problems", "identification/solvers", "identification/identifiability", "identification/__init__"],
    ["evidence"],
    ["compensation"],
    ["diagnosis"],
    ["motion"],
    ["engine", "report", "run_folder", "config", "testing"],
    ["simulation", "planning", "verification/promise", "identification"],
    ["diagnosis/config", "diagnosis/page", "diagnosis/job"],
    ["motion/identified", "motion/compensate", "motion/job", "motion/__init__"],
    ["calibration", "sklearn", "study", "verification", "starter"],
    ["api", "cli", "__init__", "__main__"],
]


def test_the_readme_shows_the_quickstart_and_it_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    example = (ROOT / "experiments" / "quickstart.py").read_text()
    code = example.partition('"""\n\n')[2]
    assert f"```python\n{code}```" in (ROOT / "README.md").read_text()
    assert len([line for line in code.splitlines() if line.strip()]) <= 15
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(ROOT / "experiments" / "quickstart.py"))
    told = capsys.readouterr().out
    assert "before" in told and "command" in told
    assert (tmp_path / "runs" / "quickstart" / "model.onnx").is_file()


@pytest.mark.parametrize("name", ["model.safetensors", "model.onnx"])
def test_the_shipped_compensator_halves_the_error_of_the_machine_it_was_trained_on(name: str) -> None:
    card = json.loads((SHIPPED / "card.json").read_text())
    jsonschema.validate(card, frozen("card"))
    for file, digest in card["files"].items():
        assert hashlib.sha256((SHIPPED / file).read_bytes()).hexdigest() == digest
    model = load_model(SHIPPED / name)
    case = build_case("tripod")
    answer = model(case.joints.numpy())
    assert np.all(answer["inside_domain"])
    # The poses were measured with a noise of 1e-5 m in each joint.
    assert np.all((answer["deviation_sd"] > 0.7e-5) & (answer["deviation_sd"] < 2e-5))
    before = case.pose_error(case.joints).position
    after = case.pose_error(torch.as_tensor(answer["command"])).position
    # Without the machine's noise, so what is left is what the model has wrong; 206 µm before.
    assert float(after.square().mean().sqrt()) < 0.06 * float(before.square().mean().sqrt())


def test_imports_run_down_the_floors() -> None:
    order = [name for floor in FLOORS for name in floor]
    for path in sorted(PACKAGE.rglob("*.py")):
        here = _place(path.relative_to(PACKAGE).with_suffix("").as_posix(), order)
        for module in _imported(path):
            there = _place(module, order)
            assert order.index(there) <= order.index(here), f"{path.relative_to(ROOT)} imports {module}"


def _place(module: str, order: list[str]) -> str:
    """The longest entry of FLOORS that a module such as `learners/ccnn` belongs to."""
    parts = module.split("/")
    entries = ("/".join(parts[:length]) for length in range(len(parts), 0, -1))
    found = next((entry for entry in entries if entry in order), None)
    assert found, f"{module} stands on no floor; give it a place in FLOORS and in docs/architecture.md"
    return found


def _imported(path: Path) -> list[str]:
    """Modules of this package that a file imports when it is loaded, as `learners/ccnn`."""
    found = []
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("ccnn_torch."):
            module = node.module.removeprefix("ccnn_torch.").replace(".", "/")
            found.append(f"{module}/__init__" if (PACKAGE / module / "__init__.py").is_file() else module)
    return found
