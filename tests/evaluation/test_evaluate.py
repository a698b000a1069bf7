"""An evaluation end to end on beams whose motion is known: figures, tables, recordings, and mistakes."""

import csv
import json

import numpy as np
import pytest

from zsdt.errors import DataError, OptionError, RunRejected
from zsdt.evaluation.baselines import FromPsiIni, InertiaBaseline, StaticBaseline
from zsdt.evaluation.evaluate import EvaluationOptions, evaluate, shortened
from zsdt.evaluation.initial_fields import evaluate_psi_ini
from zsdt.evaluation.stability import stability_check
from zsdt.graph import brick_grid
from zsdt.trajectory import Body, Dataset, DatasetEntry, Trajectory, write_index, write_trajectory
from zsdt.twin.verification import verify_recording

DT, FRAMES, DRIFT = 0.01, 20, 0.3


def drifting(name, regime):
    """Every free node moves at a constant 0.3 m/s; the stress is constant."""
    grid = brick_grid((3, 1, 1), 0.05)
    clamped = grid.points[:, 0] == 0
    body = Body(grid.points, grid.pairs, clamped, np.ones(len(clamped)), DT, 0.05, cells=grid.cells)
    times = DT * np.arange(FRAMES)
    velocity = np.where(clamped[:, None], 0.0, [0.0, 0.0, DRIFT])
    fields = {
        "position": grid.points + times[:, None, None] * velocity,
        "velocity": np.repeat(velocity[None], FRAMES, axis=0),
        "stress": np.full((FRAMES, len(clamped), 6), 7.0),
    }
    load = np.zeros((FRAMES, len(clamped), 3))
    load[:, -1, 0] = times
    return Trajectory(body, times, fields, load, meta={"name": name, "regime": regime})


@pytest.fixture
def dataset(tmp_path):
    folder = tmp_path / "data"
    entries = []
    for split, regime in [
        ("train", "hand"),
        ("test", "hand"),
        ("test", "hand"),
        ("test", "dynamic"),
        ("beyond", "hand"),
    ]:
        name = f"{split}_{regime}_{len(entries)}"
        write_trajectory(folder / f"{name}.h5", drifting(name, regime))
        entries.append(DatasetEntry(f"{name}.h5", name, split, regime, "made_up"))
    write_index(folder, entries)
    return folder


def rows_of(path):
    with path.open(newline="") as lines:
        return list(csv.DictReader(lines))


def test_figures_of_predictions_that_are_known_in_closed_form(dataset, tmp_path):
    seen = []
    engines = {"still": StaticBaseline(), "inertia": InertiaBaseline()}
    options = EvaluationOptions(recordings=2, skip_recordings=["still"])
    out = tmp_path / "out"
    summary = evaluate(dataset, engines, options, out, "a: 1", lambda *now: seen.append(now))
    rows = rows_of(out / "metrics.csv")
    assert len(rows) == 8 and [r["method"] for r in rows[:2]] == ["still", "inertia"]  # methods alternate
    for row in rows:
        expected = 1.0 if row["method"] == "still" else 0.0
        assert float(row["displacement_rrmse"]) == pytest.approx(expected, abs=1e-5)
        assert float(row["velocity_rrmse"]) == pytest.approx(expected, abs=1e-5)
        assert float(row["stress_rrmse"]) == 0.0
        assert (
            row["diverged_at"] == "" and row["ledger_residual"] == "" and float(row["ms_p95"]) >= float(row["ms_p50"])
        )
    assert seen[-1][:2] == (8, 8)
    assert len(summary["rows"]) == 6
    curves = rows_of(out / "errors_over_time.csv")
    assert len(curves) == 8 * FRAMES
    last = next(r for r in curves if r["method"] == "still" and int(r["frame"]) == FRAMES - 1)
    mean_square = np.mean(np.arange(1, FRAMES) ** 2)
    assert float(last["displacement"]) == pytest.approx((FRAMES - 1) / np.sqrt(mean_square), rel=1e-4)
    assert json.loads((out / "summary.json").read_text())["trajectories"] == 4
    assert "| still | test | hand | 2 |" in (out / "summary.md").read_text()
    assert len(summary["recordings"]) == 2
    for file in summary["recordings"]:
        assert verify_recording(out / file)["entities"]["/bodies/von_mises/truth"] == FRAMES
    regimes = {file.rpartition("/")[2].split("_")[1] for file in summary["recordings"]}
    assert regimes == {"hand", "dynamic"}  # spread over the groups, not the first two


