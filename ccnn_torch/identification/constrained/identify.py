"""Identification without a measuring device: from a config with a constraint to the content of `identified.json`."""

from __future__ import annotations

import math
import time
from typing import Any

import torch
from torch import Tensor

from ccnn_torch.config.split import Given, held_out_notes
from ccnn_torch.errors import InputError
from ccnn_torch.identification import Progress
from ccnn_torch.identification.config import IdentifyConfig
from ccnn_torch.identification.constrained.fit import ConstraintFit, fit_constraint, held_distance
from ccnn_torch.identification.constrained.rows import ConstraintRows, read_constraint
from ccnn_torch.identification.doubts import doubts_of
from ccnn_torch.identification.measured.kinematics import Kinematics
from ccnn_torch.identification.measured.measured import Measured, Rows
from ccnn_torch.identification.measured.nominal import nominal_machine
from ccnn_torch.identification.pose_errors import before_and_after
from ccnn_torch.identification.result import Known, method_of, parameter_blocks, results_of
from ccnn_torch.identification.solve import Outcome
from ccnn_torch.mechanisms import Framed, Mechanism, PoseError, SerialArm

# An interval above this share of its prior's is the prior's. Turning machine and plates together turns the residuals,
# too, which the linearised problem takes for a little knowledge.
_AS_PRIOR = 0.9


def identify_by_constraint(
    config: IdentifyConfig, progress: Progress | None = None, given: Given | None = None
) -> tuple[Measured, dict[str, Outcome], dict[str, Any], dict[str, Tensor]]:
    """Identify the machine of a config with a constraint.

    Returns:
        Rows, the outcome of lm, content of `identified.json`, tensors behind the pictures.
    """
    mechanism, notes = _machine(config)
    rows = read_constraint(config, mechanism, given)
    begun = time.perf_counter()
    found = fit_constraint(config, mechanism, rows, progress)
    outcome = Outcome(
        machines=torch.arange(1),
        values=found.after.geometry[None],
        converged=found.fit.converged,
        evaluations=found.fit.evaluations,
        seconds=time.perf_counter() - begun,
        message=found.fit.message,
    )
    held = rows.weights == 0
    notes = [*held_out_notes(config.split, int(held.sum())), *notes]
    measured = Measured(
        mechanism=mechanism,
        kinematics=Kinematics(mechanism),
        view=mechanism,
        rows=Rows(rows.joints[None, ~held], rows.said[None, ~held]),
        leg_rows={},
        test=Rows(rows.joints[None, held], rows.said[None, held]),
        start=found.before.geometry[None],
        data_hash=rows.data_hash,
        notes=notes,
    )
    first, last = (held_distance(mechanism, rows, state)[None, held] for state in (found.before, found.after))
    known = _known(found)
    results = _results(config, measured, outcome, found, known, before_and_after(*map(_position, (first, last))))
    results["constraint"] = _constraint(config, rows, found)
    arrays = {
        "start": measured.start,
        "values_lm": outcome.values,
        "correlation": known.correlation,
        "position_before": first,
        "position_after": last,
    }
    return measured, {"lm": outcome}, results, arrays


def _machine(config: IdentifyConfig) -> tuple[Mechanism, list[str]]:
    """The mechanism; of an arm one without frames per group, since the constraint has its own."""
    mechanism = nominal_machine(config)
    if not isinstance(mechanism, SerialArm):
        return (Framed(mechanism, base=False, tool=True) if config.frame.tool else mechanism), []
    if config.frame.tool:
        raise InputError("frame.tool: an arm has a tool offset of its own, which is identified anyway; remove the key")
    ignored = [key for key in ("frame_per", "tool_per") if getattr(mechanism, key)]
    plain = mechanism.with_orientation("none")
    arm = SerialArm(**{**plain.recipe["keys"], "unknown_frames": [], "frame_per": [], "tool_per": []})
    said = f"{' and '.join(ignored)} of the mechanism count for nothing here: the constraint has its own placements."
    return arm.with_nominal(plain.nominal), [said] if ignored else []


def _position(distance: Tensor) -> PoseError:
    return PoseError(distance, None)


def _known(found: ConstraintFit) -> Known:
    """The machine's part of what is known; a parameter that only its prior determines has no interval."""
    k, knowledge = len(found.selection.parameters), found.knowledge
    determined = knowledge.identifiable & (knowledge.sd < _AS_PRIOR * found.after.problem.prior_sd)
    sd = torch.where(determined, knowledge.sd, math.inf)[:, :k]
    noise = knowledge.noise if found.after.problem.noise_known else torch.ones(1, dtype=torch.float64)
    return Known(
        sd=sd,
        combinations=list(knowledge.combinations),
        correlation=knowledge.correlation[0, :k, :k].clone(),
        singular_values=[knowledge.singular_values[0].tolist()],
        noise=noise,
        freedom=knowledge.freedom,
    )


def _results(
    config: IdentifyConfig,
    measured: Measured,
    outcome: Outcome,
    found: ConstraintFit,
    known: Known,
    test: dict[str, Any],
) -> dict[str, Any]:
    prior = [
        p.name
        for p, sd, seen in zip(found.selection.parameters, known.sd[0], found.knowledge.identifiable[0], strict=False)
        if bool(seen) and not math.isfinite(sd)
    ]
    notes = [f"lm: {outcome.message}"] if outcome.message else []
    if prior:
        notes.append(f"No better known than by the tolerance given: {', '.join(prior)}.")
    doubts = doubts_of(
        test,
        float(known.noise),
        float(known.freedom),
        None if config.noise is None else found.after.noise,
        config.noise is not None,
    )
    parameters = parameter_blocks(measured, found.selection, outcome, known)
    return results_of(config, measured, parameters, known, {"lm": method_of(outcome, test, False)}, doubts, notes)


def _constraint(config: IdentifyConfig, rows: ConstraintRows, found: ConstraintFit) -> dict[str, Any]:
    """What was found of the constraint itself."""
    assert config.constraint is not None
    k, knowledge = len(found.selection.parameters), found.knowledge
    unknowns = {}
    for i, parameter in enumerate(found.after.problem.parameters[k:], start=k):
        sd = float(knowledge.sd[0, i])
        unknowns[parameter.name] = {
            "value": float(found.after.values[0, i]),
            "sd": sd if math.isfinite(sd) else None,
            "unit": parameter.unit,
        }
    return {
        "kind": config.constraint.kind,
        "placements": [
            {"number": number, "columns": label, "rows": int((rows.group == number).sum())}
            for number, label in rows.labels.items()
        ],
        "unknowns": unknowns,
        "noise": found.after.noise,
        "noise_known": config.noise is not None,
    }
