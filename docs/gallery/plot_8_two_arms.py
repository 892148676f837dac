"""
Two measured arms: what the approach does to one and not to the other
=====================================================================

A gear-driven UR5 and a cable-driven Barrett WAM, both measured with a laser tracker, position only (Jacobi 2025; see
`experiments/data`). The records hold the direction in which each joint came to its pose.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import torch

import ccnn_torch as ct

data = next(p / "experiments" / "data" for p in [Path.cwd(), *Path.cwd().parents] if (p / "experiments").is_dir())


def diagnosed(robot, records):
    """Print what is named, and the gap before and after it [mm]."""
    arm = ct.load_mechanism(str(data / f"{robot}.yaml"))
    found = ct.diagnose(records or ct.load_records(data / f"{robot}.csv", arm), arm)
    gap = [1e3 * found.gap[key] for key in ("before", "after")]
    print(f"{robot}: {', '.join(found.verdict['effects'])}; {gap[0]:.2f} mm -> {gap[1]:.3f} mm on held-out rows")
    return found


# %%
# The UR5: nearly all is geometry.
ur5 = diagnosed("ur5", None)

# %%
# The WAM: an error of the joints' gains, sag, and backlash, which here stands for whatever depends on the side from
# which a joint came: position alone does not tell play from the friction of the cables.
wam = diagnosed("wam", None)

# %%
# Is it the approach? A placebo: the same directions, dealt to other rows. Nothing that needs a direction is named.
arm = ct.load_mechanism(str(data / "wam.yaml"))
records = ct.load_records(data / "wam.csv", arm)
order = torch.randperm(len(records), generator=torch.Generator().manual_seed(0))
records.covariates[:] = records.covariates[order]  # directions are all that there is
placebo = diagnosed("wam", records)
assert not {"backlash", "friction"} & set(placebo.verdict["effects"])

# %%
# What each finding takes away when they are added one after the other.
figure, axes = plt.subplots(1, 2, figsize=(8, 3), layout="constrained")
for ax, found, name in zip(axes, (ur5, wam), ("UR5", "WAM"), strict=True):
    steps = [("as it is", found.gap["before"]), *((f"+ {s['name']}", s["gap_after"]) for s in found.in_order)]
    ax.barh([s[0] for s in steps][::-1], [1e3 * s[1] for s in steps][::-1])
    ax.set(title=name, xlabel="gap on held-out rows [mm]")
plt.show()
