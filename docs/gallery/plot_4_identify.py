"""
Identify the geometry of a five-bar
===================================

Simulated measurements of a machine with errors of its lengths. Levenberg-Marquardt finds them, with standard
deviations.
"""

import matplotlib.pyplot as plt

import ccnn_torch as ct

found = ct.identify(mechanism="five_bar", simulate={"machines": 1, "poses": 40, "noise": 1e-4}, save_report=False)
parameters = {name: p for name, p in found.results["parameters"].items() if p["identifiable"]}

# %%
# The deviation of each parameter from its nominal value, with 95 % intervals.
figure, axes = plt.subplots(figsize=(6, 3), layout="constrained")
deviations = [1e3 * (p["value"] - p["nominal"]) for p in parameters.values()]
axes.errorbar([*parameters], deviations, [1.96e3 * p["sd"] for p in parameters.values()], fmt="o", capsize=3)
axes.axhline(0, color="grey", linewidth=0.8)
axes.set(ylabel="deviation [mm, mrad or 1e-3]")
axes.tick_params(axis="x", rotation=60)
plt.show()
