"""Commands of a model that sticks and slips, of which a pulse in the middle of a motion says nothing."""

from __future__ import annotations

import numpy as np

from ccnn_torch.motion.feed_forward import corrected_command
from ccnn_torch.motion.nominal import Nominal

# The first joint of an arm of the judge `arm_follows`, as it was identified.
OWN = {
    **{"inertia": 4.528e-4, "load": 3.5685e-4, "viscous": 7.408e-3, "derivative": 0.029333, "delay": 0.004},
    **{"coulomb": 2.3884e-3, "load_friction": 0.06396, "stribeck": 6.5506e-4, "stribeck_speed": 0.066223},
    **{"flexibility": 8.5645e-5, "flexible_damping": 0.05, "gravity_cos": 1.834e-4},
}


def test_an_axis_with_dry_friction_behind_a_spring_is_led_to_where_it_is_wanted() -> None:
    """It was sent as wanted: no step brought anything."""
    time = np.arange(0, 8, 0.004)
    turned = np.clip((time - 0.6) / 6.8, 0, 1)
    turned = turned**3 * (10 - 15 * turned + 6 * turned**2)
    nominal = Nominal("servo", ({},), (None,), (None,))
    for turns in (1, 2):
        wanted = -0.035 - 0.126 * np.cos(2 * np.pi * turns * turned)
        found = corrected_command(nominal, [OWN], time, wanted[:, None], errors=[0.022])
        before, after = (np.sqrt(np.square(q[:, 0] - wanted).mean()) for q in (found.plain, found.position))
        assert before > 2e-3 and after < 0.05 * before, turns
