"""Effects of motion of one's own: what is refused, and the check of the protocol."""

from __future__ import annotations

from dataclasses import replace

import pytest

from ccnn_torch.errors import InputError
from ccnn_torch.motion.effects import EFFECTS, Facts, MotionEffect, Number
from ccnn_torch.motion.effects.protocol import add
from ccnn_torch.motion.library import library_of
from ccnn_torch.testing import check_motion_effect

DRAG = MotionEffect("drag", lambda axis: (Number("drag", "viscous", 0.05, (add("viscous"),)),))


@pytest.mark.parametrize("name", EFFECTS)
def test_every_effect_of_the_library_keeps_to_the_protocol(name: str) -> None:
    if name == "payload":
        # At the tool of a model that tells what it weighs there, too.
        library_of([EFFECTS[name]], [Facts("rad", {}, carried=0.02, heaviest=10.0)])
    check_motion_effect(name)


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"numbers": lambda axis: (Number("drag", "viscous", 0.05, (add("viscos"),)),)}, "'viscous' is the nearest"),
        ({"numbers": lambda axis: (Number("drag", "viscous", 0.0, (add("viscous"),)),)}, "a finite scale above 0"),
        ({"numbers": lambda axis: ()}, "at least one Number"),
        (
            {"numbers": lambda axis: 1 / 0},
            r"numbers fails at line \d+ of .*test_own_effect.py: ZeroDiv",
        ),
        ({"shapes": lambda axis: ()}, "at least one dict"),
        ({"shapes": lambda axis: ({"play": float("nan")},)}, "nor a finite value of a parameter"),
        ({"missing": lambda axis: None}, "missing must return a text"),
        ({"numbers": lambda axis: (Number("drag", "1", 0.05, (add("thermal", 0.0),)),)}, "moves nothing"),
    ],
)
def test_a_mistake_in_an_effect_is_one_sentence(changed: dict[str, object], sentence: str) -> None:
    check_motion_effect(DRAG)
    wrong = replace(DRAG, **changed)  # type: ignore[arg-type]
    with pytest.raises(AssertionError, match=sentence):
        check_motion_effect(wrong)
    if sentence != "moves nothing":
        with pytest.raises(InputError, match=sentence):
            library_of([wrong], [Facts("rad", {})])
