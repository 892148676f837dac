"""Measured data in."""

from ccnn_torch._table import Table as Table
from ccnn_torch._table import read_table as read_table
from ccnn_torch._table import write_table as write_table
