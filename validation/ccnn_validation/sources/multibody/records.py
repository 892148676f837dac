"""A case: a machine with its cause at the strength that was drawn, written as a careful user would have recorded it."""

from __future__ import annotations

import zlib
from dataclasses import replace
from itertools import product

import numpy as np

from ccnn_torch.mechanisms import Mechanism
from ccnn_validation.sources.case import SourceCase, Truth
from ccnn_validation.sources.multibody.alternatives import as_right
from ccnn_validation.sources.multibody.arrays import Array
from ccnn_validation.sources.multibody.build import Build
from ccnn_validation.sources.multibody.design import Design, draw_design
from ccnn_validation.sources.multibody.families import MACHINES, machines_of, parts_of
from ccnn_validation.sources.multibody.machine import Machine
from ccnn_validation.sources.multibody.outsiders import OUTSIDERS
from ccnn_validation.sources.multibody.plan import Plan, gap, joined, poses
from ccnn_validation.sources.multibody.singles import SINGLES

__all__ = ["make"]


def make(family: str, seed: int) -> SourceCase:
    """The case of a family and seed; see `Source`."""
    rng = np.random.default_rng([seed, zlib.crc32(family.encode())])
    machine = MACHINES[str(rng.choice(machines_of(family)))]()
    mechanism = machine.nominal()
    parts = parts_of(family)
    design = draw_design(machine, mechanism, rng, moving="latency" in parts)
    # Growth of a plausible size shows where it is measured well.
    lengths = float(np.exp(rng.uniform(np.log(5e-6), np.log(8e-6 if "thermal" in parts else 2e-5))))
    noise = np.array([2e-5 if c.startswith("r") else lengths for c in machine.pose])
    plan, strength = _plan(parts, machine, mechanism, design, noise, rng)
    clean = poses(machine, plan, strength, design)
    measured = clean + rng.normal(size=clean.shape) * noise
    columns = _commands(machine, design) | _pose(machine, measured) | _covariates(machine, plan, design, rng)
    given = {"m": lengths} | ({"rad": 2e-5} if machine.turns else {})
    return SourceCase(
        family=family,
        mechanism=machine.mechanism,
        columns=columns,
        noise=given if rng.random() < 2 / 3 else None,
        truth=plan.truth,
        mechanism_keys=machine.keys,
        clean=_pose(machine, clean),
    )


def _plan(
    parts: tuple[str, ...],
    machine: Machine,
    mechanism: Mechanism,
    design: Design,
    noise: Array,
    rng: np.random.Generator,
) -> tuple[Plan, float]:
    """What acts, with its truth, and how strongly."""
    if not parts:
        return Plan(lambda strength: Build(), Truth("none", (), (frozenset(),), False)), 1.0
    plans = [(SINGLES | OUTSIDERS)[part](machine, design, rng) for part in parts]
    if len(plans) == 1:
        strength = _strength(machine, plans[0], design, noise, rng.uniform(*plans[0].sizes))
        names = _names(plans[0], strength, machine, mechanism, design, noise)
        return replace(plans[0], truth=replace(plans[0].truth, accepted=names)), strength
    first, second = plans
    target = float(rng.uniform(8, 20))
    # Thermal growth has the size that temperatures of a workshop give it; the other cause follows.
    shares = (target, min(target, second.sizes[1]) if second.sizes[1] < 20 else float(target * rng.uniform(0.6, 1.6)))
    if parts == ("gravity", "compliance"):
        # One set of servos gives under both: between the strengths that either cause alone would have.
        plans[1] = replace(second, build=first.build)
        weight, load = (_strength(machine, plan, design, noise, target) for plan in (first, second))
        strengths = (float(np.sqrt(weight * load)),) * 2
    else:
        strengths = tuple(  # type: ignore[assignment]
            _strength(machine, plan, design, noise, share) for plan, share in zip(plans, shares, strict=True)
        )
    sets = [
        _names(plan, strength, machine, mechanism, design, noise)
        for plan, strength in zip(plans, strengths, strict=True)
    ]
    accepted = tuple(dict.fromkeys(one | other for one, other in product(*sets)))
    accepted += _hidden(parts, plans, strengths, machine, mechanism, design, noise)
    causes = tuple(cause for plan in plans for cause in plan.truth.causes)
    return joined((plans[0], plans[1]), strengths, Truth("pair", causes, accepted, False)), 1.0


def _hidden(
    parts: tuple[str, ...],
    plans: list[Plan],
    strengths: tuple[float, ...],
    machine: Machine,
    mechanism: Mechanism,
    design: Design,
    noise: Array,
) -> tuple[frozenset[str], ...]:
    """One cause alone, where its coefficients copy the other one to within the noise."""
    errors = [gap(machine, poses(machine, p, s, design), design.pose) for p, s in zip(plans, strengths, strict=True)]
    alone = []
    for error, name in zip(reversed(errors), parts, strict=True):
        if name in as_right(machine, mechanism, design, error, noise):
            alone.append(frozenset({name}))
    return tuple(alone)


def _strength(machine: Machine, plan: Plan, design: Design, noise: Array, target: float) -> float:
    """The strength at which the root mean square of the error is `target` times the noise."""
    strength = 1.0
    # Twice, as stops and springs are not quite linear in their strength.
    for _ in range(2):
        error = gap(machine, poses(machine, plan, strength, design), design.pose)
        strength *= target / float(np.sqrt(np.mean((error / noise) ** 2)))
    return strength


def _names(
    plan: Plan, strength: float, machine: Machine, mechanism: Mechanism, design: Design, noise: Array
) -> tuple[frozenset[str], ...]:
    """The right names, and simple ones that explain these rows as well."""
    if plan.truth.kind == "outside":
        return plan.truth.accepted
    error = gap(machine, poses(machine, plan, strength, design), design.pose)
    names = as_right(machine, mechanism, design, error, noise)
    also = tuple(frozenset({name}) for name in names)
    if "instrument" in names:
        # A scale about another point than the middle is a shift as well.
        also += (frozenset({"instrument", "frame"}),)
    return tuple(dict.fromkeys((*plan.truth.accepted, *also)))


def _commands(machine: Machine, design: Design) -> dict[str, Array]:
    return {f"q{i + 1}[{unit}]": design.joints[:, i] for i, unit in enumerate(machine.units)}


def _pose(machine: Machine, values: Array) -> dict[str, Array]:
    return {f"{c}[{'rad' if c.startswith('r') else 'm'}]": values[:, i] for i, c in enumerate(machine.pose)}


def _covariates(machine: Machine, plan: Plan, design: Design, rng: np.random.Generator) -> dict[str, Array]:
    """What shows the cause, and some of what does not."""
    kept = set(plan.columns)
    kept |= {name for name in ("time", "temperature", "direction") if rng.random() < 0.5}
    if plan.plain and rng.random() < 0.3:
        # Nothing gives in this machine: its loads are recorded and do nothing.
        kept.add("load")
    columns: dict[str, Array] = {}
    if "time" in kept:
        columns["time[s]"] = design.time
    if "temperature" in kept:
        columns["temperature[degC]"] = design.temperature
    if "load" in kept:
        for i, c in enumerate(("x", "y", "z", "rx", "ry", "rz")):
            if c in machine.pose and design.load[:, i].any():
                columns[f"load_{c}[{'N*m' if c.startswith('r') else 'N'}]"] = design.load[:, i]
    for name, unit, values in (("direction", "1", design.direction), ("speed", "", design.speed)):
        if name in kept:
            for i, of in enumerate(machine.units):
                columns[f"{name}{i + 1}[{unit or of + '/s'}]"] = values[:, i]
    return columns
