"""Geometric parameters of a machine from measured records."""

from ccnn_torch.identification.identifiability import Knowledge as Knowledge, what_is_known as what_is_known
from ccnn_torch.identification.problems.parameters import (
    ParameterChoice as ParameterChoice,
    Selection as Selection,
    select_parameters as select_parameters,
)
from ccnn_torch.identification.problems.poses import (
    forward_problem as forward_problem,
    inverse_problem as inverse_problem,
)
from ccnn_torch.identification.problems.problem import (
    Channel as Channel,
    Fit as Fit,
    Problem as Problem,
    Progress as Progress,
    Solver as Solver,
    split_by_leg as split_by_leg,
)
from ccnn_torch.identification.solvers import SOLVERS as SOLVERS, get_solver as get_solver
from ccnn_torch.identification.solvers.lm import LOSSES as LOSSES, reweighted as reweighted, solve_lm as solve_lm
from ccnn_torch.identification.solvers.tikhonov import (
    LCurve as LCurve,
    l_curve as l_curve,
    solve_tikhonov as solve_tikhonov,
)
from ccnn_torch.mechanisms.frames.part import tool_points as tool_points
