"""Numbers as the text of a CSV file, many at once: as Python's `.17g`, in an eighth of its time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Sizes whose digits are worked out here; others are rare, and left to Python.
_LEAST, _MOST = 1e-15, 1e16
_POWERS = np.array([float(10**k) for k in range(33)])
# What the floats lack of the powers themselves.
_LACKS = np.array([float(10**k - int(float(10**k))) for k in range(33)])
# The digits of 0 to 9999, four bytes each.
_FOUR = np.array([f"{k:04d}".encode() for k in range(10_000)]).view(np.uint32)
# Bytes of a cell, as of -1.2345678901234567e-308: its sign is the first, and the separator the last.
_WIDTH, _ROW = 32, np.dtype("V32")
_ZERO, _POINT = 48, 46
# Rows at a time.
_ROWS = 4096


def csv_lines(values: NDArray[np.float64]) -> bytes:
    """Lines of a table `rows x columns`, with 17 significant digits; a cell is empty where a number is none."""
    return b"".join(_lines(values[k : k + _ROWS]) for k in range(0, len(values), _ROWS))


def _lines(values: NDArray[np.float64]) -> bytes:
    flat = values.ravel()
    cells = np.zeros((len(flat), _WIDTH), np.uint8)
    size = np.abs(flat)
    usual = (size >= _LEAST) & (size < _MOST)
    places = np.flatnonzero(usual)
    digits, exponent = _digits(size[places])
    for x in np.unique(exponent):
        own = np.flatnonzero(exponent == x)
        cells.view(_ROW)[places[own]] = _laid_out(digits[own], int(x)).view(_ROW)
    cells[size == 0, 1] = _ZERO
    for k in np.flatnonzero(~usual & (size > 0)):
        cells[k, 1:-1] = np.frombuffer(f"{size[k]:.17g}".encode().ljust(_WIDTH - 2, b"\0"), np.uint8)
    cells[np.signbit(flat) & (flat == flat), 0] = ord("-")
    cells[:, -1] = ord(",")
    cells[values.shape[1] - 1 :: values.shape[1], -1] = ord("\n")
    return bytes(cells[cells != 0])


def _digits(size: NDArray[np.float64]) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Seventeen digits `s x 17`, and the power of ten of the first."""
    exponent = np.floor(np.log10(size)).astype(np.int64)
    whole, off = _scaled(size, exponent)
    # Where the logarithm was rounded to a neighbour.
    wrong = np.flatnonzero(off)
    exponent[wrong] += off[wrong]
    whole[wrong] = _scaled(size[wrong], exponent[wrong])[0]
    carried = whole == 10**17
    whole, exponent = np.where(carried, 10**16, whole), exponent + carried
    digits = np.empty((len(size), 5), np.uint32)
    for k in range(4, -1, -1):
        rest = whole // 10_000
        digits[:, k] = _FOUR[whole - rest * 10_000]
        whole = rest
    return digits.view(np.uint8)[:, 3:], exponent


def _scaled(size: NDArray[np.float64], exponent: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The whole number nearest to size · 10^(16 - exponent), and by how much the exponent is off.

    The product is exact, as the sum of two halves (Dekker 1971).
    """
    power = _POWERS[16 - exponent]
    product = size * power
    (a, b), (c, d) = _halves(size), _halves(power)
    error = ((a * c - product) + a * d + b * c) + b * d + size * _LACKS[16 - exponent]
    # The product is even from 2^53 on.
    whole = product.astype(np.int64) + np.rint(error).astype(np.int64)
    below = (product < 1e16) | ((product == 1e16) & (error < 0))
    return whole, (whole >= 10**17).astype(np.int64) - below


def _halves(value: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    large = value * 134217729.0
    high = large - (large - value)
    return high, value - high


def _laid_out(digits: NDArray[np.uint8], x: int) -> NDArray[np.uint8]:
    """Cells `s x 32` of numbers from 10^x on, with their point and without zeros at the end."""
    cells = np.zeros((len(digits), _WIDTH), np.uint8)
    count = 17 - (digits[:, ::-1] != _ZERO).argmax(-1)
    before = x + 1 if x >= 0 else 0 if x >= -4 else 1
    shown = np.where(np.arange(17) < np.maximum(count, before)[:, None], digits, 0)
    # As in 0.00123: the point and the zeros behind it are in front.
    lead = f"0.{'0' * (-x - 1)}" if before == 0 else ""
    cells[:, 1 : 1 + len(lead)] = np.frombuffer(lead.encode(), np.uint8)
    cells[:, 1 + len(lead) : 1 + len(lead) + before] = shown[:, :before]
    at = 1 + len(lead) + before
    if before:
        cells[:, at] = np.where(count > before, _POINT, 0)
        at += 1
    cells[:, at : at + 17 - before] = shown[:, before:]
    if x < -4:
        cells[:, 24:28] = np.frombuffer(f"e-{-x:02d}".encode(), np.uint8)
    return cells
