"""Stateless random numbers: a hash of (seed, stream, counter), so that a checkpoint holds a generation number only.

Each repeat's numbers come from its own seed alone: they do not change with the number of repeats beside it, the device,
or the order of calls. The mixer is splitmix64 (Steele, Lea and Flood, "Fast splittable pseudorandom number generators",
OOPSLA 2014), written in wrapping int64, which torch has on every device.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor


def _signed(word: int) -> int:
    return word - (1 << 64) if word >= 1 << 63 else word


_GOLDEN = _signed(0x9E3779B97F4A7C15)
_FIRST = _signed(0xBF58476D1CE4E5B9)
_SECOND = _signed(0x94D049BB133111EB)


def _mix_(word: Tensor) -> Tensor:
    """splitmix64's finaliser, in place. `>>` is arithmetic on int64: the mask makes it logical."""
    for shift, factor in ((30, _FIRST), (27, _SECOND)):
        word.bitwise_xor_((word >> shift).bitwise_and_((1 << (64 - shift)) - 1)).mul_(factor)
    return word.bitwise_xor_((word >> 31).bitwise_and_((1 << 33) - 1))


def uniform(seeds: Tensor, stream: int, counter: int, shape: tuple[int, ...]) -> Tensor:
    """Uniform numbers in the open interval (0, 1), 32 bits each, float64.

    Two numbers are cut from every 64-bit word: 32 bits are plenty for choices and for starting weights, and it halves
    the cost.

    Args:
        seeds: one a repeat, `r`, int64.
        stream: which use the numbers are for; streams are independent of each other.
        counter: the generation (or any step number).
        shape: what one repeat needs.

    Returns:
        `r x shape`.
    """
    key = _mix_(seeds * _GOLDEN + _GOLDEN)
    for part in (stream, counter):
        key = _mix_(key + _signed((part * 0xD1342543DE82EF95 + 0x9E3779B97F4A7C15) % (1 << 64)))
    count = math.prod(shape)
    words = torch.arange(1, (count + 1) // 2 + 1, device=seeds.device, dtype=torch.int64).mul_(_GOLDEN)
    halves = _mix_(key.unsqueeze(-1) + words).view(torch.int32)[:, :count]
    # Half a step is added so that neither 0 nor 1 appears: logarithms and powers of the numbers stay finite.
    return halves.to(torch.float64).mul_(2.0**-32).add_(0.5 + 2.0**-33).reshape(len(seeds), *shape)


def uniform_parts(seeds: Tensor, stream: int, counter: int, shapes: Sequence[tuple[int, ...]]) -> list[Tensor]:
    """The numbers of one call of `uniform`, cut to several shapes; each `r x shape`."""
    sizes = [math.prod(shape) for shape in shapes]
    parts = torch.split(uniform(seeds, stream, counter, (sum(sizes),)), sizes, dim=1)
    return [part.reshape(len(seeds), *shape) for part, shape in zip(parts, shapes, strict=True)]


def member_seeds(seeds: Tensor, members: int) -> Tensor:
    """Seeds for independent runs inside each repeat: the repeat's own for the first, hashes of it for the others.

    Args:
        seeds: `r`, int64.

    Returns:
        `r x members`, int64.
    """
    others = torch.arange(members, device=seeds.device, dtype=torch.int64)
    hashed = _mix_(_mix_(seeds.unsqueeze(-1) * _GOLDEN + _FIRST) + others * _GOLDEN)
    return torch.where(others == 0, seeds.unsqueeze(-1), hashed)