def test_choosing_what_is_evaluated(dataset, tmp_path):
    options = EvaluationOptions(splits=["test"], regimes=["hand"], per_group=1, frames=5, recordings=0)
    evaluate(dataset, {"still": StaticBaseline()}, options, tmp_path / "out")
    (row,) = rows_of(tmp_path / "out" / "metrics.csv")
    assert row["trajectory"] == "test_hand_1" and row["frames"] == "5"
    assert not (tmp_path / "out" / "recordings").exists()


class Runaway(StaticBaseline):
    """Half as far again from the origin with every frame; it gives up or goes on."""

    name = "runaway"

    def __init__(self, refuses_at=None):
        self.refuses_at = refuses_at

    def step(self, state, load, load_next):
        if self.refuses_at is not None and np.abs(state.fields["position"]).max() > self.refuses_at:
            raise RunRejected("range", "Too far.")
        moved = super().step(state, load, load_next)
        return moved.but(position=1.5 * moved.fields["position"])


def test_a_runaway_that_stays_finite_is_called_diverged_and_so_is_one_that_gives_up(dataset, tmp_path):
    options = EvaluationOptions(splits=["test"], per_group=1, recordings=0)
    summary = evaluate(dataset, {"finite": Runaway(), "refusing": Runaway(0.1)}, options, tmp_path / "out")
    for row in summary["rows"]:
        assert row["diverged"] == row["trajectories"] == 1
    by_name = {r["method"]: r for r in rows_of(tmp_path / "out" / "metrics.csv")}
    assert float(by_name["finite"]["displacement_rrmse"]) > 10 and int(by_name["finite"]["diverged_at"]) > 1
    assert by_name["refusing"]["displacement_rrmse"] == "inf" and by_name["refusing"]["diverged_at"] == "1"


def test_long_check_holds_the_last_load_and_finds_slow_drift(dataset, tmp_path):
    loads = []

    class Listening(StaticBaseline):
        def step(self, state, load, load_next):
            loads.append(float(load_next[-1, 0]))
            return super().step(state, load, load_next)

    trajectory = drifting("any", "hand")
    assert stability_check(Listening(), trajectory, 60) is None
    assert len(loads) == 59 and loads[FRAMES - 2 :] == pytest.approx([DT * (FRAMES - 1)] * (61 - FRAMES))
    length = np.linalg.norm(np.ptp(trajectory.body.points, axis=0))
    assert stability_check(InertiaBaseline(), trajectory, 200) == int(np.ceil(length / (DRIFT * DT)))
    options = EvaluationOptions(splits=["test"], regimes=["dynamic"], long_frames=200, recordings=0)
    (row,) = evaluate(dataset, {"inertia": InertiaBaseline()}, options, tmp_path / "out")["rows"]
    assert (row["diverged"], row["long_checked"], row["long_diverged"]) == (0, 1, 1)


class OffByTenPercent:
    """A network of first stresses that knows the truth (7 Pa) and gives a tenth too much."""

    def infer_fields(self, body, positions):
        return {"stress": np.full((body.nodes, 6), 7.7)}


def test_initial_stress_is_judged_and_used(dataset, tmp_path):
    options = EvaluationOptions(recordings=0)
    judged = evaluate_psi_ini(dataset, OffByTenPercent(), options)
    assert judged["trajectories"] == 4
    for row in judged["per_trajectory"]:
        assert row["axial_stress_rrmse"] == pytest.approx(0.1) and row["axial_stress_rmse"] == pytest.approx(0.7)
    engines = {"still+psi_ini": FromPsiIni(StaticBaseline(), OffByTenPercent())}
    for row in evaluate(dataset, engines, options, tmp_path / "out")["rows"]:
        assert row["stress_rrmse_mean"] == pytest.approx(0.1)


def test_shortening_keeps_everything_in_step():
    trajectory = drifting("any", "hand")
    trajectory.ledger["elastic"] = trajectory.times.copy()
    short = shortened(trajectory, 7)
    lengths = {len(v) for v in (short.times, short.load, short.ledger["elastic"], *short.fields.values())}
    assert lengths == {7} and shortened(trajectory, 0) is trajectory and shortened(trajectory, 99) is trajectory


def test_mistakes_give_one_sentence(dataset, tmp_path):
    with pytest.raises(DataError, match="no trajectory of the splits val"):
        evaluate(dataset, {}, EvaluationOptions(splits=["val"]), tmp_path / "out")
    with pytest.raises(DataError, match=r"index\.csv is missing"):
        evaluate(tmp_path / "absent", {}, EvaluationOptions(), tmp_path / "out")
    for wrong in ({"splits": []}, {"frames": -1}, {"frames": 1}):
        with pytest.raises(OptionError):
            EvaluationOptions(**wrong)
    assert len(Dataset(dataset).entries) == 5
