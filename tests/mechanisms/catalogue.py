"""Every kind of mechanism that the package knows; whoever adds one adds a line here and gets its tests."""

from pathlib import Path

from ccnn_torch.mechanisms import Mechanism, load_mechanism

UR10 = """\
robot: UR10
dof: 6
convention: standard Denavit-Hartenberg; link i = Rz(q_i + theta_i) * Tz(d_i) * Tx(a_i) * Rx(alpha_i)
units: {length: mm, angle: rad}
joint_sign: [1, 1, 1, 1, 1, 1]
a:     [0.0, -612.0, -572.3, 0.0, 0.0, 0.0]
alpha: [1.5707963267948966, 0.0, 0.0, 1.5707963267948966, -1.5707963267948966, 0.0]
d:     [127.3, 0.0, 0.0, 163.941, 115.7, 92.2]
theta: [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
parallel_axes: [[2, 3, 4]]
base_frame: unknown 6-dof transform
tool_frame: unknown
record_frame: laser tracker
"""

PANDA = """\
robot: Panda
dof: 7
convention: modified Denavit-Hartenberg (Craig)
units: {length: mm, angle: deg}
a:     [0.0, 0.0, 0.0, 82.5, -82.5, 0.0, 88.0]
alpha: [0, -90, 90, 90, -90, 90, 90]
d:     [333.0, 0.0, 316.0, 0.0, 384.0, 0.0, 107.0]
theta: [0, 0, 0, 0, 0, 0, 0]
base_frame: identity
tool_frame: [0, 0, 100, 0, 0, 45]
"""

SCARA = """\
robot: SCARA
dof: 4
convention: standard Denavit-Hartenberg
units: {length: m, angle: rad}
joint_types: [revolute, revolute, prismatic, revolute]
joint_sign: [1, 1, -1, 1]
a:     [0.4, 0.3, 0.0, 0.0]
alpha: [0.0, 3.141592653589793, 0.0, 0.0]
d:     [0.5, 0.0, 0.0, 0.1]
theta: [0.1, 0.0, 0.0, 0.2]
base_frame: identity
tool_frame: identity
"""

URDF = """\
<robot name="gantry_arm">
  <link name="world"/><link name="rail"/><link name="pillar"/><link name="plate"/><link name="upper"/>
  <link name="fore"/><link name="hand"/><link name="gripper"/><link name="wrist"/>
  <joint name="mount" type="fixed"><parent link="world"/><child link="rail"/>
    <origin xyz="0.1 -0.2 0.3" rpy="0.1 -0.2 0.7"/></joint>
  <joint name="slide" type="prismatic"><parent link="rail"/><child link="pillar"/>
    <origin xyz="0 0.1 0" rpy="0.3 0 0"/><axis xyz="0 1 0"/><limit lower="-0.4" upper="0.6"/></joint>
  <joint name="pan" type="continuous"><parent link="pillar"/><child link="plate"/>
    <origin xyz="0.05 0 0.4" rpy="0 0.2 -0.1"/><axis xyz="0 0 2"/></joint>
  <joint name="spacer" type="fixed"><parent link="plate"/><child link="upper"/><origin xyz="0 0.05 0.1"/></joint>
  <joint name="lift" type="revolute"><parent link="upper"/><child link="fore"/>
    <origin xyz="0 0 0.1" rpy="0 0 0.4"/><axis xyz="0 1 0"/><limit lower="-2" upper="2"/></joint>
  <joint name="elbow" type="revolute"><parent link="fore"/><child link="hand"/>
    <origin xyz="0.5 0 0"/><axis xyz="0.6 0.8 0"/><limit lower="-2" upper="2"/></joint>
  <joint name="twist" type="revolute"><parent link="hand"/><child link="wrist"/>
    <origin xyz="0.4 0.05 0" rpy="-0.3 0.2 0.1"/><axis xyz="1 0 0"/><limit lower="-3" upper="3"/></joint>
  <joint name="grip" type="fixed"><parent link="wrist"/><child link="gripper"/>
    <origin xyz="0.1 0 0.02" rpy="0.2 0.1 -0.3"/></joint>
</robot>
"""

FIVE_BAR = Path(__file__).parent / "five_bar.py"

NAMES = (
    "tripod",
    "machine_tool",
    "five_bar",
    "overconstrained_2dof",
    "ur10",
    "ur10_positions",
    "panda",
    "scara",
    "urdf",
    "users_five_bar",
)


def make(name: str, folder: Path) -> Mechanism:
    """A mechanism of the catalogue; geometry files are written to the folder."""
    files = {"ur10": UR10, "ur10_positions": UR10, "panda": PANDA, "scara": SCARA, "urdf": URDF}
    if name == "users_five_bar":
        return load_mechanism(f"{FIVE_BAR}:FiveBar")
    if name not in files:
        return load_mechanism(name)
    path = folder / (f"{name}.urdf" if name == "urdf" else f"{name}.yaml")
    path.write_text(files[name])
    keys = {"orientation": "none"} if name == "ur10_positions" else {}
    return load_mechanism(str(path), **keys)
