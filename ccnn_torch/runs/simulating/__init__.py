"""Records of a machine with given effects: rows, injection, noise and the file."""

from ccnn_torch.runs.simulating._effects import Injected as Injected
from ccnn_torch.runs.simulating._records import Simulated as Simulated
from ccnn_torch.runs.simulating._records import injected_table as injected_table
from ccnn_torch.runs.simulating._records import simulate_records as simulate_records
from ccnn_torch.runs.simulating._records import write_simulated as write_simulated
