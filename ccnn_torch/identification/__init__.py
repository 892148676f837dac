"""Geometric parameters of a machine from measured records."""

from ccnn_torch.identification.inverse import inverse_problem as inverse_problem
from ccnn_torch.identification.legs import solve_per_leg as solve_per_leg
from ccnn_torch.identification.legs import split_by_leg as split_by_leg
from ccnn_torch.identification.links import fit_links as fit_links
from ccnn_torch.identification.lm import solve_lm as solve_lm
from ccnn_torch.identification.parameters import ParameterChoice as ParameterChoice
from ccnn_torch.identification.parameters import Selection as Selection
from ccnn_torch.identification.parameters import select_parameters as select_parameters
from ccnn_torch.identification.problem import Channel as Channel
from ccnn_torch.identification.problem import Fit as Fit
from ccnn_torch.identification.problem import Problem as Problem
from ccnn_torch.identification.problem import Progress as Progress
from ccnn_torch.identification.problem import Solver as Solver
from ccnn_torch.identification.robust import LOSSES as LOSSES
from ccnn_torch.identification.robust import reweighted as reweighted
