"""The file of a six-axis arm, for tests that write one."""

from __future__ import annotations

import numpy as np

A, D = [0, -0.6, -0.55, 0, 0, 0], [0.13, 0, 0, 0.11, 0.11, 0.1]
ALPHA = [np.pi / 2, 0, 0, np.pi / 2, -np.pi / 2, 0]


def arm_text(more: str = "base_frame: unknown\ntool_frame: unknown\n") -> str:
    """Denavit-Hartenberg parameters [m, rad], and further lines."""
    return (
        "dof: 6\nconvention: standard Denavit-Hartenberg\nunits: {length: m, angle: rad}\n"
        f"a: {A}\nalpha: {ALPHA}\nd: {D}\ntheta: [0, 0, 0, 0, 0, 0]\n{more}"
    )
