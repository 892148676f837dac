"""Calibrate, judge, save, and hook the correction onto the inverse kinematics."""

import torch

import ccnn_torch as ct

calibration = ct.calibrate(case="tripod", seed=0)  # or records="my_robot.csv", mechanism="my_robot.yaml"
error = calibration.results["pose"]["position"]
print(f"held-out position error: {1e6 * error['before']['rms']['median']:.0f} µm before, "
      f"{1e6 * error['after']['rms']['median']:.0f} µm after")  # fmt: skip
calibration.save("runs/quickstart")  # model.safetensors, model.onnx, card.json

mechanism = calibration.mechanism()
mechanism.inverse_kinematics.register_forward_hook(calibration.compensator().hook(), with_kwargs=True)
pose = torch.tensor([[0.1, 0.55, 0.05]], dtype=torch.float64)  # y [m], z [m], phi [rad]
print(f"nominal {mechanism.solve_inverse(pose).tolist()} -> command {mechanism.inverse_kinematics(pose).tolist()}")
