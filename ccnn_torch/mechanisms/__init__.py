"""Batched differentiable kinematics: base class, parallel mechanisms, serial arms, and how to load them."""

from ccnn_torch.mechanisms._inverse_kinematics import InverseKinematics as InverseKinematics
from ccnn_torch.mechanisms._mechanism import Mechanism as Mechanism
from ccnn_torch.mechanisms._pose import PoseError as PoseError
from ccnn_torch.mechanisms._registry import load_mechanism as load_mechanism
from ccnn_torch.mechanisms._registry import mechanism_from_description as mechanism_from_description
from ccnn_torch.mechanisms._registry import mechanism_of_file as mechanism_of_file
from ccnn_torch.mechanisms._simulator_calls import simulated_rows as simulated_rows
from ccnn_torch.mechanisms.black_box import BlackBox as BlackBox
from ccnn_torch.mechanisms.delta import Delta as Delta
from ccnn_torch.mechanisms.delta import DeltaLinear as DeltaLinear
from ccnn_torch.mechanisms.dh_file import read_dh_file as read_dh_file
from ccnn_torch.mechanisms.five_bar import FiveBar as FiveBar
from ccnn_torch.mechanisms.frame_fit import judge_frames as judge_frames
from ccnn_torch.mechanisms.framed import Framed as Framed
from ccnn_torch.mechanisms.frames import fit_frames as fit_frames
from ccnn_torch.mechanisms.machine_tool import MachineTool as MachineTool
from ccnn_torch.mechanisms.mujoco_model import ModelParameter as ModelParameter
from ccnn_torch.mechanisms.mujoco_model import mujoco_simulator as mujoco_simulator
from ccnn_torch.mechanisms.overconstrained import Overconstrained2Dof as Overconstrained2Dof
from ccnn_torch.mechanisms.serial import SerialArm as SerialArm
from ccnn_torch.mechanisms.simulator import Joint as Joint
from ccnn_torch.mechanisms.simulator import Simulator as Simulator
from ccnn_torch.mechanisms.simulator import rowwise as rowwise
from ccnn_torch.mechanisms.stewart import Stewart as Stewart
from ccnn_torch.mechanisms.tripod import Tripod as Tripod
from ccnn_torch.mechanisms.urdf import read_urdf as read_urdf
