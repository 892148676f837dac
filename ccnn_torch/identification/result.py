"""From outcomes to the content of `identified.json` and to the arrays that the pictures are drawn from."""

from __future__ import annotations

import math
import platform
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ccnn_torch.identification.config import IdentifyConfig
from ccnn_torch.identification.doubts import doubts_of
from ccnn_torch.identification.judge import commanded, map_error, noise_of_test, predicted
from ccnn_torch.identification.measured.measured import Measured
from ccnn_torch.identification.pose_errors import before_and_after, figures, removed
from ccnn_torch.identification.problems.parameters import Selection
from ccnn_torch.identification.solve import (
    Outcome,
    Piece,
    free_values,
    is_apart,
    knowledge_of,
    pieces_of,
    select,
)
from ccnn_torch.mechanisms import PoseError
from ccnn_torch.verification.promise import configurations, promise_block
from ccnn_torch.version import __version__

Z95 = 1.959963984540054


@dataclass(frozen=True)
class Known:
    """What is known of the free parameters at a geometry.

    Attributes:
        sd: `r x k` [SI]; inf where the rows do not determine the parameter.
        combinations: those that cannot be identified, in words, of the first machine.
        correlation: `k x k` of the first machine, NaN where nothing is known.
        singular_values: of the scaled Jacobian, by leg or for all, of the first machine.
        noise: standard deviation of the whitened residual, `r` [1].
        freedom: equations to spare, of all pieces, `r` [1].
    """

    sd: Tensor
    combinations: list[str]
    correlation: Tensor
    singular_values: list[list[float]]
    noise: Tensor
    freedom: Tensor


def known_of(pieces: list[Piece], selection: Selection, whole: Tensor) -> Known:
    """Put together what is known of each piece's parameters."""
    names = [p.name for p in selection.parameters]
    sd = torch.full((len(whole), len(names)), math.inf, dtype=torch.float64)
    correlation = torch.full((len(names), len(names)), math.nan, dtype=torch.float64)
    combinations: list[str] = []
    singular: list[list[float]] = []
    noise: list[Tensor] = []
    freedom: list[Tensor] = []
    for piece, knowledge in zip(pieces, knowledge_of(pieces, selection, whole), strict=True):
        at = torch.tensor([names.index(p.name) for p in piece.problem.parameters])
        sd[:, at] = knowledge.sd
        correlation[at[:, None], at] = knowledge.correlation[0]
        combinations += list(knowledge.combinations)
        singular.append(knowledge.singular_values[0].tolist())
        noise.append(knowledge.noise.expand(len(whole)))
        freedom.append(knowledge.freedom.expand(len(whole)))
    return Known(sd, combinations, correlation, singular, torch.stack(noise).mean(0), torch.stack(freedom).sum(0))


def assemble(
    config: IdentifyConfig,
    measured: Measured,
    outcomes: Mapping[str, Outcome],
    counts: list[dict[str, Any]],
    resampled: Tensor | None = None,
) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """The content of `identified.json`, and tensors by name for the pictures; the first method's values are the result.

    Not the method of the best held-out error: that would choose by the rows that judge.

    Args:
        outcomes: by method, in the config's order.
        counts: the study of the number of poses, as `count_study` gives it.
        resampled: standard deviations of the bootstrap, `k` [SI].
    """
    selection = select(measured, config)
    first, main = next(iter(outcomes.items()))
    noise = noise_of_test(measured)
    blocks: dict[str, Any] = {}
    arrays: dict[str, Tensor] = {"start": measured.start}
    known: dict[str, Known] = {}
    for method, outcome in outcomes.items():
        pieces = pieces_of(measured, config, is_apart(method, config), outcome.machines, outcome.values)
        known[method] = known_of(pieces, selection, outcome.values)
        blocks[method] = _method_block(config, measured, method, outcome, known[method], selection, arrays)
    before = predicted(measured, measured.start[main.machines], main.machines)
    after = predicted(measured, main.values, main.machines)
    arrays |= _pose_arrays(before, after, noise)
    arrays |= _residuals(pieces_of(measured, config, is_apart(first, config), main.machines[:1]), selection, main)
    if measured.truth is not None:
        arrays["truth"] = measured.truth
    if measured.map is not None:
        arrays["map"] = measured.map
        error = map_error(measured, measured.start, torch.arange(measured.machines))
        if error is not None:
            arrays["map_before"] = error
    arrays["correlation"] = known[first].correlation
    arrays["observed"] = measured.rows.observed[:1]
    arrays |= {f"observed_leg{leg}": rows.observed[:1] for leg, rows in measured.leg_rows.items()}
    results = results_of(
        config,
        measured,
        parameter_blocks(measured, selection, main, known[first], resampled),
        known[first],
        blocks,
        _doubts(config, measured, blocks[first]["test"], known[first]),
        [f"{m}: {o.message}" for m, o in outcomes.items() if o.message],
    )
    results |= {"promise": _promise(measured, before, after), "counts": counts}
    return results, arrays


