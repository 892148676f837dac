"""From outcomes to the content of `identified.json` and to the arrays that the pictures are drawn from."""

from __future__ import annotations

import math
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ccnn_torch.identification import Knowledge, Problem, what_is_known
from ccnn_torch.identification.config import IdentifyConfig
from ccnn_torch.identification.judge import (
    before_and_after,
    commanded,
    doubts_of,
    figures,
    noise_of_test,
    predicted,
)
from ccnn_torch.identification.measured import Measured
from ccnn_torch.identification.problems.parameters import Selection
from ccnn_torch.identification.solve import (
    Outcome,
    is_apart,
    pieces_of,
)
from ccnn_torch.mechanisms import Giving, PoseError, SetUps
from ccnn_torch.plugins import names_code
from ccnn_torch.verification.promise import configurations, of_whole, promise_block
from ccnn_torch.version import __version__

Z95 = 1.959963984540054


@dataclass(frozen=True)
class Known:
    """What is known of the free parameters at a geometry.

    Attributes:
        sd: `r x k` [SI]; inf where the rows do not determine the parameter.
        combinations: those that cannot be identified, in words, of the first machine.
        singular_values: of the scaled Jacobian, by leg or for all, of the first machine.
        noise: standard deviation of the whitened residual, `r` [1].
        freedom: equations to spare, of all pieces, `r` [1].
    """

    sd: Tensor
    combinations: list[str]
    singular_values: list[list[float]]
    noise: Tensor
    freedom: Tensor


def known_at(pieces: list[Problem], selection: Selection, whole: Tensor) -> Known:
    """What is known of the parameters of all pieces at a geometry `r x K`."""
    free = selection.free(whole)
    return known_of([what_is_known(piece, free[:, selection.places(piece.parameters)]) for piece in pieces], selection)


def known_of(found: Sequence[Knowledge], selection: Selection) -> Known:
    """Put together what is known of pieces; unknowns behind a piece's parameters are not of the machine."""
    k = len(selection.parameters)
    sd = torch.full((len(found[0].sd), k), math.inf, dtype=torch.float64)
    for knowledge in found:
        at = torch.tensor(selection.places(knowledge.parameters[:k]))
        sd[:, at] = knowledge.sd[:, : len(at)]
    return Known(
        sd=sd,
        combinations=[sentence for knowledge in found for sentence in knowledge.combinations],
        singular_values=[knowledge.singular_values[0].tolist() for knowledge in found],
        noise=torch.stack([knowledge.noise for knowledge in found]).mean(0),
        freedom=torch.stack([knowledge.freedom for knowledge in found]).sum(0),
    )


@dataclass(frozen=True)
class Found:
    """What one method found of `r` machines, and how far held-out rows are from it.

    Attributes:
        outcome: what it found.
        known: what is known of the parameters there.
        before, after: pose errors of the held-out rows at the start and at the result, `r x t`.
        noise: pose errors of the measurement alone, where they are known, `r x t`.
        per_leg: whether each leg was identified from its own equations.
    """

    outcome: Outcome
    known: Known
    before: PoseError
    after: PoseError
    noise: PoseError | None = None
    per_leg: bool = False


def judged(config: IdentifyConfig, measured: Measured, selection: Selection, method: str, outcome: Outcome) -> Found:
    """A method's outcome judged on the held-out rows."""
    machines, apart, noise = outcome.machines, is_apart(method, config), noise_of_test(measured)
    return Found(
        outcome,
        known_at(pieces_of(measured, config, apart, machines, outcome.values), selection, outcome.values),
        predicted(measured, measured.start[machines], machines),
        predicted(measured, outcome.values, machines),
        None if noise is None else part_of_error(noise, machines),
        apart,
    )


def part_of_error(error: PoseError, machines: Tensor | int) -> PoseError:
    """The pose errors of some machines, or of one."""
    return PoseError(error.position[machines], None if error.rotation is None else error.rotation[machines])


