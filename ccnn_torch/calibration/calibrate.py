"""From rows to trained methods, their figures, and the compensator of the best repeat."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ccnn_torch.calibration.config import RunConfig, method_names
from ccnn_torch.calibration.evaluate import Outcome, evaluate, pose_before
from ccnn_torch.calibration.fitting import Comparison, Fitted, compare, fit_method, on_other_rows, refit
from ccnn_torch.calibration.prepare import Prepared, damping_of, ends_of, over_all_rows, prepare
from ccnn_torch.calibration.result import best_method, chosen_by, plan_of, run_results
from ccnn_torch.compensation import FORMS, Compensator, UncertainNetwork, fit_compensator, save_model
from ccnn_torch.errors import InputError, MethodFailedError
from ccnn_torch.learners import Learner, make_learner
from ccnn_torch.mechanisms import Mechanism, PoseError, Seen
from ccnn_torch.numerics.blocks import memory_budget
from ccnn_torch.report.json_files import plain
from ccnn_torch.report.results.run import RunResults
from ccnn_torch.run_folder.folder import RunFolder
from ccnn_torch.training import Callback, Scaling
from ccnn_torch.verification.promise import configurations, of_whole, promise_block

Watch = Callable[[Prepared, str, str, Scaling], list[Callback]]
"""Callbacks of one training, given the rows, the method, the phase (`choose` or `fit`) and the phase's scaling."""


@dataclass
class Calibration:
    """What a run found.

    Attributes:
        before: pose error without compensation, `r x s`.
        outcomes: trained methods by name; `failed` has the sentence of each that could not be trained.
        results: the content of `results.json`.
    """

    config: RunConfig
    prepared: Prepared
    before: PoseError
    outcomes: dict[str, Outcome]
    failed: dict[str, str]
    results: RunResults
    frames: Prepared | None = field(default=None, repr=False)

    @property
    def method(self) -> str:
        """The best method."""
        return best_method(self.outcomes)

    def repeat(self, method: str | None = None) -> int:
        """The repeat that is exported: that of the best validation."""
        return int(self.outcomes[method or self.method].score.argmin())

    def mechanism(self, method: str | None = None) -> Mechanism:
        """The nominal machine, with the frames that belong to `compensator`."""
        method = method or self.method
        if method == self.method and self._final is not None and self.frames is not None:
            return self._framed(self.frames, 0)
        return self._framed(self.prepared, self.repeat(method))

    @staticmethod
    def _framed(prepared: Prepared, repeat: int) -> Mechanism:
        parameters = prepared.repeat_parameters(repeat)
        mechanism = prepared.mechanism
        if mechanism.grouped and prepared.physics is not None:
            return prepared.physics.in_own_base(repeat, torch.nonzero(prepared.physics.rows[repeat])[:, 0])[0].mechanism
        if isinstance(mechanism, Seen):
            parameters, mechanism = mechanism.inner_values(parameters), mechanism.mechanism
        return mechanism if parameters is None else mechanism.with_nominal(parameters)

    def compensator(self, method: str | None = None) -> Compensator:
        """The compensator that is saved: of the best method fitted to all rows, of another as it was judged.

        Raises:
            MethodFailedError: there is none; the sentence gives the reason.
        """
        method = method or self.method
        return self._judged(method) if self._final is None or method != self.method else self._final

    def _judged(self, method: str) -> Compensator:
        """The compensator of a method's exported repeat, made without the rows held out."""
        outcome, repeat = self.outcomes[method], self.repeat(method)
        if outcome.without:
            raise MethodFailedError(outcome.without)
        if outcome.compensators:
            return outcome.compensators[repeat]
        return compensator_of(self.config, self.prepared, outcome.fitted, repeat)

    @cached_property
    def _final(self) -> Compensator | None:
        """Of the best method, fitted to all rows of measured records; None where that is not asked for or fails."""
        prepared, outcome = self.prepared, self.outcomes[self.method]
        held_by_file = self.config.split.test_file is not None
        if prepared.source is None or not self.config.refit or self.config.repeats > 1 or held_by_file:
            return None
        if outcome.without:
            return None
        whole = over_all_rows(prepared)
        make = makers(self.config, prepared.default_method)[self.method]
        try:
            fitted = on_other_rows(outcome.fitted, make, whole.dataset, plan_of(self.config))
            found = compensator_of(self.config, whole, fitted, 0)
        except MethodFailedError:
            return None
        self.frames = whole
        return found

    def save(
        self,
        folder: str | Path,
        method: str | None = None,
        name: str = "model",
        forms: Collection[str] = FORMS,
    ) -> float:
        """Write model files and card of a method's compensator.

        Args:
            method: the best one when None.
            forms: which files; each takes a few seconds to export and check.

        Returns:
            The share of what was learned that the compensator applies, 1 unless all of it was too steep.

        Raises:
            MethodFailedError: the model cannot be exported; the sentence gives the reason.
        """
        method = method or self.method
        repeat = self.repeat(method)
        metrics = _of_repeat(plain(self.results.methods[method]), repeat)
        # Seconds differ from run to run, and the model file of one config and seed may not.
        del metrics["seconds"]
        compensator = self.compensator(method)
        metrics["promise"] = self._promise(method)
        about = {
            "mechanism": self.mechanism(method).describe(),
            "method": method,
            "chosen_by": chosen_by(self.config, self.prepared, self.outcomes[method]),
            "data_sha256": self.prepared.data_hash,
            "seed": self.config.seed + repeat,
            "metrics": metrics,
            "rotation_weight": self.config.rotation_weight,
            "damping": damping_of(self.config, self.prepared.mechanism),
            "columns": self.config.columns,
            "joint_map": self.config.joint_map,
        }
        save_model(Path(folder), compensator, about, method=name, forms=forms)
        return compensator.share

    def _promise(self, method: str) -> dict[str, Any] | None:
        """What the held-out rows promise for new ones, by the model that did not see them.

        With frames per group of rows the card has no frames to judge new rows by, and of a simulated machine the
        commanded one is judged: both by the figures of the results.
        """
        prepared, repeat = self.prepared, self.repeat(method)
        test = prepared.dataset.splits[repeat].test
        found = (self.before, self.outcomes[method].explained)
        about = prepared.pose[repeat, test], prepared.mechanism.pose
        before, explained = (of_whole(_rows_of(e, len(prepared.joints), repeat, test), *about) for e in found)
        return promise_block(
            before, explained, configurations(prepared.joints[repeat, test], prepared.mechanism.joints)
        )


