"""What turns the line of sight of a machine that shows directions: its tube that bends, and the air."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.effects.protocol import Coefficient, Effect
from ccnn_torch.effects.situation import Situation
from ccnn_torch.mechanisms import Mechanism, sees_directions

# Ten arc seconds and three [rad]: a tube that bends, and a tenth of what air at sea level refracts at 45°.
_TUBE, _TANGENT = 5e-5, 3e-5
# Sine of the elevation below which refraction is no tangent of the zenith distance any more.
_LOWEST = 0.05


class Flexure(Effect):
    """Δz = TF sin z + TX tan z towards the zenith, z = zenith distance: the terms of those names in TPOINT.

    The first is a tube that bends in proportion to what of its weight is across it; the second one that bends more, or
    refraction of the air that is corrected for too little.
    """

    name = "flexure"
    kind = "pose"
    description = "a tube that bends under its own weight, or refraction of the air"

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """A machine whose rows are directions."""
        return "" if sees_directions(mechanism) else "directions: unit vectors in x, y, z"

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """Of both laws, at the horizon and at 45°."""
        return Coefficient("TF", "rad", _TUBE), Coefficient("TX", "rad", _TANGENT)

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x 3 x 2`."""
        seen, up = torch.nn.functional.normalize(situation.platform[0], dim=-1), -situation.down
        high = (seen @ up)[..., None]
        rise = up - high * seen
        return torch.stack([rise, rise / high.clamp_min(_LOWEST)], -1)
