"""Some rows of records."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from ccnn_torch.records import Records


def rows_of(records: Records, rows: Tensor) -> Records:
    """Rows by their numbers, `t`."""
    columns = {name: values[rows.numpy()] for name, values in records.columns.items()}
    parts = {key: getattr(records, key)[rows] for key in ("joints", "pose", "covariates")}
    return replace(records, **parts, columns=columns, lines=records.lines[rows.numpy()], parts=())
