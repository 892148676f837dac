"""Words that a shell completes: cheap ones, without torch."""

from __future__ import annotations

__all__ = ["complete_mechanism"]

# The registry's names; a test holds this list to it, so that completion need not load torch.
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
    """Built-in mechanisms that begin so."""
    return [name for name in MECHANISMS if name.startswith(incomplete)]