def assemble(
    config: IdentifyConfig,
    measured: Measured,
    selection: Selection,
    found: Mapping[str, Found],
    noise: float | None = None,
    notes: Sequence[str] = (),
) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """What `identified.json` has of every identification, and tensors by name for the pictures.

    The first method's values are the result. Not those of the method of the best held-out error: that would choose by
    the rows that judge.

    Args:
        found: by method, in the config's order.
        noise: of a measured position, where the config names it, all coordinates together [m].
        notes: sentences beside those of the rows and of the methods.
    """
    method, first = next(iter(found.items()))
    blocks = {name: _method_block(measured, one) for name, one in found.items()}
    test, known = blocks[method]["test"], first.known
    # Of a simulated machine the noise is what it is: there only the held-out error is judged.
    given, position = config.noise is not None, test["position"] or {}
    doubts = doubts_of(test, float(known.noise[0]), float(known.freedom[0]), position.get("noise", noise), given)
    messages = [f"{name}: {one.outcome.message}" for name, one in found.items() if one.outcome.message]
    results = {
        "name": config.name,
        "seed": config.seed,
        "mechanism": measured.mechanism.name,
        "allow_code": names_code(measured.mechanism.describe()),
        "machines": measured.machines,
        "simulated": measured.truth is not None,
        "rows": {
            "train": measured.rows.joints.shape[1],
            "per_leg": {str(leg): rows.joints.shape[1] for leg, rows in measured.leg_rows.items()},
            "test": measured.test.joints.shape[1],
        },
        "method": method,
        "parameters": _parameters(measured, selection, first),
        "combinations_not_identifiable": known.combinations,
        "test": test,
        "methods": blocks,
        "compensation": None,
        "singular_values": known.singular_values,
        "noise_ratio": figures({"value": known.noise}),
        "doubts": [*measured.doubts, *doubts],
        "counts": [],
        "paper": None,
        "data_sha256": measured.data_hash or None,
        "notes": [*measured.notes, *messages, *notes],
        "versions": {
            "ccnn_torch": __version__,
            "python": platform.python_version(),
            "torch": torch.__version__,
        },
    }
    arrays = {"start": measured.start}
    arrays |= {f"values_{name}": one.outcome.values for name, one in found.items()}
    errors = {"before": first.before, "after": first.after} | ({} if first.noise is None else {"noise": first.noise})
    for when, error in errors.items():
        arrays |= {f"{part}_{when}": each for part, each in error._asdict().items() if each is not None}
    return results, arrays


def _method_block(measured: Measured, found: Found) -> dict[str, Any]:
    """A method's block, without what only simulated machines show."""
    outcome = found.outcome
    return {
        "test": before_and_after(found.before, found.after, found.noise),
        "seconds": outcome.seconds,
        "machines": len(outcome.machines),
        "per_leg": found.per_leg,
        "converged": float(outcome.converged.double().mean()),
        "evaluations": outcome.evaluations,
        "deviations": None,
        "bound": None,
        "coverage": None,
        "compensation": None,
    }


def promised(measured: Measured, found: Found) -> dict[str, Any] | None:
    """What the held-out rows promise for new ones; None with several machines, of which only one is written, and with
    frames by group of rows, which new rows have not."""
    if measured.machines > 1 or isinstance(measured.mechanism, SetUps | Giving):
        return None
    about = measured.test.observed[0], measured.mechanism.pose
    before, after = (of_whole(part_of_error(e, 0), *about) for e in (found.before, found.after))
    return promise_block(before, after, configurations(measured.test.joints[0], measured.mechanism.joints))


def beside_truth(config: IdentifyConfig, measured: Measured, selection: Selection, found: Found) -> dict[str, Any]:
    """What simulated machines show of a method: entries of its block."""
    outcome, machines = found.outcome, found.outcome.machines
    assert measured.truth is not None
    truth = measured.truth[machines]
    gap = selection.free(outcome.values - truth)
    pieces = pieces_of(measured, config, found.per_leg, machines, truth)
    bound = known_at(pieces, selection, truth).sd
    block: dict[str, Any] = {
        "deviations": _deviations(selection, gap, selection.free(truth - measured.start[machines]))
    }
    identifiable = torch.isfinite(bound).all(0)
    if bool(identifiable.any()):
        ratio = (gap / bound)[:, identifiable].square().mean(0).sqrt()
        block["bound"] = {"median": float(ratio.median()), "lowest": float(ratio.min()), "highest": float(ratio.max())}
        inside = (gap.abs() <= Z95 * found.known.sd)[:, identifiable]
        block["coverage"] = float(inside.double().mean())
    sent = commanded(measured, outcome.values, machines)
    if sent is not None:
        block["compensation"] = {
            name: before_and_after(sent.before, getattr(sent, name), removed=True) for name in ("exact", "linear")
        }
    return block


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


def _parameters(measured: Measured, selection: Selection, found: Found) -> dict[str, Any]:
    """Every parameter of the mechanism; one that is not free has its nominal value and no interval.

    A machine on which the method did not converge has no interval either; where it converged on none, nothing is
    identified.
    """
    outcome, known, settled = found.outcome, found.known, found.outcome.converged
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
            "word": parameter.word,
            "shown": parameter.shown,
        }
        answer[name] = entry
    return answer
