"""An evaluation of liquids end to end: tables with their own layout, pictures, Psi_ini, and the long run at rest."""

import csv
import json

import numpy as np
import pytest

from tests.evaluation.made_up_liquid import BOWL, CYLINDER, sloshing
from zsdt.evaluation.baselines import FromPsiIni, InertiaBaseline, StaticBaseline
from zsdt.evaluation.evaluate import EvaluationOptions, evaluate
from zsdt.evaluation.initial_fields import evaluate_psi_ini
from zsdt.evaluation.stability import long_figures
from zsdt.trajectory import Dataset, DatasetEntry, write_index, write_trajectory
from zsdt.twin.verification import verify_recording

FRAMES = 60


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("liquids")
    entries = []
    for split, family, shape in (
        ("test", "cylinder", CYLINDER),
        ("test", "cylinder", CYLINDER),
        ("test", "tumbler", CYLINDER),
        ("beyond", "bowl", BOWL),
    ):
        name = f"{family}_{len(entries)}"
        write_trajectory(folder / f"{name}.h5", sloshing(name, shape=shape, frames=FRAMES, seed=len(entries)))
        entries.append(DatasetEntry(f"{name}.h5", name, split, "glycerin", family))
    write_index(folder, entries)
    return folder


class Replay(StaticBaseline):
    """Knows the truth; says how long its graph took."""

    name = "replay"
    graph_milliseconds = 0.0

    def __init__(self, folder):
        data = Dataset(folder)
        self.known = [data.read(entry) for entry in data.entries]

    def prepare(self, body):
        self.truth = next(t for t in self.known if t.body.nodes == body.nodes and (t.body.points == body.points).all())
        self.frame = 0

    def start(self, fields, load):
        self.frame = 0
        return super().start(fields, load)

    def step(self, state, load, load_next):
        self.frame = min(self.frame + 1, self.truth.frames - 1)
        self.graph_milliseconds = 1e-6
        return state.but(**self.truth.at(self.frame))


def rows_of(path):
    with path.open(newline="") as lines:
        return list(csv.DictReader(lines))


def test_tables_recordings_and_pictures_of_liquids(dataset, tmp_path):
    engines = {"static": StaticBaseline(), "replay": Replay(dataset)}
    options = EvaluationOptions(per_group=2, recordings=1, long_frames=80)
    summary = evaluate(dataset, engines, options, tmp_path, "a: 1")
    rows = rows_of(tmp_path / "metrics.csv")
    assert [r["family"] for r in rows[::2]] == ["cylinder", "tumbler", "bowl"]  # of a limited group one of each family
    for row in rows:
        wrong = row["method"] == "static"
        for name in ("displacement", "velocity", "energy_increment", "centroid"):
            assert float(row[f"{name}_rrmse"]) == pytest.approx(1.0 if wrong else 0.0, abs=1e-9), name
        assert float(row["leaked"]) == 0 and float(row["close_share"]) < 0.01
        assert row["frequency_error"] == "" if wrong else float(row["frequency_error"]) == 0.0
        assert float(row["true_frequency_hz"]) == pytest.approx(2.9, rel=0.02)
    assert {(r["split"], r["families"]) for r in summary["rows"]} == {("test", "cylinder tumbler"), ("beyond", "bowl")}
    replay = next(r for r in summary["rows"] if r["method"] == "replay")
    assert replay["graph_ms_mean"] == pytest.approx(1e-6) and replay["network_ms_p50"] > 0
    assert replay["kinetic_factor_worst"] == pytest.approx(1.0) and replay["volume_error_mean"] == 0.0
    text = (tmp_path / "summary.md").read_text()
    assert "energy increment %" in text and "stress" not in text.splitlines()[0] and "| beyond: bowl |" in text
    assert json.loads((tmp_path / "summary.json").read_text())["pictures"] == summary["pictures"]
    assert sorted(p.rpartition("_")[2] for p in summary["pictures"]) == ["energy.png", "sloshing.png", "snapshots.png"]
    for picture in summary["pictures"]:
        assert (tmp_path / picture).read_bytes()[1:4] == b"PNG"
    (recording,) = summary["recordings"]
    assert verify_recording(tmp_path / recording)["entities"]["/bodies/speed/truth"] == FRAMES
    curves = rows_of(tmp_path / "errors_over_time.csv")
    last = next(r for r in curves if r["method"] == "replay" and r["frame"] == str(FRAMES - 1))
    assert last["centroid_m"] == last["true_centroid_m"] != "" and last["front_level_m"] == last["true_front_level_m"]


def test_a_liquid_at_rest_must_stay_at_rest(dataset):
    data = Dataset(dataset)
    trajectory = data.read(data.entries[0])
    still = long_figures(StaticBaseline(), trajectory, 100)
    assert still == {"long_diverged_at": None, "long_frames": 100, "long_kinetic": 0.0}
    moving = long_figures(InertiaBaseline(), trajectory, 100)
    assert moving["long_diverged_at"] > 1 and moving["long_kinetic"] == pytest.approx(1.0)


class Guess:
    """A Psi_ini of liquids that is off by known amounts."""

    def __init__(self, folder):
        data = Dataset(folder)
        self.first = [data.read(entry).at(0) for entry in data.entries]

    def infer_fields(self, body, positions):
        first = next(f for f in self.first if f["position"].shape == positions.shape)
        return {
            "velocity": first["velocity"] + [0.01, 0.02, 0.03],
            "internal_energy": 1.1 * first["internal_energy"],
        }


def test_first_fields_of_a_liquid_are_judged_and_used(dataset, tmp_path):
    options = EvaluationOptions(splits=["test"], per_group=1, recordings=0)
    judged = evaluate_psi_ini(dataset, Guess(dataset), options)
    (row,) = judged["per_trajectory"]
    found = [row[f"velocity_{axis}_rmse"] for axis in "xyz"]
    np.testing.assert_allclose(found, [0.01, 0.02, 0.03], rtol=1e-9)
    assert row["internal_energy_rrmse"] == pytest.approx(0.1) and row["regime"] == "glycerin"
    assert judged["rows"][0]["velocity_z_rmse_mean"] == pytest.approx(0.03)
    trajectory = Dataset(dataset).read(Dataset(dataset).entries[0])
    engine = FromPsiIni(StaticBaseline(), Guess(dataset))
    engine.prepare(trajectory.body)
    hidden = {"pressure": np.zeros((trajectory.body.nodes, 1))}
    assert "pressure" not in engine.read(engine.start(trajectory.at(0) | hidden, trajectory.load[0]))
    (row,) = evaluate(dataset, {"guessed": engine}, options, tmp_path)["rows"]
    assert row["internal_energy_rrmse_mean"] > 0.05 and row["displacement_rrmse_mean"] == pytest.approx(1.0)
