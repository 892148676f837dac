"""
Which effect causes the residual?
=================================

Simulate rows of a five-bar with backlash, then ask for the cause. The diagnosis is given the rows and nothing else.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

import ccnn_torch as ct

folder = Path(tempfile.mkdtemp())
command = "simulate --mechanism five_bar --effect backlash --rows 200 --noise 10um --seed 2 --quiet --out"
subprocess.run([sys.executable, "-m", "ccnn_torch", *command.split(), str(folder / "rows.csv")], check=True)

mechanism = ct.load_mechanism("five_bar")
diagnosis = ct.diagnose(ct.load_records(folder / "rows.csv", mechanism), mechanism)
print(diagnosis.verdict["text"])

# %%
# The posterior probability of each effect.
effects = [e for e in diagnosis.effects if e["probability"] > 1e-4][:8]
figure, axes = plt.subplots(figsize=(6, 3), layout="constrained")
axes.barh([e["name"] for e in effects][::-1], [e["probability"] for e in effects][::-1])
axes.set(xlabel="posterior probability", xlim=(0, 1))
plt.show()
