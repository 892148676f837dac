"""Trial of a user's mechanism when it is loaded; an error becomes one sentence."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from typing import Any

import torch

from ccnn_torch.errors import CcnnError, InputError
from ccnn_torch.mechanisms.assembly_mode import jump_sentence, settle_home
from ccnn_torch.mechanisms.mechanism import Mechanism
from ccnn_torch.mechanisms.simulators.black_box import BlackBox
from ccnn_torch.mechanisms.simulators.simulator import Simulator

# A root is settled to about 1e-12; a user's own closed form may close a little worse [m, rad].
_CLOSES = 1e-6
_ADVICE = "ccnn_torch.testing.check_mechanism reports more"


def checked_plugin(spec: str, make: Callable[[], Any]) -> Mechanism:
    """Make a user's mechanism and try it at its home configuration, alone and with two sets of parameters.

    Home joints that are only near those of the home pose are settled first; numeric inverse kinematics are then held
    against a walk through the sampling box, which must not end on another branch.
    """
    try:
        mechanism = make()
        if isinstance(mechanism, Simulator):
            mechanism = BlackBox(mechanism)
        if not isinstance(mechanism, Mechanism):
            raise InputError(
                f"{spec}: is no mechanism; derive the class from ccnn_torch.mechanisms.Mechanism, or make a Simulator"
            )
        wrong = wrong_names(mechanism) or _wrong_shape_of_closure(mechanism)
        if not wrong:
            settle_home(mechanism)
            wrong = _wrong_kinematics(mechanism) or jump_sentence(mechanism)
    except CcnnError:
        raise
    except (Exception, SystemExit) as error:  # a user's code may raise anything
        said = str(error).strip().splitlines() or [""]
        raise InputError(f"{spec}{_line(spec, error)}: {type(error).__name__}: {said[0]}") from error
    if wrong:
        raise InputError(f"{spec}: {wrong}; {_ADVICE}")
    return mechanism


def wrong_names(m: Mechanism) -> str:
    """What is wrong with names, units, legs and the sampling box; empty where nothing is."""
    n, wanted = len(m.joints), [f"q{i + 1}" for i in range(len(m.joints))]
    if n == 0 or [j.name for j in m.joints] != wanted:
        return f"its joints must be named {', '.join(wanted) or 'q1, q2, …'}, not {[j.name for j in m.joints]}"
    for kind, names in (("pose", [c.name for c in m.pose]), ("geometry", [g.name for g in m.geometry])):
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            return f"its {kind} has the name '{twice[0]}' twice"
    strange = [c.header for c in (*m.joints, *m.pose) if c.unit not in ("m", "rad")]
    if strange:
        return f"joints and pose are in m or rad, not {strange[0]}"
    legless = [g for g in m.geometry if g.leg is not None and g.leg not in range(1, n + 1)]
    if legless:
        return f"parameter '{legless[0].name}' belongs to leg {legless[0].leg}; legs are numbered from 1 to {n}"
    if m.low.shape != (len(m.pose),) or m.high.shape != (len(m.pose),) or not bool((m.low < m.high).all()):
        return f"low and high need {len(m.pose)} numbers each, low below high"
    return ""


def _wrong_shape_of_closure(m: Mechanism) -> str:
    """Of a closure of its own, before anything solves it: 2 poses, as many joints, in two sets of parameters."""
    if type(m).closure is Mechanism.closure:
        return ""
    n, p, lead = len(m.joints), len(m.pose), (2, 3)
    gap = m.closure(m.home_pose.expand(*lead, p), m.home_joints.expand(*lead, n), m.nominal.expand(2, 1, -1))
    if isinstance(gap, torch.Tensor) and gap.shape[:-1] == lead:
        return ""
    got = f"shape {tuple(gap.shape)}" if isinstance(gap, torch.Tensor) else f"a {type(gap).__name__}"
    return (
        f"closure returned {got} for 2 x 3 configurations, expected (2, 3, N) with one number for each of N equations: "
        "stack them along the last dim, torch.stack([…], -1)"
    )


def _wrong_kinematics(m: Mechanism) -> str:
    n, p, sets = len(m.joints), len(m.pose), m.nominal.expand(2, 1, -1)
    pose = m.home_pose.expand(3, -1)
    joints = m.solve_inverse(pose, sets, m.home_joints)
    if joints.shape != (2, 3, n):
        got = tuple(joints.shape)
        return f"solve_inverse gives shape {got} for 3 poses and 2 sets of parameters, expected (2, 3, {n})"
    if joints.dtype != torch.float64:
        return f"solve_inverse gives {joints.dtype}, expected torch.float64"
    if not bool(torch.isfinite(joints).all()):
        return "its home pose has no joints; give home_pose (and home_joints near a solution)"
    gap = m.closure(pose, joints, sets)
    if not float(gap.abs().max()) <= _CLOSES:
        return f"closure is {float(gap.abs().max()):.2g} at the joints that solve_inverse gives, expected 0"
    there = m.forward_kinematics(joints, sets, m.home_pose)
    if there.shape != (2, 3, p):
        return f"forward_kinematics gives shape {tuple(there.shape)} for 2 x 3 configurations, expected (2, 3, {p})"
    error = m.pose_error(there, pose)
    off = max(float(e.max()) for e in error if e is not None)
    if not off <= _CLOSES:
        return f"forward_kinematics of the home pose's joints misses it by {off:.2g}"
    return ""


def _line(spec: str, error: BaseException) -> str:
    """` line N` of the innermost call in the user's file."""
    file = spec.rpartition(":")[0]
    lines = [f.lineno for f in traceback.extract_tb(error.__traceback__) if f.filename.endswith(file)]
    return f" line {lines[-1]}" if lines else ""
