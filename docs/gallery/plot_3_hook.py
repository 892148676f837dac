"""
Compensate by a hook on the inverse kinematics
==============================================

Load the shipped model of the tripod and hook it onto the nominal inverse kinematics. Plot the correction along a path.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import torch

import ccnn_torch as ct

root = Path(ct.__file__).parents[1]
model = ct.load_model(root / "checkpoints" / "tripod" / "model.safetensors")
mechanism = ct.load_mechanism("tripod")

angle = torch.linspace(0, 2 * torch.pi, 200, dtype=torch.float64)
path = torch.stack([0.1 * torch.cos(angle), 0.55 + 0.1 * torch.sin(angle), 0.1 * torch.sin(2 * angle)], dim=-1)
ideal = mechanism.solve_inverse(path)
answer = model(ideal.numpy())

# %%
# The correction of each joint. The command solves ``command + deviation(command) = ideal``.
figure, axes = plt.subplots(figsize=(6, 3), layout="constrained")
for k, joint in enumerate(mechanism.joints):
    axes.plot(torch.rad2deg(angle), 1e6 * (answer["command"][:, k] - ideal[:, k].numpy()), label=joint.name)
axes.set(xlabel="place on the path [deg]", ylabel="correction [µm]")
axes.legend()
plt.show()
