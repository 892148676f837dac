"""`ccnn picture RUN_DIR OUT.png`: one wide picture of a run, for a README or a slide."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def picture(
    run_dir: Annotated[Path, typer.Argument(help="Folder of a finished run.")],
    out: Annotated[Path, typer.Argument(help="Where to write; a .png and a .svg are made.")],
    joint: Annotated[str | None, typer.Option(help="Joint to show; by default the one with the largest error.")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing.")] = False,
) -> None:
    """Draw a joint's error and the pose error over the workspace, before and after compensation.

    Example:

    ccnn picture runs/tripod docs/picture.png --joint q3
    """
    from ccnn_torch.calibration.page.report import make_picture
    from ccnn_torch.report.screen import say

    caption = make_picture(run_dir, out, joint)
    if not quiet:
        say(caption)
