"""Whether an exported form gives the eager model's numbers: vectors of inputs, and how far outputs may be apart."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.compensation.compensator import DAMPED, Compensator

Array = NDArray[Any]

# Near a singular pose rounding grows: what is allowed there, in units of what is allowed elsewhere.
DAMPED_TOLERANCE = 1e3


@dataclass(frozen=True)
class Vectors:
    """Rows of inputs and outputs.

    Attributes:
        joints: given, `s x n` [SI], with NaN and infinities.
        covariates: `s x m` [SI].
        outputs: of the eager model by name, among them `status` and `ideal_status`.
        tolerance: of deviation and of ideal - joints, `n` [SI].
        relative: of the standard deviation [1].
    """

    joints: Array
    covariates: Array
    outputs: dict[str, Array]
    tolerance: Array
    relative: float

    def errors(self, found: dict[str, Array], names: Collection[str] = ()) -> dict[str, float]:
        """Largest difference of each output in the first rows, in units of what is allowed: above 1 is wrong.

        Args:
            names: of outputs; all when empty.
        """
        rows = len(found["command"])
        worst = {}
        for name in names or self.outputs:
            wanted = self.outputs[name][:rows]
            if wanted.dtype.kind in "bi":
                worst[name] = np.inf if (found[name] != wanted).any() else 0.0
                continue
            size = np.abs(wanted)
            own = {"deviation": 0.0, "sd": self.relative * size, "deviation_sd": self.relative * size}
            rounding = own[name] if name in own else 2 * np.spacing(size.astype(found["command"].dtype))
            state = self.outputs["ideal_status" if name == "ideal" else "status"][:rows]
            times = np.where(state == DAMPED, DAMPED_TOLERANCE, 1.0)[:, None]
            # A number that is none is wrong; a joint without deviations has no tolerance.
            share = np.abs(found[name].astype(float) - wanted) / (times * self.tolerance + rounding + 1e-300)
            worst[name] = float(np.nan_to_num(share, nan=np.inf).max())
        return worst


def probe_points(compensator: Compensator, count: int = 256) -> tuple[Tensor, Tensor | None]:
    """Points to compare exports at, `s x n` and `s x m`: the domain, its transition, far outside, not finite."""
    generator = torch.Generator().manual_seed(1)
    domain = compensator.domain
    draw = 2 * torch.rand(count, len(domain.centre), generator=generator, dtype=torch.float64) - 1
    reach = torch.linspace(0.2, 3, count, dtype=torch.float64).unsqueeze(-1)
    spread = domain.centre + domain.half_range * draw * reach
    extreme = [float("nan"), float("inf"), -float("inf"), 1e30, -1e30, 1e300, -1e308, 1e3, -1e3, 0.0, 5e-324]
    rows = [domain.centre.expand(1, -1)]
    for value in extreme:
        rows.append(torch.full((1, len(domain.centre)), value, dtype=torch.float64))
        one = domain.centre.repeat(len(domain.centre), 1)
        one.fill_diagonal_(value)
        rows.append(one)
    points = torch.cat([spread, *rows])
    n = len(compensator.joints)
    return points[:, :n].contiguous(), points[:, n:].contiguous() if compensator.covariates else None
