"""The machine with the effects that a verdict names, as a compensator takes it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from ccnn_torch.diagnosis.from_file import TRAINING_ROWS, Verdict, usable_verdict
from ccnn_torch.diagnosis.joint_fit import fit_jointly, loose_parameters, on_fitted_frames
from ccnn_torch.diagnosis.result import Diagnosis
from ccnn_torch.effects import Acting, used_covariates
from ccnn_torch.effects.covariates import covariate_units
from ccnn_torch.effects.found_machine import found_block
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import BlackBox, SerialArm


def named_machine(said: Diagnosis) -> dict[str, Any] | None:
    """The entry `machine` of a diagnosis.json: effects and geometry that were named, fitted together to the rows.

    Where geometry is among the names, all parameters are identified, six a link of an arm. None where a model can hold
    nothing of the verdict: no effect, one that needs the rows in order, frames per group of rows, or a simulator.
    """
    analysis, here = said.analysis, said.analysis.situation
    grouped = here.parameters is not None and here.parameters.dim() > 1
    if grouped or isinstance(here.mechanism, BlackBox):
        return None
    recorded = replace(here, covariates={n: v for n, v in here.covariates.items() if n not in said.inferred})
    named = tuple((a.effect.name, _numbers(a, said)) for a in said.acting)
    try:
        verdict = usable_verdict(Verdict(TRAINING_ROWS, here.gravity, named), recorded)[0]
        if verdict is None:
            return None
        situation = on_fitted_frames(recorded)
        identify = any(a.effect.kind == "parameters" for a in said.acting)
        if identify and isinstance(situation.mechanism, SerialArm):
            situation = replace(situation, mechanism=situation.mechanism.with_link_frames())
        known = [k for k in verdict.on(recorded)[0] if k.effect.kind != "parameters"]
        loose = loose_parameters(situation.mechanism, identify)
        fine = (analysis.whitening.weight > 0) & ~analysis.near_singular
        acting, values = fit_jointly(situation, analysis.measured, known, fine, loose)
        used = used_covariates(situation, acting)
        situation = replace(situation, covariates={n: v for n, v in situation.covariates.items() if n in used})
        return found_block(situation, values, acting, covariate_units(situation.mechanism))
    except InputError:
        # A machine that no file describes, or an effect that needs what was before a row.
        return None


def _numbers(acting: Acting, said: Diagnosis) -> dict[str, float]:
    """Coefficients that were found and shapes, by name [SI]."""
    here = said.analysis.situation
    names = [c.name for c in acting.effect.coefficients(here)] + [s.name for s in acting.effect.shapes(here)]
    values = [*acting.coefficients.tolist(), *acting.shape.tolist()]
    return {name: value for name, value in zip(names, values, strict=True) if value}