def results_of(
    config: IdentifyConfig,
    measured: Measured,
    parameters: dict[str, Any],
    known: Known,
    methods: dict[str, Any],
    doubts: list[str],
    notes: list[str],
) -> dict[str, Any]:
    """What `identified.json` has of every identification.

    Args:
        parameters: see `parameter_blocks`.
        known: by the first method.
        methods: their blocks; the first is the result.
        doubts, notes: sentences, the notes beside those of the rows.
    """
    method, first = next(iter(methods.items()))
    return {
        "name": config.name,
        "seed": config.seed,
        "mechanism": measured.mechanism.name,
        "machines": measured.machines,
        "simulated": measured.truth is not None,
        "rows": {
            "train": measured.rows.joints.shape[1],
            "per_leg": {str(leg): rows.joints.shape[1] for leg, rows in measured.leg_rows.items()},
            "test": measured.test.joints.shape[1],
        },
        "method": method,
        "parameters": parameters,
        "combinations_not_identifiable": known.combinations,
        "test": first["test"],
        "methods": methods,
        "compensation": first["compensation"],
        "singular_values": known.singular_values,
        "noise_ratio": figures({"value": known.noise}),
        "doubts": doubts,
        "counts": [],
        "paper": config.paper,
        "data_sha256": measured.data_hash or None,
        "notes": [*measured.notes, *notes],
        "versions": {
            "ccnn_torch": __version__,
            "python": platform.python_version(),
            "torch": torch.__version__,
        },
    }


def method_of(outcome: Outcome, test: dict[str, Any], per_leg: bool) -> dict[str, Any]:
    """A method's block, without what only simulated machines show."""
    return {
        "test": test,
        "seconds": outcome.seconds,
        "machines": len(outcome.machines),
        "per_leg": per_leg,
        "converged": float(outcome.converged.double().mean()),
        "evaluations": outcome.evaluations,
        "deviations": None,
        "bound": None,
        "coverage": None,
        "compensation": None,
    }


def _promise(measured: Measured, before: PoseError, after: PoseError) -> dict[str, Any] | None:
    """What the held-out rows promise for new ones; None with several machines, of which only one is written."""
    if measured.machines > 1:
        return None
    first, last = (
        PoseError(error.position[0], None if error.rotation is None else error.rotation[0]) for error in (before, after)
    )
    return promise_block(first, last, configurations(measured.test.joints[0], measured.mechanism.joints))


def _doubts(config: IdentifyConfig, measured: Measured, test: dict[str, Any], known: Known) -> list[str]:
    """Of a simulated machine the noise is what it is: there only the held-out error is judged."""
    noise = None if test["position"] is None else test["position"].get("noise")
    given = config.noise is not None and measured.pose_noise is not None
    if given and measured.pose_noise is not None:
        lengths = torch.tensor([c.unit == "m" for c in measured.mechanism.pose])
        noise = float(measured.pose_noise[lengths].square().sum().sqrt())
    return doubts_of(test, float(known.noise[0]), float(known.freedom[0]), noise, given)


