"""From a mechanism to the poses to measure."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ccnn_torch.coordinates import Parameter
from ccnn_torch.errors import InputError
from ccnn_torch.identification.problems.parameters import ParameterChoice, select_parameters
from ccnn_torch.identification.problems.poses import Noise, compares_poses, forward_problem, inverse_problem
from ccnn_torch.identification.problems.problem import Problem, Progress, split_by_leg
from ccnn_torch.mechanisms import Mechanism
from ccnn_torch.planning.candidates import (
    Candidates,
    Limits,
    common_coordinates,
    draw_candidates,
    identification_rows,
    what_is_seen,
)
from ccnn_torch.planning.design import (
    Gains,
    add_best,
    exchange,
    gains_of,
    gains_of_sets,
    make_design,
    order_by_worth,
    recommended_count,
    tightest_bound,
)

# Draws of random poses that a plan is compared with; odd, for the median.
_RANDOM = 101
# Candidates shown in pictures.
_AROUND = 2000
# Measuring noise where none is given: a laser tracker's [m], and the same over a lever of 0.3 m [rad].
_NOISE = {"m": 1e-5, "rad": 1e-5 / 0.3}


@dataclass(frozen=True)
class Choice:
    """Poses chosen among candidates.

    Attributes:
        chosen: numbers of the candidates, `N`, int64; the first ones alone are good, too.
        gains: what the first n of them show, and what so many more would: `gains.count` goes beyond N.
        recommended: the number of poses after which a further one gives little; None where even the last gives more.
        bound: share of the best possible det^(1/k) of the information that is reached at least; None where there is a
            prior.
        settled: whether no exchange of a pose improves the determinant.
        random_o1: O1 of as many candidates drawn at random, the median of 101 draws.
        random_sd: standard deviation of each parameter with them, likewise, `k` [SI].
        kept: numbers of the parameters that are planned for, `k` of the problem's; all where every one shows.
        left_out: groups of parameters that no candidate determines alone, with the combinations that are determined.
    """

    chosen: Tensor
    gains: Gains
    random_o1: float
    random_sd: Tensor
    recommended: int | None
    bound: float | None
    settled: bool
    kept: Tensor
    left_out: tuple[str, ...]


@dataclass(frozen=True)
class Plan:
    """Poses to measure, the most informative ones first.

    Attributes:
        leg: whose parameters they are for; None for all.
        parameters: the parameters to identify, `k`, without those that are fixed because no pose determines them.
        scale: their plausible errors, `k` [SI].
        joints: commands for the machine, `N x n` [SI].
        pose: where they bring the nominal machine, `N x p` [SI].
        choice: the choice and its figures.
        candidates: how many configurations there were to choose from.
        drawn: how many were drawn to find them.
        around: the poses of some of them, for pictures, `m x p` [SI].
    """

    leg: int | None
    parameters: tuple[Parameter, ...]
    scale: Tensor
    joints: Tensor
    pose: Tensor
    choice: Choice
    candidates: int
    drawn: int
    around: Tensor

    @property
    def sd(self) -> Tensor:
        """Standard deviation of each parameter with the planned poses, `k` [SI]."""
        return self.choice.gains.sd[self.choice.gains.count.tolist().index(len(self.pose))]

    @property
    def o1(self) -> float:
        """O1 of the planned poses, divided by √poses; parameters in plausible errors, measurements in noise."""
        return float(self.choice.gains.o1[self.choice.gains.count.tolist().index(len(self.pose))])


def choose_poses(
    problem: Problem,
    count: int,
    *,
    repeat: bool = False,
    least_gain: float = 0.02,
    progress: Progress | None = None,
) -> Choice:
    """Choose rows of a problem (its first machine) so that O1, the determinant of the information, is largest.

    Any problem can be given, so that poses are planned for constraints as well as for measured poses. If no candidate
    determines a combination of parameters, one of them is fixed, and the plan is for the others (`Choice.kept`).
    Figures have those `k` parameters.

    Args:
        problem: a row for every candidate.
        count: how many to choose.
        repeat: whether a row may be chosen more than once.
        least_gain: what a further pose must give to be worth measuring, a share.
        progress: called with the share that is done.

    Raises:
        InputError: too few poses or candidates, or no parameter shows in any candidate.
    """
    report = progress or (lambda _: None)
    rows = identification_rows(problem, _share(report, 0.0, 0.15))
    held = torch.where(torch.isfinite(problem.prior_sd), problem.scale / problem.prior_sd, 0.0)
    kept, left_out = what_is_seen(rows, held, problem.parameters, problem.scale)
    rows, held = rows[..., kept], held[kept]
    scale, prior_sd = problem.scale[kept], problem.prior_sd[kept]
    _check_count(rows, prior_sd, count, repeat)
    turn = common_coordinates(rows, held)
    prior = turn.mT @ torch.diag(held.square()) @ turn

    design = make_design(rows @ turn, prior if bool((held > 0).all()) else None, repeat)
    for step in range(count):
        add_best(design)
        report(0.15 + 0.05 * (step + 1) / count)
    design.prior = prior
    settled = exchange(design, _share(report, 0.2, 0.8))
    bound = None if bool((held > 0).any()) else tightest_bound(design)
    order, first = order_by_worth(rows[design.chosen] @ turn, prior)
    chosen = [design.chosen[place] for place in order]

    # What more poses would give: the best ones to add, one by one.
    design.chosen = list(chosen)
    if not repeat:
        design.free = torch.ones(len(rows), dtype=torch.bool).index_fill_(0, torch.tensor(chosen), False)
    design.refresh()
    for _ in range(min(max(6, count // 2), len(rows) - count if not repeat else count)):
        add_best(design)
    gains = gains_of(rows[design.chosen], first, scale, prior_sd)
    report(1.0)
    recommended = recommended_count(gains, least_gain)
    random_o1, random_sd = _random(rows, count, scale, prior_sd)
    return Choice(torch.tensor(chosen), gains, random_o1, random_sd, recommended, bound, settled, kept, left_out)


def _random(rows: Tensor, count: int, scale: Tensor, prior_sd: Tensor) -> tuple[float, Tensor]:
    """O1 and standard deviations of poses taken at random, medians."""
    draws = torch.rand(_RANDOM, len(rows), generator=torch.Generator().manual_seed(0)).topk(count, sorted=False).indices
    found = gains_of_sets(rows[draws].flatten(1, 2), torch.tensor(count), scale, prior_sd)
    return float(found.o1.median()), found.sd.median(0).values


def plan_poses(
    mechanism: Mechanism,
    poses: int,
    *,
    choice: ParameterChoice | None = None,
    pose_noise: Noise | None = None,
    joint_noise: Noise | None = None,
    candidates: int = 100_000,
    limits: Limits | None = None,
    max_condition: float = 50.0,
    rotation_weight: float = 0.04,
    residual: str = "auto",
    per_leg: bool = False,
    repeat: bool = False,
    least_gain: float = 0.02,
    margin: float = 2.0,
    seed: int = 0,
    progress: Progress | None = None,
) -> list[Plan]:
    """Active calibration: the poses that best identify a mechanism's parameters.

    Args:
        mechanism: with its nominal parameters.
        poses: how many to plan; with `per_leg` for each leg.
        choice: which parameters are to be identified, with their priors; all when None.
        pose_noise, joint_noise: standard deviations, one for all or one each [SI]; where neither is given the pose has
            1e-5 m and 1e-5 m over 0.3 m in its angles.
        candidates: configurations to choose from.
        limits, max_condition, rotation_weight: as `draw_candidates`.
        residual: `inverse` compares joints, `forward` poses; `auto` = poses for serial arms and framed mechanisms.
        per_leg: a plan for each leg (divide and conquer, paper 004) in place of a common one.
        repeat, least_gain: as `choose_poses`.
        margin: poses stay in reach of machines whose free parameters are off by so many plausible errors.
        seed: of the draws.
        progress: called with the share that is done.

    Returns:
        One plan, or one a leg.

    Raises:
        InputError: as `draw_candidates`, `choose_poses` and `inverse_problem`.
    """
    report = progress or (lambda _: None)
    selection = select_parameters(mechanism.geometry, choice, mechanism.nominal)
    found = draw_candidates(
        mechanism,
        candidates,
        seed,
        limits=limits,
        max_condition=max_condition,
        rotation_weight=rotation_weight,
        uncertainty=margin * selection.scale @ selection.spread,
        progress=_share(report, 0.0, 0.4),
    )
    if pose_noise is None and joint_noise is None:
        pose_noise = [_NOISE.get(c.unit, 1e-5) for c in mechanism.pose]
    problem = _problem(mechanism, found, choice, (pose_noise, joint_noise), residual, per_leg)
    parts = split_by_leg(problem) if per_leg else [problem]
    plans = []
    for number, part in enumerate(parts):
        chosen = choose_poses(
            part,
            poses,
            repeat=repeat,
            least_gain=least_gain,
            progress=_share(report, 0.4 + 0.6 * number / len(parts), 0.6 / len(parts)),
        )
        joints, pose = found.joints[chosen.chosen], found.pose[chosen.chosen]
        leg = part.channels[0].leg if per_leg else None
        around = found.pose[:_AROUND]
        parameters = tuple(part.parameters[i] for i in chosen.kept.tolist())
        plans.append(
            Plan(leg, parameters, part.scale[chosen.kept], joints, pose, chosen, candidates, found.drawn, around)
        )
    return plans


def _share(report: Progress, begin: float, width: float) -> Progress:
    return lambda done: report(begin + width * done)


def _problem(
    mechanism: Mechanism,
    found: Candidates,
    choice: ParameterChoice | None,
    noise: tuple[Noise | None, Noise | None],
    residual: str,
    per_leg: bool,
) -> Problem:
    if residual not in ("auto", "inverse", "forward"):
        raise InputError(f"residual: must be auto, inverse or forward, not '{residual}'")
    of_pose, of_joints = noise
    if residual == "forward" or (residual == "auto" and compares_poses(mechanism)):
        if per_leg:
            raise InputError(
                "per_leg: a pose depends on the parameters of all legs; plan from joints (residual=inverse) or for all "
                "legs together (per_leg=false)"
            )
        return forward_problem(
            mechanism, found.joints, found.pose, choice=choice, pose_noise=of_pose, joint_noise=of_joints
        )
    return inverse_problem(
        mechanism,
        found.joints,
        found.pose,
        choice=choice,
        pose_noise=of_pose,
        joint_noise=of_joints,
        per_leg=per_leg,
    )


def _check_count(rows: Tensor, prior_sd: Tensor, count: int, repeat: bool) -> None:
    there, channels, k = rows.shape
    held = int(torch.isfinite(prior_sd).sum())
    if count * channels + held < k:
        raise InputError(
            f"{count} poses of {channels} equation{'s' if channels > 1 else ''} cannot determine {k} parameters; plan "
            f"at least {-(-(k - held) // channels)} (two or three times as many average the noise), or fix parameters"
        )
    if count > there and not repeat:
        raise InputError(f"{count} poses cannot be chosen from {there} candidates; give more candidates")
