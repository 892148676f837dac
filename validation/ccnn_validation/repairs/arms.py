"""Models of arms as they were published before and after a repair: numbers alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ccnn_validation.delivered.chain import Chain
from ccnn_validation.delivered.rotation import Array

COLUMNS = ("x", "y", "z", "roll", "pitch", "yaw", "axis_x", "axis_y", "axis_z", "low", "high")
"""Of a joint: place [mm] and orientation [°] in the link before it, its axis there, its limits [°]."""


@dataclass(frozen=True)
class Repair:
    """A repaired model.

    Attributes:
        name: the arm.
        source: repository and pull request or commit.
        found: what people said was wrong.
        old: `COLUMNS` of each joint, one line a joint, and x y z roll pitch yaw of the flange as the last line.
        new: numbers after the repair, by joint (from 1; the flange comes last) and column.
    """

    name: str
    source: str
    found: str
    old: str
    new: dict[tuple[int, str], float]


def numbers(repair: Repair, repaired: bool) -> Array:
    """`COLUMNS` of each joint and of the flange, `(n + 1) x 11` [mm, °]."""
    lines = [[float(word) for word in line.split()] for line in repair.old.strip().splitlines()]
    table = np.array([line + [0.0] * (len(COLUMNS) - len(line)) for line in lines])
    for (joint, column), value in (repair.new if repaired else {}).items():
        table[joint - 1, COLUMNS.index(column)] = value
    return table


def chain_of(table: Array) -> Chain:
    """The chain of such numbers."""
    places = [(1e-3 * row[:3], Rotation.from_euler("xyz", row[3:6], degrees=True).as_matrix()) for row in table]
    return Chain(tuple(places[:-1]), table[:-1, 6:9], ("rad",) * (len(table) - 1), places[-1])


REPAIRS = (
    Repair(
        "KUKA LBR iiwa 14 R820",
        "kroshu/kuka_robot_descriptions PR 70",
        "link 0 and link 2 are 20 mm too short: they are those of the iiwa 7",
        """
        0 0 137.5  0 0 0  0 0 1  -170 170
        0 0 202.5  0 0 0  0 1 0  -120 120
        0 0 184.5  0 0 0  0 0 1  -170 170
        0 0 215.5  0 0 0  0 -1 0  -120 120
        0 0 184.5  0 0 0  0 0 1  -170 170
        0 0 215.5  0 0 0  0 1 0  -120 120
        0 0 81  0 0 0  0 0 1  -175 175
        0 0 71  0 0 0
        """,
        {(1, "z"): 157.5, (3, "z"): 204.5},
    ),
    Repair(
        "Universal Robots UR10",
        "ros-industrial/universal_robot PR 82",
        "link lengths of the model are not those of the controller's configuration",
        """
        0 0 128  0 0 0  0 0 1  -180 180
        0 170.4 0  0 90 0  0 1 0  -180 180
        0 -128.17 601.86  0 0 0  0 1 0  -180 180
        0 0 564.15  0 90 0  0 1 0  -180 180
        0 112.79 0  0 0 0  0 0 1  -180 180
        0 0 112.79  0 0 0  0 1 0  -180 180
        0 85.7 0  0 0 90
        """,
        {
            (1, "z"): 127.3,
            (2, "y"): 220.941,
            (3, "y"): -171.9,
            (3, "z"): 612.0,
            (4, "z"): 572.3,
            (5, "y"): 114.9,
            (6, "z"): 115.7,
            (7, "y"): 92.2,
        },
    ),
    Repair(
        "Fanuc LR Mate 200iC/5F",
        "ros-industrial/fanuc_experimental a637d4a",
        "link 4 is 0.5 mm too short: the data sheet was misread",
        """
        0 0 330  0 0 0  0 0 1  -170 170
        75 0 0  0 0 0  0 1 0  -60 140
        0 0 300  0 0 0  0 -1 0  -142 230
        327 0 75  0 0 0  0 -1 0  -120 120
        80 0 0  0 0 0  -1 0 0  -360 360
        0 0 0  180 -90 0
        """,
        {(4, "x"): 327.5},
    ),
    Repair(
        "Fanuc LR Mate 200iD",
        "ros-industrial/fanuc_experimental fb536cb (issue 16)",
        "joint 6 turns the other way",
        """
        0 0 330  0 0 0  0 0 1  -170 170
        50 0 0  0 0 0  0 1 0  -100 145
        0 0 330  0 0 0  0 -1 0  -140 280
        0 0 35  0 0 0  -1 0 0  -190 190
        335 0 0  0 0 0  0 -1 0  -125 125
        80 0 0  0 0 0  1 0 0  -360 360
        0 0 0  180 -90 0
        """,
        {(6, "axis_x"): -1.0},
    ),
    Repair(
        "Motoman MH5",
        "ros-industrial/motoman 7a87a0e (issue 122)",
        "joint T is 35.5 mm too close to joint B",
        """
        0 0 199  0 0 0  0 0 1  -170 170
        88 0 131  0 0 0  0 1 0  -65 150
        0 0 310  0 0 0  0 -1 0  -136 255
        71.5 0 39.9  0 0 0  -1 0 0  -190 190
        233.5 0 0  0 0 0  0 -1 0  -125 125
        51 0 0  0 0 0  -1 0 0  -360 360
        0 0 0  180 -90 0
        """,
        {(6, "x"): 86.5},
    ),
    Repair(
        "KUKA KR 300 R2700-2",
        "ros-industrial/kuka_experimental 8f67816",
        "lengths are not those of the data sheet, by 2.5 to 9.4 mm",
        """
        0 0 235.6  0 0 0  0 0 1  -185 185
        330 90 409.4  0 0 0  0 1 0  -55 85
        0 -195 1145  0 0 0  0 1 0  -210 78
        868.5 105 112  0 0 0  1 0 0  -350 350
        351.5 0 0  0 0 0  0 1 0  -125 125
        200 0 0  0 0 0  1 0 0  -350 350
        37.5 0 -0.23924  0 90 0
        """,
        {(1, "z"): 245.0, (2, "z"): 400.0, (3, "z"): 1150.0, (4, "z"): 115.0, (7, "x"): 40.0, (7, "z"): 0.0},
    ),
    Repair(
        "KUKA KR 6 R900 sixx",
        "ros-industrial/kuka_experimental PR 52",
        "the zero position is wrong: link 2 lies along x, not along z",
        """
        0 0 400  0 0 0  0 0 -1  -170 170
        25 0 0  0 0 0  0 1 0  -190 45
        0 0 455  0 0 0  0 1 0  -120 156
        0 0 35  0 0 0  -1 0 0  -185 185
        420 0 0  0 0 0  0 1 0  -120 120
        80 0 0  0 0 0  -1 0 0  -350 350
        0 0 0  0 90 0
        """,
        {(3, "x"): 455.0, (3, "z"): 0.0},
    ),
    Repair(
        "igus ReBeL",
        "CommonplaceRobotics/iRC_ROS PR 99",
        "joint 5 counts from 7.5° beside the real zero",
        """
        0 0 100  0 0 0  0 0 -1  -179 179
        0 0 149  0 30 0  0 1 0  -120 120
        0 0 238.4  0 30 0  0 1 0  -120 120
        0 0 119  0 0 0  0 0 1  -179 179
        0 0 170  0 0 0  0 1 0  -95 95
        0 0 120.8  0 0 0  0 0 1  -179 179
        0 0 1.2  0 0 0
        """,
        {(5, "pitch"): -7.5},
    ),
    Repair(
        "Universal Robots UR5e",
        "visose/Robots PR 275",
        "d1, a3 and d5 are 0.2, 0.05 and 0.6 mm beside the maker's",
        """
        0 0 0  0 0 0  0 0 1  -180 180
        0 0 162.3  90 0 0  0 0 1  -180 180
        -425 0 0  0 0 0  0 0 1  -180 180
        -392.25 0 0  0 0 0  0 0 1  -180 180
        0 0 133.3  90 0 0  0 0 1  -180 180
        0 0 100.3  -90 0 0  0 0 1  -180 180
        0 0 99.6  0 0 0
        """,
        {(2, "z"): 162.5, (4, "x"): -392.2, (6, "z"): 99.7},
    ),
    Repair(
        "SO-100",
        "TheRobotStudio/SO-ARM100 PR 95",
        "joint 1 turns the other way; joints 2, 3 and 4 count from 100°, -90° and -30° beside the real zero",
        """
        0 -45.2 16.5  90 0 0  0 1 0  -110 110
        0 102.5 30.6  -103.132 0 0  1 0 0  0 180
        0 112.57 28  90 0 0  1 0 0  -180 0
        0 5.2 134.9  -57.296 0 0  1 0 0  -143 69
        0 -60.1 0  0 90 0  0 1 0  -180 180
        0 0 0  0 0 0
        """,
        {(1, "axis_y"): -1.0, (2, "roll"): -2.865, (3, "roll"): 0.0, (4, "roll"): -87.296, (5, "pitch"): 180.0},
    ),
    Repair(
        "Doosan M1013",
        "DoosanRobotics/doosan-robot a628031 (issue 80)",
        "the flange is 3 mm too far out",
        """
        0 0 152.5  0 0 0  0 0 1  -180 180
        0 34.5 0  0 -90 -90  0 0 1  -95 95
        620 0 0  0 0 90  0 0 1  -135 135
        0 -559 0  90 0 0  0 0 1  -180 180
        0 0 0  -90 0 0  0 0 1  -135 135
        0 -124 0  90 0 0  0 0 1  -180 180
        0 0 0  0 0 0
        """,
        {(6, "y"): -121.0},
    ),
    Repair(
        "Motoman SDA10F, left arm",
        "ros-industrial/motoman PR 271 (issue 232)",
        "places of the joints are not those of the maker's drawing, up to 50 mm at the tool",
        """
        99.96 27.5 322.14  89.954 0 0  0 0 -1  -179 179
        0 57.7 -225.5  -89.954 0 0  0 0 -1  -109 109
        0 169 -45.4  89.954 0 0  0 0 -1  -169 169
        0 -8.5 -181  -89.954 0 0  0 0 1  -135 135
        0 193.6 15.5  89.954 0 0  0 0 1  -179 179
        0 8 -155  -89.954 0 0  0 0 1  -109 109
        0 168 -15  89.954 0 0  0 0 -1  -179 179
        0 0 0  0 0 -179.336
        """,
        {
            (1, "x"): 100.0,
            (1, "z"): 311.4,
            (2, "y"): 53.9,
            (2, "z"): -237.5,
            (3, "y"): 211.0,
            (3, "z"): -53.9,
            (4, "y"): -37.5,
            (4, "z"): -149.0,
            (5, "y"): 233.0,
            (5, "z"): 37.5,
            (6, "y"): 33.5,
            (6, "z"): -127.0,
            (7, "y"): 155.0,
            (7, "z"): -33.5,
        },
    ),
    Repair(
        "Rainbow Robotics RB10-1300E",
        "RainbowRobotics/rbpodo_ros2 PR 2",
        "wrist 1 is 31.25 mm too near",
        """
        0 0 197  0 0 0  0 0 1  -180 180
        0 -187.5 0  0 0 0  0 1 0  -180 180
        0 0 612.7  0 0 0  0 1 0  -180 180
        0 117.15 570.15  0 0 0  0 1 0  -180 180
        0 -117.15 0  0 0 0  0 0 1  -180 180
        0 0 117.15  0 0 0  0 1 0  -180 180
        0 -115.3 0  0 0 0
        """,
        {(4, "y"): 148.4},
    ),
    Repair(
        "Fanuc M-10iA",
        "ros-industrial/fanuc 6a710f5 (issue 63)",
        "joints have places beside their own axes; the tool is where it was but for the base",
        """
        0 0 0  0 0 0  0 0 1  -180 180
        150 -40 450  0 0 0  0 1 0  -90 160
        0 -22.5 600  0 0 0  0 -1 0  -180 264
        180.5 62.5 200  0 0 0  -1 0 0  -190 190
        459.5 -56.5 0  0 0 0  0 -1 0  -190 190
        100 56.5 0  0 0 0  -1 0 0  -360 360
        0 0 0  0 0 0
        """,
        {
            (1, "z"): 450.0,
            (2, "y"): 0.0,
            (2, "z"): 0.0,
            (3, "y"): 0.0,
            (4, "x"): 0.0,
            (4, "y"): 0.0,
            (5, "x"): 640.0,
            (5, "y"): 0.0,
            (6, "y"): 0.0,
            (7, "roll"): 180.0,
            (7, "pitch"): -90.0,
        },
    ),
)
