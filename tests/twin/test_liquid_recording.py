"""A recording of a liquid holds its particles, its vessels and the curves, frame by frame."""

import numpy as np
import pytest
from rerun.chunk import RrdReader

from tests.evaluation.made_up_liquid import BOWL, JAR, sloshing
from zsdt.errors import DataError
from zsdt.evaluation.baselines import StaticBaseline
from zsdt.tignn.engine import Rollout, roll_out
from zsdt.twin import liquid_recording
from zsdt.twin.recording import record_rollout
from zsdt.twin.verification import verify_recording

FRAMES = 14


def guess_of(truth, diverged_at=None):
    fields = {k: 1.01 * v for k, v in truth.fields.items()}
    return Rollout("guess", fields, np.full(FRAMES - 1, 2.5), {}, diverged_at, np.full(FRAMES - 1, 0.5))


def test_entities_and_frame_counts_of_a_liquid(tmp_path, monkeypatch):
    monkeypatch.setattr(liquid_recording, "LIQUID_FRAMES", 6)
    truth = sloshing("made", shape=BOWL, frames=FRAMES)
    record_rollout(tmp_path / "a.rrd", truth, guess_of(truth), config_text="noise: 0.004")
    found = verify_recording(tmp_path / "a.rrd")
    assert found["blueprints"] == 1 and found["timelines"] == ["frame", "time"]
    for name in ("vertical_velocity", "speed", "internal_energy", "displacement_error"):
        assert f"/legend/{name}" in found["static"]
        for side in ("prediction", "truth"):
            assert found["entities"][f"/bodies/{name}/{side}"] == 6
            assert f"/bodies/shape/{side}/glass" in found["static"]
    assert found["entities"]["/bodies/shape/prediction/true_surface"] == 6
    for curve in ("centroid/truth", "surface/prediction_front", "error/energy_increment", "energy/true_potential"):
        assert found["entities"][f"/plots/{curve}"] == FRAMES
    assert found["entities"]["/plots/latency/graph"] == FRAMES - 1
    assert {"/about", "/config"} <= set(found["static"])


def test_particles_and_centroid_in_the_file_are_those_of_the_rollout(tmp_path):
    truth = sloshing("made", shape=JAR, frames=FRAMES)
    guess = guess_of(truth)
    record_rollout(tmp_path / "a.rrd", truth, guess)
    seen = {}
    for chunk in RrdReader(str(tmp_path / "a.rrd")).stream():
        for column, values in chunk.to_record_batch().to_pydict().items():
            seen[(chunk.entity_path, column.rpartition(":")[2])] = values
    drawn = np.array(seen[("/bodies/speed/prediction", "positions")][-1])
    np.testing.assert_allclose(drawn, guess.fields["position"][-1], atol=1e-6)
    beside = np.array(seen[("/bodies/speed/truth", "positions")][-1]) - truth.fields["position"][-1]
    assert np.ptp(beside, axis=0).max() < 1e-6  # the truth, moved as one,
    assert abs(beside[0, 2]) < 1e-6 and np.linalg.norm(beside[0]) > 0.07  # level with the prediction and clear of it
    curve = np.array(seen[("/plots/centroid/truth", "scalars")]).ravel()
    centre = 1e3 * truth.fields["position"].mean(axis=1)[:, 0]
    np.testing.assert_allclose(np.abs(curve), np.abs(centre), rtol=2e-2)
    (about,) = seen[("/about", "text")]
    assert "Glycerin in a jar" in about[0] and "Leaked particles: " in about[0]


def test_a_liquid_that_diverged_or_has_no_account_is_shown(tmp_path):
    truth = sloshing("made", frames=FRAMES)
    record_rollout(tmp_path / "a.rrd", truth, guess_of(truth, diverged_at=5))
    assert verify_recording(tmp_path / "a.rrd")["entities"]["/bodies/speed/prediction"] == 5
    record_rollout(tmp_path / "b.rrd", truth, roll_out(StaticBaseline(), truth))
    assert verify_recording(tmp_path / "b.rrd")["entities"]["/plots/centroid/prediction"] == FRAMES
    truth.body.vessel = None
    with pytest.raises(DataError, match="has no vessel"):
        record_rollout(tmp_path / "c.rrd", truth, guess_of(truth))
