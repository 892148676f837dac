"""The true seven-axis arm of the judge: without errors it is the drawing's, and its loads are those of its weights."""

import numpy as np
from ccnn_validation import seven_axis

ERRORS = {
    "geometry", "zeros", "gears", "turns", "hysteresis", "twist", "soft", "bending", "thermal", "masses", "load",
    "scatter",
}  # fmt: skip


def rows(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Joints and what is told beside them."""
    joints, told = seven_axis.day(count, np.random.default_rng(3), np.array([0.0, 6.0]))
    return joints, told


def test_an_arm_without_errors_is_as_drawn():
    joints, told = rows(30)
    machine = seven_axis.Arm(0, ERRORS)
    place, frame = seven_axis.plain(joints)
    np.testing.assert_allclose(machine.reached(joints, told), place + frame @ machine.point, atol=1e-12)


def test_torques_are_slopes_of_the_potential_energy():
    joints, told = rows(30)

    def energy(q: np.ndarray) -> np.ndarray:
        links = seven_axis.chain(q)
        heights = [(links[k + 1][0] + links[k + 1][1] @ seven_axis.CENTRES[k])[:, 2] for k in range(7)]
        load = told[:, 0] * (links[7][0] + links[7][1] @ seven_axis.LOAD)[:, 2]
        return seven_axis.G * (seven_axis.MASSES @ np.stack(heights) + load)

    slopes = [(energy(joints + 1e-6 * one) - energy(joints - 1e-6 * one)) / -2e-6 for one in np.eye(7)]
    moment = seven_axis.moments(joints, told[:, 0])
    np.testing.assert_allclose(moment[..., 2], np.stack(slopes), atol=1e-6)
    machine, none = seven_axis.Arm(0, ERRORS), np.zeros((7, 30, 3))
    start, _, _ = machine.loads(*machine.pose(joints, np.zeros(30), none, none), told[:, 0])
    np.testing.assert_allclose(start, moment, atol=1e-9)


def test_the_payload_lowers_a_true_arm():
    joints, told = rows(30)
    machine = seven_axis.Arm(1)
    heavy, light = told.copy(), told.copy()
    heavy[:, 0], light[:, 0] = 6, 0
    assert (machine.reached(joints, heavy) - machine.reached(joints, light))[:, 2].max() < 0


def test_the_plain_script_repairs_what_it_describes():
    machine = seven_axis.Arm(0, ERRORS - {"geometry", "zeros", "twist"})
    joints, told = rows(60)
    seen = machine.measured(joints, told, np.random.default_rng(1))
    numbers, point, _ = seven_axis.script_fit(joints, told, seen, seven_axis.PLAIN)
    wanted, then = seven_axis.day(40, np.random.default_rng(4), np.array([3.0]), np.array([21.0, 27.0]))
    commands = seven_axis.corrected(wanted, then, numbers, point)
    assert seven_axis.missed(wanted, machine.reached(wanted, then)) > 1e-3
    assert seven_axis.missed(wanted, machine.reached(commands, then)) < 4e-5
