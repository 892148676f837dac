"""`ccnn compensate` with a model of a motion: commands, corrected so that the machine follows what is wanted."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ccnn_torch.display import number_text
from ccnn_torch.errors import InputError
from ccnn_torch.motion.feed_forward import corrected_command
from ccnn_torch.motion.identified import load_identified
from ccnn_torch.motion.log import refuse_time, runs_of
from ccnn_torch.records import read_table, write_table
from ccnn_torch.units import from_si

_FEWEST = 20


def compensate_motion(model: Path, input: Path, output: Path, allow_code: bool = False) -> list[str]:
    """Write the input's columns with `corrected1[unit]…`, the commands to send, and `predicted1[unit]…`, the positions.

    Args:
        model: `identified_motion.json`.
        input: CSV with `time[s]` and `command1[unit]…`, where the machine shall be; `run[1]` where it has several.
        output: CSV.
        allow_code: as of `load_identified`.

    Returns:
        A sentence for each joint: what its error is predicted to be.

    Raises:
        InputError: a file is not there or not in this form.
    """
    found = load_identified(model, allow_code)
    table = read_table(input)
    names = [f"command{i + 1}" for i in range(len(found.units))]
    time = table.column("time", "s")
    wanted = np.stack([table.column(n, unit) for n, unit in zip(names, found.units, strict=True)], -1)
    command, position, plain = (np.empty_like(wanted) for _ in range(3))
    for name, rows in runs_of(table):
        refuse_time(table, rows, time[rows])
        if len(rows) < _FEWEST:
            raise InputError(f"{name}: {len(rows)} rows are no motion; give at least {_FEWEST}")
        own = corrected_command(found.nominal, found.axes, time[rows], wanted[rows])
        command[rows], position[rows], plain[rows] = own.command, own.position, own.plain
    added = {}
    for what, values in (("corrected", command), ("predicted", position)):
        for i, name in enumerate(names):
            unit = table.units[name]
            added[f"{what}{i + 1}[{unit}]"] = from_si(values[:, i], found.units[i], unit)
    kept = {table.header(n): table.raw(n) for n in table.names if not n.startswith(("corrected", "predicted"))}
    write_table(output, kept | added)
    sentences = []
    for i, unit in enumerate(found.units):
        # What the model leaves stays, and adds to what the correction does.
        before, after = (
            float(np.hypot(np.sqrt(np.square(wanted[:, i] - q[:, i]).mean()), found.left[i])) for q in (plain, position)
        )
        said = f"{number_text(before, 3)} -> {number_text(after, 3)} {unit} RMS"
        sentences.append(f"q{i + 1}: predicted {said} ({number_text(found.left[i], 2)} of it the model's own error)")
    return sentences
