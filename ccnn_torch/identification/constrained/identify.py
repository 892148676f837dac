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
from ccnn_torch.identification.measured.kinematics import Kinematics
from ccnn_torch.identification.measured.measured import Measured, Rows
from ccnn_torch.identification.measured.nominal import nominal_machine
from ccnn_torch.identification.result import Found, Known, assemble
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
    fit = fit_constraint(config, mechanism, rows, progress)
    outcome = Outcome(
        machines=torch.arange(1),
        values=fit.after.geometry[None],
        converged=fit.fit.converged,
        evaluations=fit.fit.evaluations,
        seconds=time.perf_counter() - begun,
        message=fit.fit.message,
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
        start=fit.before.geometry[None],
        data_hash=rows.data_hash,
        notes=notes,
    )
    before, after = (PoseError(held_distance(mechanism, rows, s)[None, held], None) for s in (fit.before, fit.after))
    noise = None if config.noise is None else fit.after.noise
    found = Found(outcome, _known(fit), before, after)
    results, arrays = assemble(config, measured, fit.selection, {"lm": found}, noise, _only_by_prior(fit, found.known))
    results["constraint"] = _constraint(config, rows, fit)
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


def _known(fit: ConstraintFit) -> Known:
    """The machine's part of what is known; a parameter that only its prior determines has no interval."""
    k, knowledge = len(fit.selection.parameters), fit.knowledge
    determined = knowledge.identifiable & (knowledge.sd < _AS_PRIOR * fit.after.problem.prior_sd)
    sd = torch.where(determined, knowledge.sd, math.inf)[:, :k]
    noise = knowledge.noise if fit.after.problem.noise_known else torch.ones(1, dtype=torch.float64)
    return Known(
        sd=sd,
        combinations=list(knowledge.combinations),
        correlation=knowledge.correlation[0, :k, :k].clone(),
        singular_values=[knowledge.singular_values[0].tolist()],
        noise=noise,
        freedom=knowledge.freedom,
    )


def _only_by_prior(fit: ConstraintFit, known: Known) -> list[str]:
    """A sentence on the parameters that the rows determine no better than their priors."""
    determined = zip(fit.selection.parameters, known.sd[0], fit.knowledge.identifiable[0], strict=False)
    prior = [p.name for p, sd, seen in determined if bool(seen) and not math.isfinite(sd)]
    return [f"No better known than by the tolerance given: {', '.join(prior)}."] if prior else []


def _constraint(config: IdentifyConfig, rows: ConstraintRows, fit: ConstraintFit) -> dict[str, Any]:
    """What was found of the constraint itself."""
    assert config.constraint is not None
    k, knowledge = len(fit.selection.parameters), fit.knowledge
    unknowns = {}
    for i, parameter in enumerate(fit.after.problem.parameters[k:], start=k):
        sd = float(knowledge.sd[0, i])
        unknowns[parameter.name] = {
            "value": float(fit.after.values[0, i]),
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
        "noise": fit.after.noise,
        "noise_known": config.noise is not None,
    }
