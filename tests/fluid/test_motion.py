"""Motions of a vessel: acceleration integrates to velocity, all ends at rest, the tested range is kept."""

import numpy as np
import pytest

from zsdt.errors import OptionError
from zsdt.fluid.excitations import MotionOptions, check_excitation, draw_motion
from zsdt.fluid.motion import Excitation, Tilt, VelocityChange
from zsdt.scene import Liquid, water

GLYCERIN = Liquid()


def draws(count, options=None, liquid=GLYCERIN):
    options = options or MotionOptions(pulse_fraction=0.5, tilt_fraction=0.3)
    rng = np.random.default_rng(4)
    return [draw_motion(rng.uniform(*options.speed), options, liquid, rng) for _ in range(count)]


def in_room(motion, times):
    """Acceleration in the axes of the room."""
    return np.stack([motion.rotation(t) @ motion.acceleration(t) for t in times])


def test_acceleration_is_the_rate_of_velocity():
    for motion in draws(8):
        times = np.linspace(0.0, motion.duration, 3001)
        acceleration = in_room(motion, times)
        velocity = np.stack([motion.velocity(t) for t in times])
        gained = np.concatenate(
            [
                np.zeros((1, 3)),
                np.cumsum(0.5 * np.diff(times)[:, None] * (acceleration[1:] + acceleration[:-1]), axis=0),
            ]
        )
        np.testing.assert_allclose(velocity - velocity[0], gained, atol=1e-4)
        np.testing.assert_allclose(acceleration[[0, -1]], 0.0, atol=1e-9)  # smooth: starts and ends without a blow


def test_every_motion_ends_at_rest_and_upright_and_stays_so():
    for motion in draws(50):
        for time in motion.duration + np.array([0.0, 1e-6, 0.3]):
            np.testing.assert_allclose(motion.velocity(time), 0.0, atol=1e-12)
            np.testing.assert_allclose(motion.acceleration(time), 0.0, atol=1e-9)
            np.testing.assert_allclose(motion.gravity(time), [0, 0, -9.81], atol=1e-12)
        np.testing.assert_allclose(motion.velocity(-1.0), motion.before, atol=0)
        assert motion.changes[-1].end == pytest.approx(motion.duration)
        assert np.all(np.array([c.change[2] for c in motion.changes]) == 0)


def test_tilt_turns_gravity_and_its_rates_fit():
    motion = Excitation((0.3, 0.0, 0.0), (VelocityChange(0.1, 0.03, (-0.3, 0.0, 0.0)),), Tilt(0.0, 0.5, 0.2, 0.7))
    assert motion.duration == 0.5
    middle = motion.gravity(0.25)
    assert np.linalg.norm(middle) == pytest.approx(9.81)
    # The rim leans towards the heading, so in the vessel gravity leans that way too.
    np.testing.assert_allclose(middle[:2] / (9.81 * np.sin(0.2)), [np.cos(0.7), np.sin(0.7)], atol=1e-12)
    step = 1e-5
    for t in np.linspace(0.02, 0.48, 9):
        w = motion.angular_velocity(t)
        turning = (motion.rotation(t + step) - motion.rotation(t - step)) / (2 * step)
        cross = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        np.testing.assert_allclose(turning, cross @ motion.rotation(t), atol=1e-7)
        rate = (motion.angular_velocity(t + step) - motion.angular_velocity(t - step)) / (2 * step)
        np.testing.assert_allclose(motion.angular_acceleration(t), rate, atol=1e-5)


def test_history_is_the_motion_before_the_first_frame():
    for motion in draws(10):
        history = motion.history(lead=0.05)
        assert history.times[-1] == 0.0 and np.allclose(np.diff(history.times), 1e-3)
        assert history.times[0] <= -motion.duration - 0.05 + 1e-9
        np.testing.assert_allclose(history.velocity[-1], 0.0, atol=1e-12)
        np.testing.assert_allclose(history.velocity[0], motion.before, atol=0)
        k = len(history.times) // 2
        np.testing.assert_allclose(history.velocity[k], motion.velocity(motion.duration + history.times[k]), atol=0)
        np.testing.assert_allclose(history.gravity[k], motion.gravity(motion.duration + history.times[k]), atol=0)


def test_stop_at_once_is_a_jump_of_the_liquid():
    motion = draws(1, MotionOptions(speed=[0.3, 0.4], pulse_fraction=0.0, at_once=1.0))[0]
    assert motion.duration == 0.0 and motion.describe()["ramp"] == 0.0
    np.testing.assert_allclose(motion.jump, motion.before)
    assert 0.3 <= np.linalg.norm(motion.jump) <= 0.4
    np.testing.assert_allclose(motion.velocity(0.0), 0.0, atol=1e-15)
    np.testing.assert_allclose(motion.acceleration(0.0), 0.0, atol=1e-15)
    assert not draws(1)[0].jump.any()


def test_draws_cover_directions_and_kinds():
    motions = draws(400)
    cards = [m.describe() for m in motions]
    assert 0.4 < np.mean([c["kind"] == "pulses" for c in cards]) < 0.6
    assert 0.2 < np.mean(["tilt" in c for c in cards]) < 0.4
    angle = np.array([c["direction"] for c in cards])
    assert np.hypot(np.cos(angle).mean(), np.sin(angle).mean()) < 0.12
    for motion, card in zip(motions, cards, strict=True):
        assert card["speed"] == pytest.approx(np.linalg.norm(motion.velocity(motion.changes[-1].start)), rel=1e-9)
        assert all(c.size <= card["speed"] * (1 + 1e-9) for c in motion.changes)


def stop(speed, ramp):
    return Excitation((speed, 0.0, 0.0), (VelocityChange(0.0, ramp, (-speed, 0.0, 0.0)),))


def test_what_was_never_tested_is_refused():
    with pytest.raises(OptionError, match=r"0\.8 m/s within 10 ms"):
        check_excitation(stop(0.8, 0.01), GLYCERIN)
    check_excitation(stop(1.0, 0.02), GLYCERIN)
    check_excitation(stop(0.5, 0.0), GLYCERIN)
    check_excitation(stop(0.5, 0.0), water())
    with pytest.raises(OptionError, match=r"water is computed rightly \(up to 0\.5"):
        check_excitation(stop(0.6, 0.05), water())
    for options, liquid in ((MotionOptions(), water()), (MotionOptions(ramp=[0.005, 0.02]), GLYCERIN)):
        with pytest.raises(OptionError, match=r"0\.9 m/s within"):
            options.check(liquid)
    with pytest.raises(OptionError, match=r"must be \[lowest, highest\]"):
        MotionOptions(speed=[0.5])
    MotionOptions().check(GLYCERIN)
