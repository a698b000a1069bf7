"""Figures of the beam twin's evaluation, on runs whose errors are known."""

import dataclasses

import numpy as np
import pandas as pd
import pytest

from zsdt.evaluation.beam_twin_cases import Case, errors_of, position_error, there_and_back
from zsdt.evaluation.beam_twin_report import gains, summarise
from zsdt.perception.camera import Camera
from zsdt.scene import BeamShape, Foam
from zsdt.solid.mesh import mesh_of
from zsdt.trajectory import Body
from zsdt.twin.twin_view import TwinView

FRAMES = 12


@pytest.fixture
def truth() -> TwinView:
    grid = mesh_of(BeamShape(0.2, 0.1, 0.1), 0.05).grid
    points = grid.points
    body = Body(
        points=points, pairs=np.zeros((0, 2), int), clamped=points[:, 0] < 1e-9, mass=np.ones(len(points)),
        frame_dt=0.01, pitch=0.05, cells=grid.cells, material=Foam(),
    )  # fmt: skip
    rng = np.random.default_rng(0)
    swing = np.sin(np.arange(FRAMES))[:, None, None] * points[None, :, :1] * [0.0, 0.0, 0.1]
    camera = Camera.facing(distance=1.0, look_at=(0.1, 0.05), focal=900.0, beam_width=0.1)
    front = np.arange(10).reshape(5, 2)
    return TwinView(
        "truth", body, front, camera, np.arange(FRAMES), 0.01 * np.arange(FRAMES), points + swing,
        {"stress": rng.normal(size=(FRAMES, len(points), 6))},
    )  # fmt: skip


def shifted(truth: TwinView, by: np.ndarray) -> TwinView:
    return dataclasses.replace(truth, positions=truth.positions + by)


def test_a_run_that_is_the_truth_has_no_error(truth):
    figures = errors_of(truth, truth)
    assert figures["position_rmse"] == figures["stress_rrmse"] == figures["clamp_von_mises_rrmse"] == 0.0
    assert figures["drift_mm_per_s"] == pytest.approx(0.0, abs=1e-12)


def test_a_known_shift_is_measured(truth):
    run = shifted(truth, np.array([3e-3, 0.0, 4e-3]))
    assert position_error(run, truth) == pytest.approx(np.full(FRAMES, 5e-3))
    # RMSE counts components, so three of them share the 5 mm.
    assert errors_of(run, truth)["position_rmse"] == pytest.approx(5e-3 / np.sqrt(3))


def test_drift_is_the_slope_of_the_error(truth):
    away = 0.02 * truth.times[:, None, None] * np.array([1.0, 0.0, 0.0])
    assert errors_of(shifted(truth, away), truth)["drift_mm_per_s"] == pytest.approx(20.0)


def test_static_stress_scaled_by_a_fifth_is_a_fifth_off(truth):
    run = dataclasses.replace(truth, fields={"stress": 1.2 * truth.fields["stress"]})
    figures = errors_of(run, truth)
    assert figures["stress_rrmse"] == pytest.approx(0.2)
    assert figures["clamp_von_mises_rrmse"] == pytest.approx(0.2)


def test_there_and_back_never_shows_an_end_twice():
    assert there_and_back(4, 9) == [0, 1, 2, 3, 2, 1, 0, 1, 2]
    assert all(abs(a - b) == 1 for a, b in zip(there_and_back(7, 50), there_and_back(7, 50)[1:], strict=False))


def test_summary_and_gains_count_the_worst_clip():
    rows = [
        {"clip": c, "case": case.value, "regime": "hand", "survived": True, "nodes": 10, "position_rmse": p,
         "stress_rrmse": s, "drift_mm_per_s": d}
        for c, case, p, s, d in [
            ("a", Case.open, 10e-3, 0.9, 1.0), ("b", Case.open, 20e-3, 0.6, -3.0),
            ("a", Case.closed, 0.5e-3, 0.1, 0.1), ("b", Case.closed, 2e-3, 0.3, 0.2),
        ]
    ]  # fmt: skip
    table = pd.DataFrame(rows)
    summary = summarise(table).set_index(["regime", "case"])
    assert summary.loc[("all", "open"), "position mm"] == pytest.approx(15.0)
    assert summary.loc[("all", "open"), "drift mm/s worst"] == -3.0  # the largest in size keeps its sign
    assert summary.loc[("hand", "closed"), "stress % worst"] == pytest.approx(30.0)
    found = gains(table)["told material"]
    assert found["position_gain"] == pytest.approx(15 / 1.25) and found["position_gain_least"] == pytest.approx(10.0)
    assert found["stress_gain"] == pytest.approx(0.75 / 0.2) and found["stress_gain_least"] == pytest.approx(2.0)