def _method_block(
    config: IdentifyConfig,
    measured: Measured,
    method: str,
    outcome: Outcome,
    known: Known,
    selection: Selection,
    arrays: dict[str, Tensor],
) -> dict[str, Any]:
    machines = outcome.machines
    before = predicted(measured, measured.start[machines], machines)
    after = predicted(measured, outcome.values, machines)
    noise = noise_of_test(measured)
    test = before_and_after(before, after, None if noise is None else PoseError(*(_of(n, machines) for n in noise)))
    block = method_of(outcome, test, is_apart(method, config))
    arrays[f"values_{method}"] = outcome.values
    if measured.truth is None:
        return block
    truth = measured.truth[machines]
    gap = free_values(selection, outcome.values - truth)
    pieces = pieces_of(measured, config, is_apart(method, config), machines, truth)
    bound = known_of(pieces, selection, truth).sd
    arrays[f"deviation_{method}"], arrays[f"bound_{method}"] = gap, bound
    block["deviations"] = _deviations(selection, gap, free_values(selection, truth - measured.start[machines]))
    identifiable = torch.isfinite(bound).all(0)
    if bool(identifiable.any()):
        ratio = (gap / bound)[:, identifiable].square().mean(0).sqrt()
        block["bound"] = {"median": float(ratio.median()), "lowest": float(ratio.min()), "highest": float(ratio.max())}
        inside = (gap.abs() <= Z95 * known.sd)[:, identifiable]
        block["coverage"] = float(inside.double().mean())
    found = commanded(measured, outcome.values, machines)
    if found is not None:
        block["compensation"] = {
            "exact": removed(found.before, found.exact),
            "linear": removed(found.before, found.linear),
        }
    error = map_error(measured, outcome.values, machines)
    if error is not None:
        arrays[f"map_{method}"] = error
    return block


def _of(table: Tensor | None, machines: Tensor) -> Tensor:
    return torch.empty(0) if table is None else table[machines]


def _deviations(selection: Selection, gap: Tensor, error: Tensor) -> dict[str, Any]:
    """Largest and mean deviation |identified - true| by unit, and the mean as a share of the true error."""
    units = [p.unit for p in selection.parameters]
    answer: dict[str, Any] = {}
    for unit in dict.fromkeys(units):
        part = gap[:, torch.tensor([u == unit for u in units])].abs()
        answer[unit] = figures({"largest": part.amax(-1), "mean": part.mean(-1)})
    there = error.abs() > 1e-12
    share = torch.where(there, gap.abs() / error.abs().clamp_min(1e-12), torch.nan)
    answer["share"] = figures({"mean": share.nanmean(-1), "median": share.nanmedian(-1).values})
    return answer


def parameter_blocks(
    measured: Measured,
    selection: Selection,
    outcome: Outcome,
    known: Known,
    resampled: Tensor | None = None,
) -> dict[str, Any]:
    """Every parameter of the mechanism; one that is not free has its nominal value and no interval.

    A machine on which the method did not converge has no interval either; where it converged on none, nothing is
    identified.
    """
    settled = outcome.converged
    place = {name: i for i, group in enumerate(selection.groups) for name in group}
    answer: dict[str, Any] = {}
    for column, parameter in enumerate(measured.mechanism.geometry):
        name = parameter.name
        i = place.get(name)
        # Where the search did not end at a minimum the linearised problem is not informative.
        identifiable = i is not None and bool(settled.any()) and bool(torch.isfinite(known.sd[settled, i]).all())
        values: dict[str, Tensor | None] = {"value": outcome.values[:, column]}
        values["sd"] = known.sd[settled, i] if i is not None and identifiable else None
        if measured.truth is not None:
            truth = measured.truth[outcome.machines, column]
            start = measured.start[outcome.machines, column]
            values |= {
                "true": truth,
                "error_before": (start - truth).abs(),
                "deviation": (outcome.values[:, column] - truth).abs(),
            }
        entry = {"nominal": float(measured.mechanism.nominal[column])} | figures(values)
        entry |= {
            "free": i is not None,
            "identifiable": identifiable,
            "unit": parameter.unit,
            "leg": parameter.leg,
        }
        if i is not None and resampled is not None:
            entry["sd_bootstrap"] = float(resampled[i]) if identifiable else None
        answer[name] = entry
    return answer


def _pose_arrays(before: PoseError, after: PoseError, noise: PoseError | None) -> dict[str, Tensor]:
    found = {"before": before, "after": after} | ({} if noise is None else {"noise": noise})
    return {
        f"{part}_{when}": values
        for when, error in found.items()
        for part, values in error._asdict().items()
        if values is not None
    }


def _residuals(pieces: list[Piece], selection: Selection, outcome: Outcome) -> dict[str, Tensor]:
    """Whitened residuals of the first machine at the start and at the result, `s x c` for each piece."""
    names = [p.name for p in selection.parameters]
    found = free_values(selection, outcome.values[:1])
    arrays = {}
    for number, piece in enumerate(pieces):
        problem = piece.problem
        at = [names.index(p.name) for p in problem.parameters]
        data = tuple(d[:1] for d in problem.data)
        for when, values in (("before", problem.start[:1]), ("after", found[:, at])):
            arrays[f"residual_{when}_{number}"] = problem.residual(values[:, None], *data)[0].detach()
    return arrays
