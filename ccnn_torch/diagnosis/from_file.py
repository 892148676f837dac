"""The effects of a diagnosis.json, built again to be compensated."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ccnn_torch.effects import EFFECTS, OUTLIER, Coefficient, Effect, Shape, Situation, make_effect
from ccnn_torch.effects.time import ROW, FrameDrift
from ccnn_torch.errors import InputError
from ccnn_torch.files.read import parse_json, read_text
from ccnn_torch.units import LARGEST

TRAINING_ROWS = "the training rows"
"""Where a verdict is from that no file holds."""
# A diagnosis has some 100 kB.
_LARGEST = 100_000_000


@dataclass(frozen=True)
class Known:
    """An effect with the numbers of a file.

    Attributes:
        shape: `h` [SI].
        coefficients: `m` [SI]; 0 where the file names none.
        used: numbers of the coefficients that the file names, ascending.
    """

    effect: Effect
    shape: Tensor
    coefficients: Tensor
    used: tuple[int, ...]


@dataclass(frozen=True)
class Verdict:
    """The verdict of a file.

    Attributes:
        path: the file.
        gravity: `3` [m/s²] as it was diagnosed with, or None where the file does not say.
        effects: those of the verdict in its order, by name, with their numbers: name -> value [SI].
        outside: whether something is there beside them that no effect describes.
        covariates: those that varied in the rows that were diagnosed.
    """

    path: str
    gravity: Tensor | None
    effects: tuple[tuple[str, Mapping[str, float]], ...]
    outside: bool = False
    covariates: tuple[str, ...] = ()

    def on(self, situation: Situation, identify: bool = False) -> tuple[list[Known], list[str]]:
        """The effects on a machine and rows, for a controller that knows one row and not what was before it.

        Without a column of times there is no history: a thermal lag is none, the machine has settled. Effects that are
        nothing without it (drift) are refused.

        Args:
            situation: rows with all their covariates, time as well where it was measured.
            identify: whether all parameters are identified beside: effects that are a part of these are left out.

        Returns:
            The effects, whose situation is `one_row_at_a_time`; and notes on what was left out, one sentence each.

        Raises:
            InputError: the machine or its covariates do not fit what the file names, or an effect needs history.
        """
        alone, found, notes = one_row_at_a_time(situation), [], []
        if self.outside:
            notes.append("Beside the effects something is there that none describes: it is left to the network.")
        for name, values in self.effects:
            effect = make_effect(name)
            if identify and effect.kind == "parameters":
                notes.append("The verdict's geometry is left to geometry=identify, which fits all parameters.")
                continue
            key = f"{self.path}: effects, {name}"
            lacking = effect.missing(situation.mechanism, [*situation.covariates])
            if lacking:
                raise InputError(f"{key}: needs {lacking}, which is no input of this run; add it to covariates")
            history = effect.missing(alone.mechanism, [*alone.covariates])
            if effect.ordered or history:
                need = history or "the rows in the order measured"
                raise InputError(
                    f"{key}: needs {need}, and a command is one row that knows nothing before it; diagnose again "
                    f"without {name} (--effects) and let the network learn it, or calibrate anew when it has drifted"
                )
            whole = _named([*effect.coefficients(situation), *effect.shapes(situation)])
            strange = [n for n in values if n not in whole]
            if strange:
                raise InputError(
                    f"{key}, parameters: '{strange[0]}' is no parameter of {name} on {situation.mechanism.name} with "
                    f"the covariates of this run; give the mechanism and covariates that were diagnosed"
                    + (f" ({', '.join(self.covariates)})" if self.covariates else "")
                )
            known = with_numbers(effect, alone, values)
            left = [n for n in values if n not in _named([*effect.coefficients(alone), *effect.shapes(alone)])]
            if left:
                notes.append(
                    f"What {name} has of {', '.join(left)} comes from before a row, which a command does not know: the "
                    "machine is taken as settled under its covariates."
                )
            found.append(known)
        return found, notes

    def of_machine(self) -> tuple[Verdict, Mapping[str, float] | None]:
        """The same without a drift of the measuring frame, which is none of the machine; and the numbers of that."""
        drift = dict(self.effects).get(FrameDrift.name)
        return replace(self, effects=tuple(e for e in self.effects if e[0] != FrameDrift.name)), drift


def in_time(situation: Situation, time: Tensor) -> Situation:
    """Isolated rows that still have a place in the time in which a measuring frame drifts.

    Args:
        situation: rows as `one_row_at_a_time` gives them.
        time: since the first row [s], or the numbers of the rows, `s`.
    """
    return replace(situation, covariates={**situation.covariates, ROW: time})


def one_row_at_a_time(situation: Situation) -> Situation:
    """The same rows as if each were isolated: without their times."""
    covariates = {name: value for name, value in situation.covariates.items() if name not in ("time", ROW)}
    return replace(situation, covariates=covariates)


def read_verdict(path: str | Path, mechanism: str, joints: Sequence[str]) -> Verdict:
    """Read a `diagnosis.json`.

    Args:
        path: the file.
        mechanism: name of the mechanism that it is to be used on.
        joints: names of its joints.

    Raises:
        InputError: there is no such file, it is none of `ccnn diagnose`, it is of another machine, or its verdict names
            no effect that could be compensated.
    """
    content = parse_json(read_text(path, _LARGEST, "give effects=from:DIR/diagnosis.json"), str(path))
    found = _verdict_of(content, str(path), mechanism, joints)
    _refuse(str(path), *found)
    return found[0]


def usable_verdict(verdict: Verdict, situation: Situation) -> tuple[Verdict | None, list[str]]:
    """The effects that a model file can hold, and notes on those left out; None where there is none.

    Args:
        situation: rows, with the covariates that were recorded.
    """
    notes, kept = not_held_notes([name for name, _ in verdict.effects]), []
    for one in verdict.effects:
        try:
            if one[0] != OUTLIER and _held(one[0]):
                replace(verdict, effects=(one,), outside=False).on(situation)
                kept.append(one)
        except InputError as reason:
            notes.append(f"{str(reason).removeprefix(f'{verdict.path}: effects, ')}.")
    return (replace(verdict, effects=tuple(kept)) if kept else None), notes


def _verdict_of(
    content: Any, path: str, mechanism: str, joints: Sequence[str]
) -> tuple[Verdict, bool, Mapping[str, Any]]:
    """The verdict as it stands, whether it is that nothing is wrong, and the effects that are listed."""
    try:
        verdict = content["verdict"]
        names, outside, nothing = list(verdict["effects"]), bool(verdict["outside_library"]), bool(verdict["none"])
        listed = {
            str(e["name"]): {str(n): _number(p["value"]) for n, p in e["parameters"].items()}
            for e in content["effects"]
        }
        machine = content.get("mechanism") or {}
        gravity = None if machine.get("gravity") is None else [_number(g) for g in machine["gravity"]]
        theirs = [str(j) for j in machine.get("joints") or joints]
        covariates = tuple(str(c) for c in content.get("where", {}).get("covariates", {}))
    except (KeyError, TypeError, AttributeError, ValueError, OverflowError):
        raise InputError(f"{path}: is no diagnosis; give the diagnosis.json that ccnn diagnose wrote") from None
    if machine and (machine.get("name") != mechanism or theirs != [*joints]):
        raise InputError(
            f"{path}: mechanism: was diagnosed on {machine.get('name')} with the joints {', '.join(theirs)}, and this "
            f"run has {mechanism} with {', '.join(joints)}; give the same mechanism"
        )
    down = None if gravity is None else torch.tensor(gravity, dtype=torch.float64)
    effects = tuple((name, listed.get(name, {})) for name in names)
    return Verdict(path, down, effects, outside, covariates), nothing, listed


def _refuse(path: str, verdict: Verdict, nothing: bool, listed: Mapping[str, Any]) -> None:
    """Raise InputError where a verdict has no effects to take."""
    names, outside = [name for name, _ in verdict.effects], verdict.outside
    key, remedy = f"{path}: verdict", "write effects=none"
    if nothing:
        raise InputError(f"{key}: none: the gap is no more than the noise, so there is no effect to take; {remedy}")
    if outside and not names:
        raise InputError(
            f"{key}: outside_library: something is there that no effect describes, so none is taken; {remedy} and let "
            "the network learn it"
        )
    if OUTLIER in names:
        raise InputError(f"{key}: effects: bad rows are the only finding, so there is no effect to take; {remedy}")
    if not names:
        raise InputError(f"{key}: effects: names no effect; {remedy}")
    for name in names:
        if not _held(name):
            raise InputError(
                f"{key}: effects: '{name}' is no effect of this version's library, which a model file could hold; "
                f"diagnose again with the library's (--effects), or {remedy} and let the network learn it"
            )
        if name not in listed:
            raise InputError(f"{path}: effects: has no entry '{name}', which the verdict names; diagnose again")


def not_held_notes(names: Sequence[str]) -> list[str]:
    """A sentence for a verdict with effects that `read_verdict` refuses; names: of the verdict."""
    others = [name for name in names if name != OUTLIER and not _held(name)]
    if not others:
        return []
    return [
        f"{' and '.join(others)}: no effect of the library, and a compensator of effects=from:… (ccnn run) can hold "
        "only those; identify the machine's parameters (geometry=identify), let its network learn the gap "
        "(effects=none), or put it into the model that commands are made with"
    ]


def _held(name: str) -> bool:
    """Whether a model file could hold an effect: its code comes with this package, and its name is all that is kept."""
    return name in EFFECTS


def with_numbers(effect: Effect, situation: Situation, values: Mapping[str, float]) -> Known:
    """An effect with numbers by name [SI]; situation: rows as `one_row_at_a_time` or `in_time` gives them."""
    coefficients, shapes = effect.coefficients(situation), effect.shapes(situation)
    middles = [s.grid[len(s.grid) // 2] for s in shapes]
    return Known(
        effect,
        torch.tensor([values.get(s.name, m) for s, m in zip(shapes, middles, strict=True)], dtype=torch.float64),
        torch.tensor([values.get(c.name, 0.0) for c in coefficients], dtype=torch.float64),
        tuple(i for i, c in enumerate(coefficients) if c.name in values),
    )


def _named(parameters: Iterable[Coefficient | Shape]) -> set[str]:
    return {p.name for p in parameters}


def _number(value: Any) -> float:
    """A finite number of a plausible size, or ValueError."""
    number = float(value)
    if not abs(number) <= LARGEST:
        raise ValueError(value)
    return number
