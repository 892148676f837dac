"""Diagnosis: which effects cause the gap between model and machine, where it is, and the share that they explain."""

from ccnn_torch.diagnosis.discrepancy.network import with_network as with_network
from ccnn_torch.diagnosis.engine import OUTLIER as OUTLIER, candidates as candidates, diagnose_rows as diagnose_rows
from ccnn_torch.diagnosis.from_records import diagnose as diagnose, noise_of as noise_of, situation_of as situation_of
from ccnn_torch.diagnosis.result import Diagnosis as Diagnosis
from ccnn_torch.diagnosis.verdict.findings import findings as findings
