"""File and table of simulated records."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ccnn_torch.effects import OUTLIER
from ccnn_torch.effects.covariates import covariate_units
from ccnn_torch.errors import InputError
from ccnn_torch.files.write import make_folder
from ccnn_torch.records import name_lines, write_table
from ccnn_torch.report.table import Table
from ccnn_torch.simulation.job import Simulated


def write_simulated(path: Path, simulated: Simulated) -> None:
    """Write the records: joints, pose, covariates, in SI.

    Raises:
        InputError: the name does not end in .csv, or the file cannot be written.
    """
    if path.suffix.lower() != ".csv":
        raise InputError(f"--out: '{path}' must end in .csv")
    machine, units = simulated.mechanism, covariate_units(simulated.mechanism)
    columns = {c.header: simulated.joints[:, i].numpy() for i, c in enumerate(machine.joints)}
    columns |= {c.header: simulated.pose[:, i].numpy() for i, c in enumerate(machine.pose)}
    columns |= {f"{name}[{units[name]}]": values.numpy() for name, values in simulated.covariates.items()}
    make_folder(path.parent)
    write_table(path, columns)


def injected_table(simulated: Simulated) -> Table:
    """What was injected, a row for each parameter."""
    rows = [
        (one.name, name, f"{value:.4g}", unit)
        for one in simulated.injected
        for name, (value, unit) in one.parameters.items()
    ]
    parts = []
    effects = [one for one in simulated.injected if one.name != OUTLIER]
    if effects:
        alone = "; ".join(f"{one.name} alone {one.gap * 1e6:.3g} µm" for one in effects)
        without = "noise and bad rows" if simulated.outliers else "noise"
        parts.append(
            f"RMS error of the position {simulated.gap * 1e6:.3g} µm over all rows without {without} ({alone})"
        )
    if simulated.outliers:
        # As the file will have them, below a header.
        lines = np.arange(len(simulated.joints), dtype=np.int64) + 2
        added = sum(one.gap**2 for one in simulated.injected if one.name == OUTLIER) ** 0.5
        named = name_lines(lines, simulated.outliers, len(simulated.outliers))
        parts.append(f"RMS error by bad rows {added * 1e6:.3g} µm over all rows; bad rows: {named}")
    return Table("Injected", ("effect", "parameter", "value", "unit"), tuple(rows), "; ".join(parts))
