"""The rows of all repeats as padded tensors."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.learners import Learner, TrainingData
from ccnn_torch.mechanisms import Mechanism
from ccnn_torch.pseudoerror import Pseudoerror
from ccnn_torch.records import Records
from ccnn_torch.records.splits import Split
from ccnn_torch.training import Scaling

_SMALLEST_TRAINING_SET = 8


@dataclass(frozen=True)
class Rows:
    """Row numbers of every repeat, padded to one length.

    Attributes:
        index: `r x t` int64.
        weights: `r x t`, 1 for a row, 0 for padding.
    """

    index: Tensor
    weights: Tensor

    def take(self, values: Tensor) -> Tensor:
        """values: `r x s x ...`; returns `r x t x ...`."""
        repeats = torch.arange(len(self.index)).unsqueeze(-1)
        return values[repeats, self.index]


def pad_rows(rows: list[Tensor]) -> Rows:
    """rows: one int64 index tensor a repeat, of any lengths."""
    longest = max(len(one) for one in rows)
    index = torch.zeros(len(rows), longest, dtype=torch.int64)
    weights = torch.zeros(len(rows), longest, dtype=torch.float64)
    for repeat, one in enumerate(rows):
        index[repeat, : len(one)] = one
        weights[repeat, : len(one)] = 1.0
    return Rows(index, weights)


@dataclass(frozen=True)
class Dataset:
    """Commanded joints and covariates against joint deviations, with the splits of every repeat.

    Attributes:
        inputs: joints, then covariates, `r x s x i` [SI]; the repeats of measured records share their rows.
        deviation: pseudoerror, `r x s x n` [SI].
        usable: rows whose pseudoerror is well determined, `r x s` bool; only these are trained on and scored per joint.
        splits: one a repeat.
        seeds: one a repeat.
        periodic: which inputs are fed as sine and cosine, `i` bool: revolute joints that turn by more than a quarter.
        jacobian: of the machine at the commanded joints, `r x s x c x n`: position [m] above rotation [rad], per joint
            unit; learners that can then weigh a row's joint errors by the pose error they cause. None = all alike.
    """

    inputs: Tensor
    deviation: Tensor
    usable: Tensor
    splits: list[Split]
    seeds: list[int]
    periodic: Tensor
    jacobian: Tensor | None = None

    def usable_rows(self, part: str) -> Rows:
        """Usable rows of `train`, `validation`, `fit` (both) or `test`."""
        chosen = [self.part(split, part) for split in self.splits]
        rows = pad_rows([one[self.usable[k, one]] for k, one in enumerate(chosen)])
        if rows.index.shape[1] == 0 or int(rows.weights.sum(-1).min()) == 0:
            raise InputError(
                f"no usable row is left in the {part} part of the split; measure more rows, away from singular "
                "poses, or change split.test and split.validation"
            )
        return rows

    @staticmethod
    def part(split: Split, part: str) -> Tensor:
        """Rows of one part of a split, in the order measured."""
        if part == "fit":
            return torch.cat([split.train, split.validation]).sort().values
        rows: Tensor = getattr(split, part)
        return rows.sort().values

    def scaled(
        self, part: str, validate: bool, learner: Learner, scaling: Scaling | None = None
    ) -> tuple[TrainingData, Scaling]:
        """What a learner takes, scaled by its own training rows, or as given.

        Args:
            part: `train` (validation rows held out) or `fit` (both).
            validate: give the learner the validation rows to look at.
            learner: may ask for the angles of turning joints beside their sines and cosines (`reads_angles`).
        """
        rows = self.usable_rows(part)
        fewest = int(rows.weights.sum(-1).min())
        if fewest < _SMALLEST_TRAINING_SET:
            raise InputError(
                f"only {fewest} usable rows are left to train on; at least {_SMALLEST_TRAINING_SET} are needed: "
                "measure more, or lower split.test and split.validation"
            )
        inputs, targets = rows.take(self.inputs), rows.take(self.deviation)
        if scaling is None:
            angles = getattr(learner, "reads_angles", False)
            scaling = Scaling.fit(inputs, targets, rows.weights, self.periodic, angles)
        held = None
        if validate:
            others = self.usable_rows("validation")
            held = TrainingData(
                scaling.features(others.take(self.inputs)),
                scaling.standardise(others.take(self.deviation)),
                others.weights,
                torch.tensor(self.seeds),
                angles=scaling.angle_count,
            )
        data = TrainingData(
            scaling.features(inputs),
            scaling.standardise(targets),
            rows.weights,
            torch.tensor(self.seeds),
            held,
            self._metric(rows, targets, scaling),
            scaling.angle_count,
            scaling.angle_step,
            tuple(self.periodic.nonzero().flatten().tolist()) if scaling.angle_count else (),
        )
        return data, scaling

    def _metric(self, rows: Rows, targets: Tensor, scaling: Scaling) -> Tensor | None:
        """From an error of the standardised outputs to the pose error it causes, `r x t x c x n` [1].

        Position and rotation are each in units of what the deviations of the training rows cause (root mean square), so
        that neither outweighs the other and no length has to be chosen.
        """
        if self.jacobian is None:
            return None
        jacobian = rows.take(self.jacobian)
        caused = (jacobian @ targets.unsqueeze(-1)).squeeze(-1).square() * rows.weights.unsqueeze(-1)
        total = rows.weights.sum(-1)
        parts = [caused[..., :3].sum((1, 2)) / total, caused[..., 3:].sum((1, 2)) / total]
        scale = torch.cat([part.sqrt().unsqueeze(-1).expand(-1, 3) for part in parts], -1)[:, : jacobian.shape[-2]]
        scale = torch.where(scale > 0, scale, torch.ones_like(scale))
        return jacobian / scale[:, None, :, None] * scaling.deviation[:, None, None, :]


def dataset_of(
    mechanism: Mechanism,
    joints: Tensor,
    covariates: Tensor,
    deviations: Pseudoerror,
    splits: list[Split],
    seeds: list[int],
    jacobian: Tensor | None = None,
    turns_far: Tensor | None = None,
) -> Dataset:
    """Put a dataset together.

    Args:
        joints, covariates: `[r x] s x n`, `[r x] s x m` [SI].
        jacobian: `[r x] s x c x n`. Measured records and realistic machines are judged by the pose, so they bring it;
            the paper's cases are judged by the joints alone.
        turns_far: joints that move by more than a quarter turn, `n` bool; by the rows themselves when None.
    """
    repeats, rows = len(seeds), joints.shape[-2]
    if turns_far is None:
        turns_far = joints.amax(-2) - joints.amin(-2) > torch.pi / 2
    turning = torch.tensor([joint.unit == "rad" for joint in mechanism.joints])
    return Dataset(
        inputs=by_repeat(torch.cat([joints, covariates], -1), seeds),
        deviation=deviations.deviation.expand(repeats, rows, -1),
        usable=deviations.usable.expand(repeats, rows),
        splits=splits,
        seeds=seeds,
        periodic=torch.cat([turning & turns_far, torch.zeros(covariates.shape[-1], dtype=torch.bool)]),
        # Singular rows are not trained on; their Jacobian must only not spoil sums with weight 0.
        jacobian=None if jacobian is None else torch.nan_to_num(jacobian).expand(repeats, rows, -1, -1),
    )


def by_repeat(rows: Tensor, seeds: list[int]) -> Tensor:
    """Rows of every repeat, `r x s x d`, whether they have repeats or share them."""
    return rows.expand(len(seeds), *rows.shape[-2:])


def rows_of(records: Records, rows: Tensor) -> Records:
    """Rows by their numbers, `t`."""
    columns = {name: values[rows.numpy()] for name, values in records.columns.items()}
    parts = {key: getattr(records, key)[rows] for key in ("joints", "pose", "covariates")}
    return replace(records, **parts, columns=columns, lines=records.lines[rows.numpy()], parts=())
