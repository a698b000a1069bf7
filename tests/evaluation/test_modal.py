"""Frequency and damping recovered from traces whose frequency and damping are known."""

import numpy as np
import pytest

from zsdt.evaluation.modal import first_mode, free_from, frequencies, tip_trace
from zsdt.graph import brick_grid
from zsdt.trajectory import Body


def swing(frequency, ratio, dt, seconds, offset=-0.03, creep=0.0, phase=0.4):
    times = np.arange(0.0, seconds, dt)
    decay = ratio / np.sqrt(1 - ratio**2) * 2 * np.pi * frequency
    trace = 0.01 * np.exp(-decay * times) * np.cos(2 * np.pi * frequency * times + phase)
    return offset + trace + creep * np.exp(-times / 0.15)


@pytest.mark.parametrize("frequency", [1.3, 3.37, 7.76])
@pytest.mark.parametrize("ratio", [0.0, 0.02, 0.15])
def test_damped_cosine_is_recovered_to_a_tenth_of_a_percent(frequency, ratio):
    mode = first_mode(swing(frequency, ratio, 1 / 60, 1.5), 1 / 60)
    assert mode is not None
    assert mode.frequency == pytest.approx(frequency, rel=1e-3)
    assert mode.damping == pytest.approx(ratio, abs=1e-3)
    assert mode.offset == pytest.approx(-0.03, abs=1e-4)


def test_viscoelastic_creep_does_not_shift_the_frequency():
    mode = first_mode(swing(4.0, 0.08, 0.005, 1.0, creep=0.02), 0.005)
    assert mode is not None and mode.frequency == pytest.approx(4.0, rel=2e-3)


def test_noise_of_a_percent_moves_the_frequency_by_less_than_a_percent():
    noise = np.random.default_rng(0).normal(size=200) * 1e-4
    mode = first_mode(swing(3.0, 0.05, 0.005, 1.0) + noise, 0.005)
    assert mode is not None and mode.frequency == pytest.approx(3.0, rel=1e-2)


@pytest.mark.parametrize(
    "trace",
    [np.zeros(100), np.full(100, np.nan), np.linspace(0, 1, 100), np.ones(5), np.exp(-np.arange(100) / 20.0)],
    ids=["still", "lost", "drift", "short", "creep"],
)
def test_what_does_not_swing_has_no_mode(trace):
    assert first_mode(trace, 0.01) is None


def beam():
    grid = brick_grid((4, 1, 1), 0.1)
    return Body(grid.points, grid.pairs, grid.points[:, 0] == 0, np.ones(len(grid.points)), 0.005, 0.1)


def test_frequency_is_taken_from_the_tip_after_the_release_along_the_direction_of_motion():
    body = beam()
    frames, release = 260, 60
    load = np.zeros((frames, body.nodes, 3))
    load[:release, -1, 2] = np.linspace(0.0, -1.0, release)
    shape = (body.points[:, 0] / 0.4) ** 2

    def motion(frequency):
        tip = np.concatenate([np.linspace(0, 0.02, release), swing(frequency, 0.05, 0.005, 1.0)[: frames - release]])
        position = np.repeat(body.points[None], frames, axis=0)
        position[:, :, 2] += tip[:, None] * shape
        return position

    assert free_from(load) == release
    assert tip_trace(body, motion(3.0)).shape == (frames, 3)
    ours, theirs = frequencies(body, motion(3.3), motion(3.0), load)
    assert theirs == pytest.approx(3.0, rel=2e-3)
    assert ours == pytest.approx(3.3, rel=2e-3)


def test_forced_motion_has_no_frequency_to_compare():
    body = beam()
    load = np.sin(np.arange(100) * 0.1)[:, None, None] * np.ones((100, body.nodes, 3))
    position = np.repeat(body.points[None], 100, axis=0) + 0.01 * load
    assert all(np.isnan(frequencies(body, position, position, load)))
