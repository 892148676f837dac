"""Screens of the site: commands are run when it is built, and what they print is shown below them.

A page has them in blocks of the language `{screen}`, a command a line; all are run in `docs/_screens`, beside copies of
`experiments/` and `checkpoints/`, so that a page can show a picture as `../_screens/runs/NAME/plots/machine.svg`. The
block's number is the exit code that is expected, 0 without one. A line `head` or `cat` shows files.
"""

from __future__ import annotations

import io
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import redirect_stderr, redirect_stdout
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.errors import ExtensionError
from sphinx.util.docutils import SphinxDirective

HERE = Path(__file__).parent
FOLDER = HERE / "_screens"
PAGES = (HERE / "index.md", *sorted(HERE.glob("*/*.md")))
BLOCK = re.compile(r"^```\{screen\} *(\d*)\n(.*?)^```$", re.M | re.S)
WIDTH = "88"

screens: dict[str, str] = {}


def run_all() -> None:
    """Run the commands of all pages, two pages at a time, and keep what they print."""
    shutil.rmtree(FOLDER, ignore_errors=True)
    for name in ("experiments", "checkpoints"):
        shutil.copytree(HERE.parent / name, FOLDER / name, ignore=shutil.ignore_patterns("__pycache__"))
    pages: list[dict[str, int]] = []
    for page in PAGES:
        found = {text: int(code or 0) for code, text in BLOCK.findall(page.read_text(encoding="utf-8"))}
        # What several pages show is run once.
        pages.append({text: code for text, code in found.items() if not any(text in other for other in pages)})
    # Each process loads the package once. Spawned: a forked one shares locks with torch.
    with ProcessPoolExecutor(2, mp_context=get_context("spawn"), initializer=_begin) as pool:
        for shown in pool.map(_run_page, pages):
            screens.update(shown)


def _begin() -> None:
    """As on a terminal of this width, so that lines are wrapped; the package reads this when it is loaded."""
    os.environ |= {"COLUMNS": WIDTH, "TTY_COMPATIBLE": "1"}
    os.chdir(FOLDER)


def _run_page(blocks: Mapping[str, int]) -> dict[str, str]:
    return {text: _run(text, code) for text, code in blocks.items()}


def _run(text: str, code: int) -> str:
    shown = []
    for command in text.replace("\\\n", "\0").splitlines():
        shown.append(f"$ {command}".replace("\0", "\\\n"))
        words = shlex.split(command.replace("\0", " "), comments=True)
        done, out, err = _called(words[1:]) if words[0] == "ccnn" else _started(words)
        if done != code:
            raise ExtensionError(f"{command}: exit code {done}\n{out}{err}")
        said = out + (err if code == 2 else "")
        shown += [line.rstrip() for line in re.sub(r"\x1b\[[0-9;]*m", "", said).splitlines()]
    return "\n".join(shown)


def _called(words: list[str]) -> tuple[int, str, str]:
    from ccnn_torch.cli.application import main

    sys.argv, code = ["ccnn", *words], 0
    with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
        try:
            main()
        except SystemExit as ended:
            code = int(ended.code or 0)
    return code, out.getvalue(), err.getvalue()


def _started(words: list[str]) -> tuple[int, str, str]:
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout, done.stderr


class Screen(SphinxDirective):
    """A block of commands with what they print."""

    has_content = True
    optional_arguments = 1

    def run(self) -> list[nodes.Node]:
        # What is printed changes with the package, whether or not the page does.
        self.env.note_reread()
        text = "\n".join(self.content) + "\n"
        return [nodes.literal_block(screens[text], screens[text], language="console", classes=["screen"])]


def setup(app: Any) -> dict[str, bool]:
    app.add_directive("screen", Screen)
    app.connect("builder-inited", lambda app: run_all())
    return {"parallel_read_safe": False}
