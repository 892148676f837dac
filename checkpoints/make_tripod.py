"""Train the shipped tripod compensator again: python checkpoints/make_tripod.py

Case study one with the defaults for users (six members, refined), trained on 100 rows, judged on 25; model and card go
to checkpoints/tripod/.
"""

from pathlib import Path

import ccnn_torch as ct

calibration = ct.calibrate(case="tripod", seed=0, split={"test": 0.2, "validation": 0.2})
folder = Path(__file__).parent / "tripod"
calibration.save(folder)
# With `controller.onnx`, the command alone.
ct.export_model(folder / "model.safetensors", "onnx", folder)
test = calibration.results["methods"]["ccnn"]
print(
    f"held-out mse {test['test']['all']['mse']['median']:.3g} m², {test['ratio_to_floor']['median']:.3f} of the floor"
)
