"""Frequency, damping and direction of a swing whose numbers are known, and swings that have none."""

import numpy as np
import pytest

from tests.evaluation.made_up_liquid import DT, body_of, filled, swing
from zsdt.evaluation.sloshing import centroid, damped_sine, fit_window, main_direction, swing_figures
from zsdt.scene import VesselShape

TIMES = DT * np.arange(150)


@pytest.mark.parametrize(("frequency", "damping"), [(2.9, 0.45), (2.5, 0.6), (3.3, 0.3), (4.0, 0.02), (3.0, 0.0)])
def test_frequency_and_damping_of_a_damped_sine_come_back(frequency, damping):
    trace = 0.004 * swing(TIMES, frequency, damping) + 1e-4
    mode = damped_sine(trace, DT)
    assert mode.frequency == pytest.approx(frequency, rel=1e-4)
    assert mode.damping == pytest.approx(damping, abs=1e-4)
    assert mode.offset == pytest.approx(1e-4, abs=1e-7)
    noisy = damped_sine(trace + 4e-5 * np.random.default_rng(0).normal(size=150), DT)  # 1 % of the swing
    assert noisy.frequency == pytest.approx(frequency, rel=0.02) and noisy.damping == pytest.approx(damping, abs=0.02)


def test_what_does_not_swing_has_no_frequency():
    assert damped_sine(np.zeros(150), DT) is None
    assert damped_sine(np.exp(-TIMES / 0.1), DT) is None  # creeps back
    assert damped_sine(0.004 * TIMES, DT) is None  # drifts away
    assert damped_sine(np.random.default_rng(0).normal(size=150), DT) is None
    assert damped_sine(swing(TIMES)[:8], DT) is None
    assert damped_sine(np.where(TIMES > 0.3, np.nan, swing(TIMES)), DT) is None
    assert damped_sine(1e-5 * swing(TIMES), DT, least_swing=1e-4) is None


def test_errors_of_a_swing_are_those_that_were_put_in_and_both_sides_share_a_window():
    truth = 0.004 * swing(TIMES, 2.9, 0.45)
    figures = swing_figures(0.003 * swing(TIMES, 3.045, 0.36), truth, DT, 0.005)
    assert figures["frequency_error"] == pytest.approx(0.05, abs=1e-3)
    assert figures["damping_error"] == pytest.approx(0.2, abs=1e-3)
    assert 60 < fit_window(truth) < 130
    late = truth.copy()
    late[fit_window(truth) :] += 0.01  # what happens after the truth has come to rest is not part of the swing
    assert swing_figures(late, truth, DT, 0.005)["frequency_error"] == pytest.approx(0.0, abs=1e-6)
    still = swing_figures(np.full(150, 0.001), truth, DT, 0.005)
    assert np.isnan(still["frequency_hz"]) and np.isnan(still["frequency_error"]) and still["true_frequency_hz"] > 2


@pytest.mark.parametrize("angle", [0.3, 2.0, -1.2])
def test_direction_points_to_where_the_liquid_climbs_first(angle):
    ray = np.array([np.cos(angle), np.sin(angle), 0.0])
    path = 0.004 * swing(TIMES)[:, None] * ray + [0.0, 0.0, 0.025]
    np.testing.assert_allclose(main_direction(path), ray, atol=1e-9)
    assert np.linalg.norm(main_direction(np.zeros((9, 3)))) == 1.0


def test_centroid_weighs_by_mass():
    body = body_of(filled(VesselShape()))
    body.mass[: body.nodes // 2] *= 3.0
    position = np.stack([body.points, body.points + 0.01])
    path = centroid(body, position)
    np.testing.assert_allclose(path[0], np.average(body.points, axis=0, weights=body.mass), atol=1e-12)
    np.testing.assert_allclose(path[1] - path[0], 0.01, atol=1e-12)
