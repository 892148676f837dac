"""What drives each cause, in the words of a verdict that finds no effect for it."""

from __future__ import annotations

from ccnn_validation.blind.deviation import Deviation
from ccnn_validation.blind.machines import BlindMachine

__all__ = ["own_drivers"]

_SHARE = 0.1
"""A joint that is moved by less than this share of the one that is moved most does not count."""


def own_drivers(cause: str, wrong: Deviation, machine: BlindMachine) -> tuple[str, ...]:
    """Drivers of a cause by its formula; () where it is driven by the place alone, as many causes are."""
    moved = wrong.joints.abs().amax(0)
    numbers = [i + 1 for i in range(len(moved)) if float(moved[i]) > _SHARE * float(moved.max()) > 0]
    if cause in ("backlash", "friction"):
        return tuple(f"direction {i}" for i in numbers)
    if cause == "transmission":
        return tuple(f"joint q{i}" for i in numbers)
    if cause == "compliance":
        names = [c.name for c, load in zip(machine.mechanism.pose, machine.load.tolist(), strict=True) if load > 0]
        return tuple(f"load {name}" for name in names)
    # A body that follows the hall slowly is as much a matter of time.
    return {"thermal": ("temperature", "time"), "drift": ("time",)}.get(cause, ())
