"""
Calibrate the paper's tripod
============================

Train a CCNN on the first case study and compare the pose error with and without the compensator on held-out rows.
"""

import matplotlib.pyplot as plt

import ccnn_torch as ct

calibration = ct.calibrate(case="tripod", seed=0, ccnn={"generations": 40, "refinement_iterations": 10, "members": 2})
position = calibration.results["pose"]["position"]
before, after = (1e6 * position[key]["rms"]["median"] for key in ("before", "after"))
print(f"held-out rows: {before:.0f} µm before, {after:.0f} µm after")

# %%
# The mean squared joint error stands beside the constant correction and the noise that was drawn in the test rows.
results = calibration.results
names = [*results["methods"], "constant", "noise floor"]
blocks = [*(m["test"] for m in results["methods"].values()), results["constant"]["test"], results["floor"]["realised"]]
figure, axes = plt.subplots(figsize=(5, 3), layout="constrained")
axes.bar(names, [b["all"]["mse"]["median"] for b in blocks])
axes.set(yscale="log", ylabel="mean squared joint error [m²]")
plt.show()
