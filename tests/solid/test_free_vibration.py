"""Frequency and damping of made-up decays with gaps, outliers and noise."""

import numpy as np
import pytest

from zsdt.errors import DataError
from zsdt.solid.free_vibration import fit_decay, principal_trace

TIMES = np.arange(0.0, 2.0, 0.01)


def decay(frequency=7.7, damping=0.05):
    omega = 2 * np.pi * frequency
    rate = omega * damping / np.sqrt(1 - damping**2)
    return 0.004 * np.exp(-rate * TIMES) * np.cos(omega * TIMES + 0.3) - 0.0065 + 2e-4 * np.exp(-TIMES / 0.7)


def test_a_clean_decay_comes_back():
    found = fit_decay(TIMES, decay(), resamples=0)
    assert [found.mode.frequency, found.mode.damping] == pytest.approx([7.7, 0.05], rel=1e-4)
    assert found.used == 1.0 and found.cycles == pytest.approx(7.7 * 1.99, rel=1e-3)


def test_gaps_and_outliers_do_not_count():
    trace = decay()
    trace[40:52] = np.nan
    trace[[7, 90, 133]] += 0.02
    found = fit_decay(TIMES, trace, resamples=0)
    assert [found.mode.frequency, found.mode.damping] == pytest.approx([7.7, 0.05], rel=1e-3)
    assert found.used == pytest.approx(185 / 200, abs=0.02)


def test_the_bootstrap_tells_how_far_noise_moves_the_fit():
    generator = np.random.default_rng(1)
    fits = [fit_decay(TIMES, decay() + 1e-4 * generator.normal(size=200), resamples=16, seed=k) for k in range(8)]
    for name, truth in (("frequency", 7.7), ("damping", 0.05)):
        found = np.array([getattr(fit.mode, name) for fit in fits])
        told = np.mean([getattr(fit, f"{name}_sd") for fit in fits])
        assert abs(found - truth).max() < 5 * told
        assert 0.4 < found.std() / told < 2.5


def test_a_swing_that_hides_in_creep_is_found_near_a_told_frequency():
    hidden = 4e-4 * np.exp(-2 * TIMES) * np.cos(2 * np.pi * 7.7 * TIMES) + 1e-2 * np.exp(-TIMES / 0.1)
    found = fit_decay(TIMES, hidden, resamples=0, near=7.0)
    assert found.mode.frequency == pytest.approx(7.7, rel=1e-3)
    assert found.mode.amplitude == pytest.approx(4e-4, rel=1e-2)


def test_same_seed_same_samples():
    trace = decay() + 1e-4 * np.random.default_rng(0).normal(size=200)
    assert np.array_equal(fit_decay(TIMES, trace, 8, 3).samples, fit_decay(TIMES, trace, 8, 3).samples)


def test_the_principal_trace_is_the_pattern_that_moves():
    pattern = np.array([[0.0, 0.0, 1.0], [0.0, 0.2, 0.5]])
    moved = decay()[:, None, None] * pattern
    trace, found = principal_trace(moved)
    assert abs((found * pattern).sum()) == pytest.approx(np.linalg.norm(pattern), rel=1e-9)
    assert fit_decay(TIMES, trace, 0).mode.frequency == pytest.approx(7.7, rel=1e-4)


@pytest.mark.parametrize("trace", [np.full(200, np.nan), np.zeros(200), np.exp(-TIMES)])
def test_what_is_no_vibration_is_refused(trace):
    with pytest.raises(DataError):
        fit_decay(TIMES, trace)
