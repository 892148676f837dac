"""CSV text: numbers bit by bit, and no text that a spreadsheet runs."""

from __future__ import annotations

import math

import pytest

from ccnn_torch.files.write import csv_cell, csv_text


@pytest.mark.parametrize("text", ["=1+1", "+a", "-a", "@SUM(A1)", "\t=1", "\r=1", "-1-1", "+"])
def test_a_formula_becomes_a_text(text: str) -> None:
    assert csv_cell(text) == f"'{text}"


@pytest.mark.parametrize("text", ["-1e-3", "+5", "a=b", "[-1, 2]", "", "seed-1"])
def test_numbers_and_plain_texts_stay(text: str) -> None:
    assert csv_cell(text) == text


def test_lines() -> None:
    text = csv_text([["job", "a,b"], [None, -math.pi], ["=x", 3]])
    assert text == 'job,"a,b"\n,-3.1415926535897931\n\'=x,3\n'
