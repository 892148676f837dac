"""Shell completion, without importing torch."""

from __future__ import annotations

# The registry's names, so that completion need not load torch; a test compares the two.
MECHANISMS = (
    "tripod",
    "machine_tool",
    "five_bar",
    "overconstrained_2dof",
    "stewart",
    "delta",
    "delta_linear",
)


def complete_mechanism(incomplete: str) -> list[str]:
    """Built-in mechanisms whose names begin with `incomplete`."""
    return [name for name in MECHANISMS if name.startswith(incomplete)]
