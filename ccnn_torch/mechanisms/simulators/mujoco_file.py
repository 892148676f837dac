"""MJCF files of others: what would take all memory or time is refused before MuJoCo reads or steps it."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

from ccnn_torch.display import visible
from ccnn_torch.errors import InputError
from ccnn_torch.files.read import CONFIG_LIMIT
from ccnn_torch.files.xml_file import read_xml

# Machines have some tens of bodies; MuJoCo's memory for a step fails from some thousands.
_MOST_BODIES = 500
# Points of a height field, pixels of a texture.
_MOST_POINTS = 20_000_000
# Beyond any stiffness, mass or length of a machine in SI; a range may be wider.
_LARGEST = 1e12
# Of the time step [s]: MuJoCo's default is 0.002, and 0.01 is coarse.
_STEPS = (1e-5, 0.1)
# Attributes whose product is how many points or bodies an element makes.
_SIZES = {
    "hfield": ("nrow", "ncol"),
    "texture": ("width", "height"),
    "replicate": ("count",),
    "composite": ("count",),
    "flexcomp": ("count",),
}


def mujoco_spec(path: str | Path) -> tuple[Any, Any]:
    """MuJoCo, and the specification in an MJCF, to be changed and compiled by `compiled`.

    Raises:
        InputError: MuJoCo is not installed or does not take the file, a number is none or beyond any machine, it has
            too many bodies or points, or its time step is out of range.
    """
    try:
        import mujoco
    except ImportError:
        raise InputError(f"{path}: is simulated by MuJoCo: pip install 'ccnn-torch[mujoco]'") from None
    _check_text(Path(path))
    with _taken(mujoco, path):
        spec = mujoco.MjSpec.from_file(str(path))
    step = float(spec.option.timestep)
    if not _STEPS[0] <= step <= _STEPS[1]:
        raise InputError(f"{path}: option timestep is {step:g} s; write one from {_STEPS[0]:g} to {_STEPS[1]:g}")
    return mujoco, spec


def compiled(mujoco: Any, path: str | Path, spec: Any) -> Any:
    """The model of a specification.

    Raises:
        InputError: MuJoCo does not take it, or it is too large for a step.
    """
    with _taken(mujoco, path):
        model = spec.compile()
        mujoco.mj_forward(model, mujoco.MjData(model))
    return model


@contextmanager
def _taken(mujoco: Any, path: str | Path) -> Iterator[None]:
    try:
        with warnings.catch_warnings():
            # Of an inertia that no body has: what it then gives is no motion.
            warnings.filterwarnings("error", ".*Check model")
            yield
    except (ValueError, mujoco.FatalError, UserWarning) as reason:
        raise InputError(f"{path}: MuJoCo does not take it: {' '.join(str(reason).split())}") from None


def _check_text(path: Path) -> None:
    """Numbers and sizes of a file and those that it includes, before MuJoCo makes anything of them."""
    files, bodies = [path], 0
    for file in files:
        # Deep models would end the recursion of Python: elements wait in a list, with how often they are made.
        waiting = [(read_xml(str(file), CONFIG_LIMIT, "give the path of an MJCF"), 1)]
        while waiting:
            element, times = waiting.pop()
            _check_numbers(file, element)
            points = _points(element)
            bodies += times * (points if element.tag in ("composite", "flexcomp") else element.tag == "body")
            times *= points if element.tag == "replicate" else 1
            if bodies > _MOST_BODIES or times > _MOST_BODIES:
                raise InputError(f"{path}: has more than {_MOST_BODIES} bodies; leave out what does not move the pose")
            if points > _MOST_POINTS:
                raise InputError(f"{file}: a <{element.tag}> has {points:,} points; write at most {_MOST_POINTS:,}")
            included = path.parent / element.get("file", "") if element.tag in ("include", "model") else path
            if included.is_file() and included not in files:
                files.append(included)
            waiting.extend((child, times) for child in element)


def _check_numbers(file: Path, element: Element) -> None:
    for key, text in element.attrib.items():
        for word in text.split() if key != "name" and not key.endswith("range") else ():
            if not abs(_number(word)) <= _LARGEST:
                name = visible(element.get("name") or element.get("joint") or "", 40)
                raise InputError(
                    f"{file}: {key} of <{element.tag}{f' {name}' if name else ''}> is {visible(word, 40)}; write a "
                    f"number of at most {_LARGEST:g}"
                )


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return 0.0


def _points(element: Element) -> int:
    sizes = [_number(word) for key in _SIZES.get(element.tag, ()) for word in element.get(key, "").split()]
    return int(math.prod(max(size, 1.0) for size in sizes))
