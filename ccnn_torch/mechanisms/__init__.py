"""Batched differentiable kinematics: base class, parallel mechanisms, serial arms, and how to load them."""

from ccnn_torch.doors import door

TYPE_CHECKING = False
if TYPE_CHECKING:
    from ccnn_torch.mechanisms.dh_file import read_dh_file as read_dh_file, read_urdf as read_urdf
    from ccnn_torch.mechanisms.frames.fit import fit_frames as fit_frames
    from ccnn_torch.mechanisms.frames.framed import Framed as Framed
    from ccnn_torch.mechanisms.frames.instrument import Instrument as Instrument, fit_unknown as fit_unknown
    from ccnn_torch.mechanisms.frames.judge import judge_frames as judge_frames
    from ccnn_torch.mechanisms.frames.partial import (
        Partial as Partial,
        Seen as Seen,
        as_measured as as_measured,
        sees_directions as sees_directions,
    )
    from ccnn_torch.mechanisms.frames.set_ups import Giving as Giving, SetUps as SetUps, set_ups as set_ups
    from ccnn_torch.mechanisms.machines.delta import Delta as Delta, DeltaLinear as DeltaLinear
    from ccnn_torch.mechanisms.machines.five_bar import FiveBar as FiveBar
    from ccnn_torch.mechanisms.machines.overconstrained import Overconstrained2Dof as Overconstrained2Dof
    from ccnn_torch.mechanisms.machines.serial import SerialArm as SerialArm
    from ccnn_torch.mechanisms.machines.sliders import MachineTool as MachineTool, Tripod as Tripod
    from ccnn_torch.mechanisms.machines.stewart import Stewart as Stewart
    from ccnn_torch.mechanisms.mechanism import InverseKinematics as InverseKinematics, Mechanism as Mechanism
    from ccnn_torch.mechanisms.pose import PoseError as PoseError
    from ccnn_torch.mechanisms.registry import (
        load_mechanism as load_mechanism,
        mechanism_from_description as mechanism_from_description,
        mechanism_of_file as mechanism_of_file,
    )
    from ccnn_torch.mechanisms.simulators.black_box import BlackBox as BlackBox
    from ccnn_torch.mechanisms.simulators.mujoco_model import (
        ModelParameter as ModelParameter,
        mujoco_simulator as mujoco_simulator,
    )
    from ccnn_torch.mechanisms.simulators.simulator import (
        Joint as Joint,
        Simulator as Simulator,
        rowwise as rowwise,
        simulated_rows as simulated_rows,
    )
else:
    __getattr__, __all__ = door(__name__)
