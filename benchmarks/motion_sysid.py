"""`mujoco.sysid` on the two true effects of `benchmarks.motion`.

It fits the parameters that its user picks in an MJCF: dry friction is the joint's `frictionloss`. The delay of the
command is one of the sensor, which is the same for an axis that begins at rest.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.peers import sysid
from ccnn_torch.motion.log import Log

Fit = Callable[[], tuple[float, float]]
# The inertia is all armature; the body's own is there because the compiler wants one.
_SERVO = """
<mujoco>
  <option timestep="{step}" integrator="implicitfast" gravity="0 0 0"/>
  <worldbody>
    <body>
      <inertial pos="0 0 0" mass="1e-6" diaginertia="1e-12 1e-12 1e-12"/>
      <joint name="joint" type="hinge" axis="0 1 0" armature="{inertia}" damping="{viscous}" frictionloss="0"/>
    </body>
  </worldbody>
  <actuator><position name="servo" joint="joint" kp="{gain}"/></actuator>
  <sensor><jointpos name="position" joint="joint"/></sensor>
</mujoco>
"""
# Start, least and most: delay [s] and dry friction [N m].
_DELAY, _FRICTION = (0.01, 0.0, 0.1), (0.02, 0.0, 1.0)


def sysid_fit(logs: Sequence[Log], keys: Mapping[str, float], step: float) -> Fit | None:
    """Delay [s] and dry friction [N m] of an axis from all samples of its logs; None where it is not installed.

    Args:
        logs: each begins at rest.
        keys: gain [N m/rad], inertia [kg m2] and viscous friction [N m s/rad].
        step: of its simulation [s].
    """
    tool = sysid()
    if tool is None:
        return None
    import mujoco

    def fit() -> tuple[float, float]:
        spec = mujoco.MjSpec.from_string(_SERVO.format(step=step, **keys))
        model = spec.compile()
        sequences = tool.ModelSequences(
            "servo",
            spec,
            [log.name for log in logs],
            [tool.create_initial_state(model, log.position[0], np.zeros(1)) for log in logs],
            [tool.TimeSeries(log.time, log.command) for log in logs],
            [tool.TimeSeries.from_names(log.time, log.position, model) for log in logs],
        )

        def rub(own: Any, value: Any) -> None:
            own.joint("joint").frictionloss = value.value[0]

        start = tool.ParameterDict()
        start.add(tool.Parameter("delay", *_DELAY))
        start.add(tool.Parameter("friction", *_FRICTION, modifier=rub))
        late = tool.SignalTransform()
        late.delay("position", start["delay"])
        residual = tool.build_residual_fn(models_sequences=[sequences], modify_residual=late.apply, n_threads=1)
        with contextlib.redirect_stdout(io.StringIO()):
            found, _ = tool.optimize(start, residual, verbose=False)
        return float(found["delay"].value[0]), float(found["friction"].value[0])

    return fit
