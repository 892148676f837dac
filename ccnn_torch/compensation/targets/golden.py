"""Golden vectors: inputs, and what the eager model makes of them, to compare every target with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ccnn_torch.compensation.agreement import Vectors, probe_points
from ccnn_torch.compensation.compensator import Compensator
from ccnn_torch.compensation.contraction import TOLERANCE
from ccnn_torch.compensation.targets.form import Form
from ccnn_torch.compensation.targets.from_model import SINGLE_TOLERANCE
from ccnn_torch.compensation.targets.run import run_form
from ccnn_torch.errors import MethodFailedError

_RANDOM = 1000
# Corners of the domain are as many as 2 to the power of its inputs; of more inputs than these the middle is taken.
_CORNERS = 6
# How far beside an edge a vector is, in units of the half range: rounding must not decide on which side.
_BESIDE = {"float64": 1e-9, "float32": 1e-3}


@dataclass(frozen=True)
class Golden(Vectors):
    """Those of a form, with outputs as `run_form` gives them.

    Attributes:
        hard: why single precision may not hold the model.
    """

    hard: str


def golden_vectors(compensator: Compensator, form: Form) -> Golden:
    """A thousand at random, all edges of the domain, far outside, no numbers and infinities."""
    joints, covariates = probe_points(compensator, _RANDOM)
    given = joints if covariates is None else torch.cat([joints, covariates], -1)
    edges = _edges(compensator, _BESIDE[form.dtype])
    n = len(compensator.joints)
    with torch.no_grad():
        # The ideal joints whose command is at an edge, and the edges themselves.
        ideal = torch.cat([compensator.back(*_split(edges, n)), edges[:, n:]], -1)
        given = torch.cat([given, edges, ideal])
        if form.dtype == "float32":
            given = given.float().double()
        found = compensator.solve(*_split(given, n))
        sd = compensator.sd(*_split(given, n))
    names = ("command", "deviation", "ideal", "status", "ideal_status")
    outputs = {name: getattr(found, name).numpy() for name in names}
    if form.sd:
        outputs["sd"] = sd.numpy()
    share = SINGLE_TOLERANCE if form.dtype == "float32" else compensator.export_tolerance
    values = given.numpy()
    return Golden(values[:, :n], values[:, n:], outputs, share * form.limit, 10 * share, _hard(compensator))


def require_equal(form: Form, golden: Golden) -> dict[str, float]:
    """Run the form on the vectors; returns the largest differences in units of what is allowed.

    Raises:
        MethodFailedError: the form is not the model.
    """
    worst = golden.errors(run_form(form, golden.joints, golden.covariates if form.covariates else None))
    wrong = [name for name, share in worst.items() if not share <= 1]
    if wrong and form.dtype == "float32":
        raise MethodFailedError(
            f"single precision does not hold this model: its output '{wrong[0]}' is off by more than "
            f"{SINGLE_TOLERANCE:g} of the limit ({golden.hard}); export it in float64"
        )
    if wrong:
        raise MethodFailedError(
            f"the exported form's output '{wrong[0]}' is not the model's to {golden.tolerance[0] / form.limit[0]:.0e} "
            "of the limit; report the model and the versions of torch and numpy"
        )
    return worst


def _hard(compensator: Compensator) -> str:
    """Which part of a model single precision rounds by more than a small share of its limit, most likely."""
    step, limit = float(np.finfo("float32").eps), float(compensator.limit.max())
    if compensator.machine is not None:
        return f"it computes the machine's kinematics: 1 m is rounded to {step:.1g} m, and the limit is {limit:.1g}"
    if compensator.effects is not None:
        return "its physical effects are polynomials of many terms, which cancel"
    if getattr(compensator.network, "export_tolerance", TOLERANCE) > TOLERANCE:
        return "its network is a sum of many terms, which cancel"
    return f"a joint of 1 m or rad is rounded to {step:.1g}, and the limit is {limit:.1g}"


def _split(rows: Tensor, n: int) -> tuple[Tensor, Tensor | None]:
    return rows[:, :n].contiguous(), rows[:, n:].contiguous() if rows.shape[-1] > n else None


def _edges(compensator: Compensator, beside: float) -> Tensor:
    """Points inside and outside of each face of both boxes, where the fading is half done and ends, and corners."""
    domain = compensator.domain
    d = len(domain.centre)
    # Faces: directions of unit length in units of the half range, and how far along them.
    length = domain.directions.square().sum(-1, keepdim=True)
    unit = domain.directions / length
    rows = []
    for sign in (-1.0, 1.0):
        at = domain.middle + sign * domain.radius
        for beyond in (-beside, beside, 0.5 * domain.width, domain.width):
            rows.append(unit * (at + sign * beyond).unsqueeze(-1))
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0], dtype=torch.float64)] * min(d, _CORNERS))
    corners = torch.nn.functional.pad(corners.reshape(-1, min(d, _CORNERS)), (0, max(0, d - _CORNERS)))
    for share in (1 - beside, 1 + beside):
        rows.append((corners * domain.radius[:d] + domain.middle[:d]) * share)
    return domain.centre + domain.half_range * torch.cat(rows)
