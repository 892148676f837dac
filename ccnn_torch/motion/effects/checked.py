"""Whether an effect of motion is one: what a file of the user's may have wrong, in one sentence."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ccnn_torch.errors import InputError
from ccnn_torch.motion.effects.bodies import CARRIED
from ccnn_torch.motion.effects.protocol import Act, Facts, MotionEffect, Number
from ccnn_torch.motion.effects.registry import OWN
from ccnn_torch.motion.stage import ABSENT
from ccnn_torch.spelling import nearest


def refuse_wrong_effect(effect: MotionEffect, facts: Sequence[Facts]) -> None:
    """Raise `InputError` where an effect does not keep to `MotionEffect` on the axes of a machine."""
    for i, axis in enumerate(facts):
        where = f"effect '{effect.name}', joint {i + 1}"
        parts = {}
        for call in ("missing", "numbers", "shapes"):
            try:
                parts[call] = getattr(effect, call)(axis)
            # A user's code may raise any exception.
            except Exception as error:
                raise InputError(f"{where}: {call} fails: {type(error).__name__}: {error}") from error
        if not isinstance(parts["missing"], str):
            raise InputError(
                f"{where}: missing must return a text, empty where nothing lacks, not {parts['missing']!r}"
            )
        names = [_name_of(where, number) for number in parts["numbers"]]
        if not names or len({*names}) < len(names):
            raise InputError(f"{where}: numbers must return at least one Number, each with a name of its own")
        _refuse_shapes(where, parts["shapes"], {*names})


def _name_of(where: str, number: Any) -> str:
    if not isinstance(number, Number):
        raise InputError(f"{where}: numbers must return values of Number, not {number!r}")
    if not (math.isfinite(number.scale) and number.scale > 0 and math.isfinite(number.start)):
        raise InputError(f"{where}: '{number.name}' needs a finite scale above 0 and a finite start")
    for act in number.acts:
        fine = isinstance(act, Act) and act.how in ("add", "factor") and math.isfinite(act.factor)
        if not fine or not (act.parameter in ABSENT or act.parameter == CARRIED or act.parameter.startswith(OWN)):
            near = nearest(act.parameter, list(ABSENT)) if isinstance(act, Act) else None
            hint = f"; '{near}' is the nearest" if near else ""
            raise InputError(f"{where}: '{number.name}' acts by {act!r}, which is on no parameter of an axis{hint}")
    return number.name


def _refuse_shapes(where: str, shapes: Any, numbers: set[str]) -> None:
    if not isinstance(shapes, Sequence) or not shapes or not all(isinstance(s, Mapping) for s in shapes):
        raise InputError(f"{where}: shapes must return at least one dict, which may be empty, not {shapes!r}")
    for key, value in (item for shape in shapes for item in shape.items()):
        known = key in numbers or (key in ABSENT and value is not None)
        if not known or not (value is None or math.isfinite(value)):
            raise InputError(
                f"{where}: the shape {{'{key}': {value}}} is neither a start of one of its numbers nor a finite value "
                "of a parameter of an axis"
            )
