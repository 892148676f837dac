"""A sweep: a config, and the values of the keys that vary."""

from __future__ import annotations

import hashlib
import itertools
import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from ccnn_torch.calibration.config import RunConfig
from ccnn_torch.engine import check_engine
from ccnn_torch.errors import InputError
from ccnn_torch.study.runs import Study

_LONGEST = 80
# Each job is checked before the first one starts, in some milliseconds.
_MOST = 2000


def load_sweep(path: str | Path | None, changes: Iterable[str], out: str | Path) -> Study:
    """Read a config and make a job of every combination of values.

    Args:
        path: the config of a run; None for defaults.
        changes: `key=a,b,c` for a key that varies, `key=value` for all jobs; a list is one value in its brackets.
            `engine=…` is where the jobs run.
        out: folder of the sweep.

    Raises:
        InputError: a change or a job's config cannot be used; names the job.
    """
    every, varied, engine = [], {}, "local"
    for text in changes:
        key, equals, value = text.partition("=")
        options = _split(value)
        if key.strip() == "engine" and equals:
            try:
                engine = check_engine(value.strip())
            except ValueError as problem:
                raise InputError(f"engine: {problem}") from None
        elif len(options) == 1:
            every.append(text)
        elif "" in options or key in varied:
            raise InputError(f"'{text}': " + ("a value is empty" if "" in options else f"{key} is varied twice"))
        else:
            varied[key.strip()] = options
    if not varied:
        raise InputError(
            "name a key that varies, with its values: ccnn sweep CONFIG seed=0,1,2 methods=gp,ccnn --out DIR"
        )
    count = math.prod(len(options) for options in varied.values())
    if count > _MOST:
        product = " x ".join(f"{len(options)} of {key}" for key, options in varied.items())
        raise InputError(
            f"a sweep of {count:,} jobs ({product}): up to {_MOST:,} are taken; give fewer values, or several sweeps"
        )
    values: dict[str, tuple[str, ...]] = {}
    jobs: dict[str, RunConfig] = {}
    for combination in itertools.product(*varied.values()):
        words = [f"{key}={value}" for key, value in zip(varied, combination, strict=True)]
        name = _name(words)
        try:
            config = RunConfig.from_file(path, [*every, *words, f"out={Path(out) / name}", f"name={name}"])
        except InputError as problem:
            raise InputError(f"job {' '.join(words)}: {problem}") from None
        if name in jobs:
            raise InputError(f"job {' '.join(words)} is there twice; give each value once")
        values[name], jobs[name] = combination, config
    return Study("sweep", Path(out), jobs, engine, tuple(varied), values)


def _split(text: str) -> list[str]:
    """Values between commas outside of brackets and quotes."""
    parts, depth, quote = [""], 0, ""
    for letter in text:
        if quote or letter in "\"'":
            quote = "" if letter == quote else quote or letter
        depth += 0 if quote else (letter in "[{") - (letter in "]}")
        if letter == "," and depth == 0 and not quote:
            parts.append("")
        else:
            parts[-1] += letter
    return [part.strip() for part in parts]


def _name(words: Sequence[str]) -> str:
    """A folder's name that tells the values; with a hash where it would be too long."""
    text = "_".join(words)
    name = "_".join(re.sub(r"[^\w.]+", "-", word).strip("-.") for word in words)
    return name if len(name) <= _LONGEST else f"{name[:_LONGEST]}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"
