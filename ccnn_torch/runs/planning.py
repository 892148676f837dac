"""From a mechanism and a config to the poses to measure, in a file for the machine and a page for the person."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import torch

from ccnn_torch._table import nearest
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError
from ccnn_torch.identification import ParameterChoice
from ccnn_torch.identification.planning import Plan, plan_poses
from ccnn_torch.identification.problem import Progress
from ccnn_torch.mechanisms import Mechanism, load_mechanism
from ccnn_torch.records import write_table
from ccnn_torch.report.plan import plan_markdown
from ccnn_torch.report.plots import plan_plot, save_figure
from ccnn_torch.runs.plan_config import PlanConfig

__all__ = ["make_plan", "write_plan"]

# Lever over which the noise of a position makes that of an angle [m].
_LEVER = 0.3


def make_plan(
    mechanism: str | Mechanism, poses: int, config: PlanConfig | None = None, progress: Progress | None = None
) -> tuple[Mechanism, list[Plan]]:
    """Plan poses as a config says.

    Args:
        mechanism: a name, a file, or a mechanism.
        poses: how many; with `per_leg` for each leg.
        config: defaults when None.
        progress: told the share that is done.

    Raises:
        InputError: as `load_mechanism` and `plan_poses`; a noise that names something unknown.
    """
    config = config or PlanConfig()
    if poses < 1:
        raise InputError(f"--poses: plan at least 1 pose, not {poses}")
    machine = load_mechanism(mechanism, **config.mechanism_keys) if isinstance(mechanism, str) else mechanism
    wanted = config.parameters
    plans = plan_poses(
        machine,
        poses,
        choice=ParameterChoice(wanted.free, wanted.fixed, wanted.tied, wanted.prior),
        pose_noise=_noise(config.noise, machine.pose, "noise"),
        joint_noise=_noise(config.joint_noise, machine.joints, "joint_noise") if config.joint_noise else None,
        residual=config.residual,
        index=config.index,
        candidates=config.candidates,
        limits=config.limits,
        max_condition=config.max_condition,
        rotation_weight=config.rotation_weight,
        per_leg=config.per_leg,
        repeat=config.repeat,
        least_gain=config.least_gain,
        margin=config.margin,
        seed=config.seed,
        progress=progress,
    )
    return machine, plans


def write_plan(path: Path, mechanism: Mechanism, plans: list[Plan], least_gain: float) -> list[Path]:
    """Write the poses as CSV, and beside it a page (.md) with its picture (.png, .svg).

    The CSV has a row for each pose: `leg[1]` where each leg has its own, the joints to command, and the pose at which
    they bring the nominal machine; rows stand in the order of their worth.

    Returns:
        The files.

    Raises:
        InputError: the name does not end in .csv, or the folder cannot be written.
    """
    if path.suffix.lower() != ".csv":
        raise InputError(f"--out: '{path}' must end in .csv; the page and the picture are written beside it")
    columns = {}
    if plans[0].leg is not None:
        columns["leg[1]"] = torch.cat([torch.full((len(p.pose),), float(p.leg or 0)) for p in plans]).numpy()
    for coordinates, part in ((mechanism.joints, "joints"), (mechanism.pose, "pose")):
        values = torch.cat([getattr(plan, part) for plan in plans])
        columns |= {c.header: values[:, i].numpy() for i, c in enumerate(coordinates)}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as reason:
        raise InputError(f"{path.parent}: cannot be made: {reason.strerror}") from None
    write_table(path, columns)
    plot = plan_plot(mechanism.pose, plans, least_gain)
    pictures = save_figure(plot.figure, path)
    page = path.with_suffix(".md")
    page.write_text(plan_markdown(mechanism.name, plans, least_gain, pictures[0].name, plot.caption), encoding="utf-8")
    return [path, page, *pictures]


def _noise(given: float | dict[str, float], coordinates: Iterable[Coordinate], key: str) -> list[float]:
    """Standard deviation of each coordinate [SI]; one number is that of a length, and an angle has it over a lever."""
    coordinates = tuple(coordinates)
    if not isinstance(given, dict):
        lever = _LEVER if key == "noise" else 1.0
        return [given / lever if c.unit == "rad" else given for c in coordinates]
    names = [c.name for c in coordinates]
    for name in given:
        if name not in names:
            near = nearest(name, names)
            raise InputError(f"{key}.{name}: there is no such coordinate; {f'{near}?' if near else ', '.join(names)}")
    missing = [name for name in names if name not in given]
    if missing:
        raise InputError(f"{key}: gives no standard deviation of {', '.join(missing)}")
    return [given[name] for name in names]
