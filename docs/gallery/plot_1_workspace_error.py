"""
What an error of 1 mm in a link does over the workspace
=======================================================

A five-bar with nominal lengths, and the same machine with one link 1 mm longer. One call computes all poses.
"""

import matplotlib.pyplot as plt
import torch

from ccnn_torch import load_mechanism

mechanism = load_mechanism("five_bar")
poses = mechanism.sample_workspace(4000, torch.Generator().manual_seed(0))
joints = mechanism.solve_inverse(poses)

parameters = mechanism.nominal.clone()
parameters[[g.name for g in mechanism.geometry].index("l1")] += 1e-3
error = (mechanism.forward_kinematics(joints, parameters) - poses).norm(dim=-1)

# %%
# The error of the pose is between half and several times the error of the length, and largest near singularities.
figure, axes = plt.subplots(figsize=(5, 4), layout="constrained")
shown = axes.scatter(*poses.T, c=1e3 * error, s=4, vmax=3)
axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
figure.colorbar(shown, label="pose error [mm]")
plt.show()
