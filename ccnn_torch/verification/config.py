"""What `ccnn verify` takes from a config: the records, how they are to be read, and the machine."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from ccnn_torch.config.tree import Columns, Files, JobConfig, JointMap


class VerifyConfig(JobConfig):
    """Keys of `ccnn verify`, which mean the same in a config for `ccnn run`."""

    of_a_run = ("records", "columns", "joint_map", "mechanism", "mechanism_keys")

    records: Files | None = Field(default=None, description="new rows; the same as RECORDS.csv and --records")
    columns: Columns
    joint_map: JointMap
    mechanism: str | None = Field(
        default=None, description="the nominal machine; the same as --mechanism; null = the model's"
    )
    mechanism_keys: dict[str, Any] = Field(default={}, description="keys of the mechanism's constructor")