def calibrate(
    config: RunConfig, folder: RunFolder | None = None, watch: Watch = lambda *_: [], prepared: Prepared | None = None
) -> Calibration:
    """Train the methods of a config and judge them on held-out rows.

    Args:
        folder: folder of the checkpoints; None = none are written.
        watch: makes the callbacks of every training.
        prepared: the rows, where the caller has them already.

    Raises:
        InputError: the config or its data cannot be used.
        MethodFailedError: no method could be trained.
    """
    with memory_budget(config.max_bytes):
        return _calibrate(config, folder, watch, prepared or prepare(config))


def _calibrate(config: RunConfig, folder: RunFolder | None, watch: Watch, prepared: Prepared) -> Calibration:
    # Looked at before anything is computed, though it is used last.
    _limit(config, len(prepared.mechanism.joints))
    plan, dataset = plan_of(config), prepared.dataset
    before = pose_before(prepared)
    outcomes: dict[str, Outcome] = {}
    failed: dict[str, str] = {}
    found = makers(config, prepared.default_method)
    comparison: Comparison | None = None
    if config.methods == ["auto"]:
        comparison = compare(
            found, dataset, plan, config.auto.budget, folder, lambda name: partial(watch, prepared, name)
        )
        found = {name: found[name] for name in comparison.order}
    for name, make in found.items():
        watched = partial(watch, prepared, name)
        try:
            if comparison is None:
                fitted = fit_method(name, make, dataset, plan, folder, watched)
            else:
                fitted = refit(name, make, dataset, plan, comparison.compared[name], folder, watched)
            outcomes[name] = evaluate(prepared, fitted, partial(compensator_of, config, prepared, fitted))
        except MethodFailedError as problem:
            failed[name] = str(problem)
            continue
        if comparison is not None:
            break
    if not outcomes:
        raise MethodFailedError("; ".join(f"{name}: {sentence}" for name, sentence in failed.items()))
    results = run_results(config, prepared, before, outcomes, failed, comparison)
    return Calibration(config, prepared, before, outcomes, failed, results)


