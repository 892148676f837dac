"""Geometric parameters of a machine from measured records."""

from ccnn_torch.identification.geometry import fit_geometry as fit_geometry
from ccnn_torch.identification.links import fit_links as fit_links
from ccnn_torch.identification.problem import Channel as Channel
from ccnn_torch.identification.problem import Fit as Fit
from ccnn_torch.identification.problem import Problem as Problem
from ccnn_torch.identification.problem import Progress as Progress
from ccnn_torch.identification.problem import Solver as Solver
