"""Simulated real machines: a nominal mechanism, and the same machine as built, with the causes of its errors."""

from ccnn_torch.runs.machines.causes import CAUSES as CAUSES
from ccnn_torch.runs.machines.realistic import MACHINES as MACHINES
from ccnn_torch.runs.machines.realistic import RealisticMachine as RealisticMachine
from ccnn_torch.runs.machines.realistic import build_machine as build_machine
