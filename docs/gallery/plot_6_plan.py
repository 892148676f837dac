"""
Which poses to measure
======================

Choose 24 poses that determine the parameters of a five-bar best, and compare them with the whole workspace.
"""

import matplotlib.pyplot as plt
import torch

from ccnn_torch import load_mechanism
from ccnn_torch.planning import plan_poses

mechanism = load_mechanism("five_bar")
(plan,) = plan_poses(mechanism, 24, pose_noise=1e-4)
poses = mechanism.forward_kinematics(plan.joints)
workspace = mechanism.sample_workspace(3000, torch.Generator().manual_seed(0))

# %%
# The most informative poses are at the edge of the workspace.
figure, axes = plt.subplots(figsize=(5, 4), layout="constrained")
axes.scatter(*workspace.T, s=2, color="lightgrey", label="workspace")
axes.scatter(*poses.T, s=25, label="planned poses")
axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
axes.legend()
plt.show()
