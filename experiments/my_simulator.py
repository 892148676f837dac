"""A simulator of your own as the nominal machine: a five-bar whose drives twist under load, in numpy formulas.

ccnn simulate --mechanism experiments/my_simulator.py:PRESS --effect "parameter spring1:spring1=-6000" --rows 200
--noise 1e-5 --out runs/press.csv
ccnn diagnose --records runs/press.csv --mechanism experiments/my_simulator.py:PRESS --out runs/press
"""

import numpy as np

from ccnn_torch.coordinates import Condition, Parameter
from ccnn_torch.mechanisms import Joint, Simulator


def simulate(commands, covariates, parameters):
    """Position of the tool: commands N x 2 [rad], covariates {name: N}, parameters N x 5 -> N x 2 [m]."""
    crank, coupler, foot = parameters[:, 0], parameters[:, 1], parameters[:, 2]
    feet = np.stack([-foot, foot], -1)
    force = np.stack([covariates["load_x"], covariates["load_y"] - 9.81 * covariates["payload"]], -1)
    angles = commands
    for _ in range(6):  # the twist moves the lever of the load: a fixed point, reached to rounding
        arm = crank[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], -1)
        elbow = arm + np.stack([feet, np.zeros_like(feet)], -1)
        tool = meet(elbow[:, 0], elbow[:, 1], coupler)
        along = (tool[:, None] - elbow) / coupler[:, None, None]
        # The couplers carry the load along themselves, and turn the cranks.
        push = np.linalg.solve(along.swapaxes(-1, -2), force[..., None])
        pull = push * along
        angles = commands + (arm[..., 0] * pull[..., 1] - arm[..., 1] * pull[..., 0]) / parameters[:, 3:5]
    return tool


def meet(first, second, coupler):
    """Where two couplers of the same length meet, above the line between the elbows; NaN where they cannot."""
    half = (second - first) / 2
    with np.errstate(invalid="ignore"):
        height = np.sqrt(coupler**2 / (half**2).sum(-1) - 1)
    return first + half + height[:, None] * np.stack([-half[:, 1], half[:, 0]], -1)


PRESS = Simulator(
    name="press",
    joints=[Joint("q1", "rad", 1.7, 2.3), Joint("q2", "rad", 0.8, 1.4)],
    pose=("x", "y"),
    simulate=simulate,
    parameters=[
        Parameter("crank", "m", 0.75),  # lengths and angles are candidates together, as geometry
        Parameter("coupler", "m", 1.1),
        Parameter("foot", "m", 0.5),
        Parameter("spring1", "N*m/rad", 4e4, scale=4e3, low=1e3),  # anything else by its name: parameter spring1
        Parameter("spring2", "N*m/rad", 4e4, scale=4e3, low=1e3),
    ],
    covariates=("load_x", "load_y", Condition("payload", "kg", usual=0.0, spread=2.0)),
)
