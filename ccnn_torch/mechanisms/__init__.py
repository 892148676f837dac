"""Batched differentiable kinematics: base class, parallel mechanisms, serial arms, and how to load them."""

from ccnn_torch.mechanisms.files.dh_file import read_dh_file as read_dh_file
from ccnn_torch.mechanisms.files.dh_file import read_urdf as read_urdf
from ccnn_torch.mechanisms.frames.fit import fit_frames as fit_frames
from ccnn_torch.mechanisms.frames.framed import Framed as Framed
from ccnn_torch.mechanisms.frames.judge import judge_frames as judge_frames
from ccnn_torch.mechanisms.machines.delta import Delta as Delta
from ccnn_torch.mechanisms.machines.delta import DeltaLinear as DeltaLinear
from ccnn_torch.mechanisms.machines.five_bar import FiveBar as FiveBar
from ccnn_torch.mechanisms.machines.machine_tool import MachineTool as MachineTool
from ccnn_torch.mechanisms.machines.overconstrained import Overconstrained2Dof as Overconstrained2Dof
from ccnn_torch.mechanisms.machines.serial import SerialArm as SerialArm
from ccnn_torch.mechanisms.machines.stewart import Stewart as Stewart
from ccnn_torch.mechanisms.machines.tripod import Tripod as Tripod
from ccnn_torch.mechanisms.mechanism import InverseKinematics as InverseKinematics
from ccnn_torch.mechanisms.mechanism import Mechanism as Mechanism
from ccnn_torch.mechanisms.pose import PoseError as PoseError
from ccnn_torch.mechanisms.registry import load_mechanism as load_mechanism
from ccnn_torch.mechanisms.registry import mechanism_from_description as mechanism_from_description
from ccnn_torch.mechanisms.registry import mechanism_of_file as mechanism_of_file
from ccnn_torch.mechanisms.simulators.black_box import BlackBox as BlackBox
from ccnn_torch.mechanisms.simulators.mujoco_model import ModelParameter as ModelParameter
from ccnn_torch.mechanisms.simulators.mujoco_model import mujoco_simulator as mujoco_simulator
from ccnn_torch.mechanisms.simulators.simulator import Joint as Joint
from ccnn_torch.mechanisms.simulators.simulator import Simulator as Simulator
from ccnn_torch.mechanisms.simulators.simulator import rowwise as rowwise
from ccnn_torch.mechanisms.simulators.simulator import simulated_rows as simulated_rows
