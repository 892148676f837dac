"""Measured records: files, columns and units in; joints, poses and covariates in SI out; splits into rows."""

from ccnn_torch.doors import door
from ccnn_torch.records.covariates import DEFAULT_COVARIATES as DEFAULT_COVARIATES
from ccnn_torch.records.headers import (
    JOINT_LIMIT as JOINT_LIMIT,
    read_pose as read_pose,
    stack_columns as stack_columns,
)
from ccnn_torch.records.read_table import read_table as read_table
from ccnn_torch.records.table import Table as Table, name_lines as name_lines, write_table as write_table

TYPE_CHECKING = False
if TYPE_CHECKING:
    # Needs torch, which a table alone does not wait for.
    from ccnn_torch.records.load import Records as Records, check_rows as check_rows, load_records as load_records
else:
    __getattr__, __all__ = door(__name__)
