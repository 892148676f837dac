"""Geometric parameters of a machine from measured records."""

from ccnn_torch.identification.bootstrap import Bootstrap as Bootstrap
from ccnn_torch.identification.bootstrap import bootstrap as bootstrap
from ccnn_torch.identification.forward import forward_problem as forward_problem
from ccnn_torch.identification.geometry import fit_geometry as fit_geometry
from ccnn_torch.identification.inverse import inverse_problem as inverse_problem
from ccnn_torch.identification.knowledge import Knowledge as Knowledge
from ccnn_torch.identification.knowledge import require_identifiable as require_identifiable
from ccnn_torch.identification.knowledge import what_is_known as what_is_known
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
from ccnn_torch.identification.tikhonov import LCurve as LCurve
from ccnn_torch.identification.tikhonov import l_curve as l_curve
from ccnn_torch.identification.tikhonov import solve_tikhonov as solve_tikhonov
