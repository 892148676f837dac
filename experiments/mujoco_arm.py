"""A MuJoCo model as the nominal machine (pip install 'ccnn-torch[mujoco]'): an arm that sags on its servos.

ccnn simulate --mechanism experiments/mujoco_arm.py:ARM --effect "parameter fore mass:fore_mass=0.15" --rows 200
--noise 1e-5 --out runs/arm.csv
ccnn diagnose --records runs/arm.csv --mechanism experiments/mujoco_arm.py:ARM --out runs/arm
"""

from pathlib import Path

from ccnn_torch.mechanisms import ModelParameter, mujoco_simulator

ARM = mujoco_simulator(
    Path(__file__).with_name("mujoco_arm.xml"),
    actuators={"shoulder": (-1.2, -0.2), "elbow": (0.5, 1.5)},  # q1, q2, and their workspace [rad]
    measured="tool",
    pose=("x", "z"),
    parameters=[
        ModelParameter("body", "fore", "pos", 1e-3, axis="x"),  # the upper arm's length
        ModelParameter("site", "tool", "pos", 1e-3, axis="x"),
        ModelParameter("actuator", "shoulder", "kp", 200.0),
        ModelParameter("actuator", "elbow", "kp", 150.0),
        ModelParameter("body", "fore", "mass", 0.1),
    ],
)
