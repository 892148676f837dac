"""The rows of an identification: simulated machines measured with noise, or measured records."""

from __future__ import annotations

from dataclasses import dataclass, field

from torch import Tensor

from ccnn_torch.identification.measured.kinematics import Kinematics
from ccnn_torch.mechanisms import Mechanism


@dataclass(frozen=True)
class Rows:
    """Measured configurations of `r` machines, rows in the order measured.

    Attributes:
        joints: as recorded, `r x s x n` [SI].
        observed: what was measured, `r x s x o` [SI]: pose coordinates of the view, or values of a constraint.
    """

    joints: Tensor
    observed: Tensor

    def of(self, machines: Tensor) -> Rows:
        """The rows of some machines."""
        return Rows(self.joints[machines], self.observed[machines])


@dataclass(frozen=True)
class Measured:
    """Everything that is fixed before the first solver starts.

    Attributes:
        mechanism: what is identified.
        kinematics: how its machines move.
        view: the mechanism as the instrument sees it; its pose coordinates are the columns of `Rows.observed`. The
            mechanism itself, or a view with the same parameters where points on the platform are measured.
        rows: from which all is identified.
        leg_rows: rows for one leg alone, by leg, where each leg has poses of its own; else empty.
        test: held-out rows; their `observed` are poses of the mechanism.
        start: where the search begins, `r x K` [SI]: nominal, or with the frames fitted.
        truth: the simulated machines' parameters, `r x K` [SI]; None for records.
        wanted, wanted_joints: held-out poses that machines are sent to, `r x t x p` [SI], and joints near by,
            `r x t x n` [SI], which select the branch; None for records.
        reached: true poses of the held-out rows, `r x t x p` [SI]; None for records.
        map: poses of the map, `m x p` [SI]; None where none is drawn.
        pose_noise: standard deviation of each observed coordinate, `o` [SI]; None where it is to be estimated.
        joint_noise: of the recorded joints, `n` [SI]; None where there is none.
        data_hash: SHA-256 of the records; empty for simulated data.
        notes: sentences for the person who reads the results.
    """

    mechanism: Mechanism
    kinematics: Kinematics
    view: Mechanism
    rows: Rows
    leg_rows: dict[int, Rows]
    test: Rows
    start: Tensor
    truth: Tensor | None = None
    wanted: Tensor | None = None
    wanted_joints: Tensor | None = None
    reached: Tensor | None = None
    map: Tensor | None = None
    pose_noise: Tensor | None = None
    joint_noise: Tensor | None = None
    data_hash: str = ""
    notes: list[str] = field(default_factory=list)

    @property
    def machines(self) -> int:
        return len(self.start)
