"""The true machines of the judges are their drawings where all errors are zero, and are off where these are not."""

import numpy as np
from ccnn_validation import five_bar, scara


def test_scara_without_errors_is_its_drawing() -> None:
    """Arms, screw, gears, weight and heat: none is left."""
    machine, rng = scara.Scara(3, 0.0), np.random.default_rng(0)
    joints, told = machine.day(40, rng, np.array([0.0, 5.0]))
    place, frame = scara.drawn(joints)
    np.testing.assert_allclose(machine.reached(joints, told), place + frame @ scara.REFLECTOR, atol=1e-12)
    assert scara.missed(joints, machine.measured(joints, told, rng)) < 25e-6
    assert scara.missed(joints, scara.Scara(3).reached(joints, told)) > 1e-4


def test_scara_reaches_its_place() -> None:
    """The drawing in closed form: two arms in the plane, height and slide above it."""
    joints = np.array([[0.3, -0.8, -0.05, 1.0]])
    place, frame = scara.drawn(joints)
    both = 0.4 * np.exp(0.3j) + 0.3 * np.exp(-0.5j)
    np.testing.assert_allclose(place, [[both.real, both.imag, 0.30]], atol=1e-12)
    np.testing.assert_allclose(np.arctan2(frame[:, 1, 0], frame[:, 0, 0]), 0.5, atol=1e-12)


def test_five_bar_without_errors_is_its_drawing() -> None:
    """Also on a plate that lies anywhere, in the frame that suits best."""
    machine, rng = five_bar.FiveBar(3, 0.0), np.random.default_rng(0)
    joints, told = five_bar.day(40, rng)
    wanted = five_bar.tool(joints, five_bar.LINKS)
    np.testing.assert_allclose(machine.reached(joints, told), wanted, atol=1e-12)
    np.testing.assert_allclose(five_bar.cranks(wanted), joints, atol=1e-9)
    assert five_bar.missed(joints, machine.on_plate(wanted), True) < 1e-12
    assert five_bar.missed(joints, five_bar.FiveBar(3).reached(joints, told), True) > 2e-5
