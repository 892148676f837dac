"""Numbers of CSV files are the ones that Python writes."""

from __future__ import annotations

import numpy as np

from ccnn_torch.records.decimals import csv_lines


def test_numbers_are_those_of_python_to_the_last_digit() -> None:
    draw = np.random.default_rng(7)
    powers = np.array([float(f"1e{k}") for k in range(-20, 22)])
    edges = [0.0, -0.0, np.nan, np.inf, -np.inf, 5e-324, 1e300, 123456789012345678.0, 0.5, 9.9999999999999995]
    values = np.concatenate(
        [
            draw.standard_normal(4000) * 10.0 ** draw.integers(-18, 19, 4000),
            # Many of these lie in the middle between two decimals.
            (draw.integers(0, 2**20, 4000) + 0.5) * 2.0 ** draw.integers(-40, 10, 4000),
            *(powers, np.nextafter(powers, 0), -np.nextafter(powers, np.inf), edges),
        ]
    )
    expected = "".join("\n" if v != v else f"{v:.17g}\n" for v in values.tolist())
    assert csv_lines(values[:, None]).decode() == expected