def compensator_of(config: RunConfig, prepared: Prepared, fitted: Fitted, repeat: int) -> Compensator:
    """The compensator of one repeat of a trained method; raises as `fit_compensator`."""
    rows = prepared.dataset.usable_rows("fit")
    there = rows.index[repeat][rows.weights[repeat] > 0]
    network = fitted.learner.network(repeat).cpu()
    sd_scale = fitted.sd_scale[repeat]
    if not isinstance(network, UncertainNetwork):
        # A learner without a variance of its own has one standard deviation everywhere, here as in the results.
        sd_scale = fitted.sd(prepared.dataset.inputs[:, :1])[repeat, 0] / fitted.scaling.deviation[repeat]
    margin, limit = config.compensation.margin, _limit(config, len(prepared.mechanism.joints))
    inputs, covariates = prepared.dataset.inputs[repeat, there], prepared.covariate_coordinates
    scaling = fitted.scaling.repeat(repeat)
    deviations = prepared.dataset.deviation[repeat, there]
    if fitted.name == "constant":
        if prepared.choice is not None and prepared.choice.identify:
            # Identified geometry has the zeros of the joints: their mean remainder is noise.
            deviations = deviations - deviations.mean(0)
            scaling.mean.zero_()
        # It looks at nothing, and a model asks only for what something in it uses.
        used = [] if prepared.physics is None else prepared.physics.uses(repeat)
        kept = [k for k, c in enumerate(covariates) if c.name in used]
        n = len(prepared.mechanism.joints)
        inputs = inputs[:, [*range(n), *(n + k for k in kept)]]
        covariates = tuple(covariates[k] for k in kept)
        scaling = scaling.of_inputs(inputs)
        for second in prepared.mechanism.places(inputs[:, :n], prepared.pose[repeat, there])[1:]:
            # Trusted where either place of a row was.
            inputs = torch.cat([inputs, torch.cat([second, inputs[:, n:]], -1)])
            deviations = deviations.repeat(2, 1)
    names = [c.name for c in covariates]
    machine = None
    if prepared.physics is not None:
        machine = prepared.physics.machine(repeat, there, margin, names)
        machine.ends = ends_of(config, prepared.covariate_coordinates)
    return fit_compensator(
        network,
        scaling,
        inputs,
        deviations,
        prepared.mechanism.joints,
        covariates,
        limit=limit,
        margin=margin,
        sd_scale=sd_scale,
        machine=machine,
    )


def makers(config: RunConfig, default: str = "ccnn") -> dict[str, Callable[[], Learner]]:
    """What makes the learner of each method, by the name that results and files have for it.

    A user's `path/to/file.py:Name` is called `Name` there.
    """
    found: dict[str, Callable[[], Learner]] = {}
    for method in method_names(config, default):
        settings = config.settings(method)
        make_learner(method, settings)
        found[method.rpartition(":")[2]] = partial(make_learner, method, settings)
    return found


def _limit(config: RunConfig, joints: int) -> Tensor | None:
    """The config's limit for every joint, `n` [SI]; None = by the training deviations."""
    given = config.compensation.limit
    if given is None:
        return None
    if len(given) not in (1, joints):
        raise InputError(
            f"compensation.limit has {len(given)} numbers; write one, or one for each of the {joints} joints"
        )
    return torch.tensor(given, dtype=torch.float64).expand(joints).clone()


def _rows_of(error: PoseError, repeats: int, repeat: int, rows: Tensor) -> PoseError:
    """Of one repeat and some rows; all repeats may share their figures."""
    position, rotation = (None if e is None else e.expand(repeats, -1)[repeat, rows] for e in error)
    assert position is not None
    return PoseError(position, rotation)


def _of_repeat(block: Any, repeat: int) -> Any:
    """The same figures for one repeat: every spread becomes its value there."""
    if isinstance(block, dict):
        if set(block) == {"median", "low", "high", "values"}:
            return block["values"][repeat]
        return {key: _of_repeat(value, repeat) for key, value in block.items()}
    return block
