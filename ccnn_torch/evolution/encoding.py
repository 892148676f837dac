"""The paper's layered encoding: a bit string for the structure, a shorter real string for the weights (III-C).

Bits are in row order (row = node of the later layer). The weight string holds the weight of every 1, in the same
order; where the network has biases, a node's bias follows the weights of its row.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.evolution.genome import Genome, active


def encode(mask: Tensor, weight: Tensor) -> tuple[str, list[float]]:
    """One individual as strings.

    Args:
        mask: `out x in`, bool.
        weight: `out x in`, or `out x (in + 1)` with a bias column.

    Returns:
        Rows of bits separated by blanks (eqs. 8-10: ``"11 10 11"``), and the weights of the ones.
    """
    bits = " ".join("".join("1" if bit else "0" for bit in row) for row in mask.tolist())
    return bits, weight[active(Genome(mask, weight))].tolist()


def decode(bits: str, weights: Sequence[float], bias: bool = False) -> Genome:
    """Strings back to one individual; inverse of `encode`.

    Raises:
        ValueError: the rows differ in length, a sign is neither 0 nor 1, or the number of weights is not the number of
            ones (plus one a row with biases).
    """
    rows = bits.split()
    if not rows or len({len(row) for row in rows}) != 1 or set("".join(rows)) - {"0", "1"}:
        raise ValueError(f"bits must be rows of 0 and 1 of equal length separated by blanks, got {bits!r}")
    mask = torch.tensor([[bit == "1" for bit in row] for row in rows])
    weight = torch.zeros(len(rows), len(rows[0]) + bias, dtype=torch.float64)
    places = active(Genome(mask, weight))
    if int(places.sum()) != len(weights):
        wanted = f"{int(mask.sum())} ones" + (f" and {len(rows)} biases" if bias else "")
        raise ValueError(f"{len(weights)} weights do not fit the bits {bits!r}: they have {wanted}")
    weight[places] = torch.tensor(list(weights), dtype=torch.float64)
    return Genome(mask, weight)
