"""A recording holds what a person needs to see, frame by frame, and a broken one is found out."""

import numpy as np
import pytest
from rerun.chunk import RrdReader

from zsdt.errors import DataError
from zsdt.evaluation.baselines import StaticBaseline
from zsdt.graph import brick_grid
from zsdt.tignn.engine import Rollout, roll_out
from zsdt.trajectory import Body, Trajectory
from zsdt.twin import recording
from zsdt.twin.colours import Palette, colour_bar
from zsdt.twin.surface import surface_of
from zsdt.twin.verification import verify_recording

FRAMES = 9


def brick(counts=(4, 2, 2), pitch=0.05):
    grid = brick_grid(counts, pitch)
    count = len(grid.points)
    return Body(grid.points, grid.pairs, grid.points[:, 0] == 0, np.ones(count), 0.02, pitch, cells=grid.cells)


@pytest.fixture
def bent():
    body = brick()
    times = 0.02 * np.arange(FRAMES)
    position = np.repeat(body.points[None], FRAMES, axis=0)
    position[..., 2] -= 0.5 * times[:, None] * body.points[:, 0] ** 2
    stress = np.zeros((FRAMES, body.nodes, 6))
    stress[..., 0] = 1e4 * times[:, None] * (body.points[:, 2] - 0.05)
    velocity = np.gradient(position, times, axis=0)
    load = np.zeros((FRAMES, body.nodes, 3))
    load[1:, -1, 2] = -np.arange(1.0, FRAMES)
    fields = {"position": position, "velocity": velocity, "stress": stress}
    ledger = {"elastic": times**2, "dissipated": 0.1 * times}
    return Trajectory(body, times, fields, load, ledger, {"name": "bent", "regime": "hand"})


def predicted(trajectory, diverged_at=None):
    fields = {k: 1.02 * v for k, v in trajectory.fields.items()}
    if diverged_at is not None:
        fields = {k: np.where(np.arange(FRAMES)[:, None, None] < diverged_at, v, np.nan) for k, v in fields.items()}
    account = {"kinetic": np.ones(FRAMES), "elastic": trajectory.times, "dissipated": 0.1 * trajectory.times}
    account["work_of_ports"] = 1.1 * trajectory.times
    return Rollout("guess", fields, np.full(FRAMES - 1, 2.5), account, diverged_at)


def test_entities_timelines_and_frame_counts_are_there(bent, tmp_path):
    path = tmp_path / "sub" / "bent.rrd"
    recording.record_rollout(path, bent, predicted(bent), config_text="noise: 0.004")
    found = verify_recording(path)
    assert found["application"] == "zsdt" and found["blueprints"] == 1
    assert found["timelines"] == ["frame", "time"]
    for name in ("von_mises", "axial_stress", "displacement_error"):
        assert f"/legend/{name}" in found["static"]
        for side in ("prediction", "truth"):
            assert found["entities"][f"/bodies/{name}/{side}"] == FRAMES
    for curve in ("tip/truth", "tip/prediction", "error/displacement", "error/stress", "energy/elastic"):
        assert found["entities"][f"/plots/{curve}"] == FRAMES
    for curve in ("dissipation/prediction", "dissipation/truth", "latency/frame"):
        assert found["entities"][f"/plots/{curve}"] == FRAMES - 1
    assert {"/about", "/config"} <= set(found["static"])
    assert not list(tmp_path.glob("sub/.*"))


def test_positions_colours_and_errors_in_the_file_are_those_of_the_rollout(bent, tmp_path):
    guess = predicted(bent)
    recording.record_rollout(tmp_path / "a.rrd", bent, guess)
    skin = surface_of(bent.body).nodes
    seen = {}
    for chunk in RrdReader(str(tmp_path / "a.rrd")).stream():
        if not chunk.is_static:
            batch = chunk.to_record_batch().to_pydict()
            for column, values in batch.items():
                seen[(chunk.entity_path, column.rpartition(":")[2])] = values
    drawn = np.array(seen[("/bodies/von_mises/prediction", "vertex_positions")][-1])
    np.testing.assert_allclose(drawn, guess.fields["position"][-1, skin], atol=1e-6)
    below = np.array(seen[("/bodies/von_mises/truth", "vertex_positions")][-1]) - bent.fields["position"][-1, skin]
    assert np.ptp(below, axis=0).max() < 1e-6 and below[0, 2] < -0.1  # the truth, moved as one
    errors = np.array(seen[("/plots/error/stress", "scalars")]).ravel()
    assert np.sqrt(np.mean(errors[1:] ** 2)) == pytest.approx(2.0)  # 2 % on every stress


def test_a_rollout_that_diverged_is_shown_up_to_there(bent, tmp_path):
    recording.record_rollout(tmp_path / "a.rrd", bent, predicted(bent, diverged_at=5))
    assert verify_recording(tmp_path / "a.rrd")["entities"]["/bodies/von_mises/prediction"] == 5


def test_a_method_without_account_and_a_long_rollout(bent, tmp_path, monkeypatch):
    monkeypatch.setattr(recording, "BODY_FRAMES", 4)
    recording.record_rollout(tmp_path / "a.rrd", bent, roll_out(StaticBaseline(), bent))
    entities = verify_recording(tmp_path / "a.rrd")["entities"]
    assert entities["/bodies/axial_stress/truth"] == 4 and entities["/plots/tip/truth"] == FRAMES
    assert "/plots/energy/kinetic" not in entities


def test_a_large_beam_of_a_hundred_frames_stays_below_ten_megabytes(tmp_path):
    body = brick((16, 8, 8))
    random = np.random.default_rng(0)
    position = body.points + 1e-3 * random.normal(size=(100, body.nodes, 3))
    fields = {"position": position, "velocity": position, "stress": random.normal(size=(100, body.nodes, 6))}
    truth = Trajectory(body, 0.01 * np.arange(100), fields, np.zeros((100, body.nodes, 3)))
    guess = Rollout("noise", {k: v + 0.01 for k, v in fields.items()}, np.ones(99))
    recording.record_rollout(tmp_path / "a.rrd", truth, guess)
    assert (tmp_path / "a.rrd").stat().st_size < 10e6


def test_missing_and_broken_recordings_give_one_sentence(bent, tmp_path):
    with pytest.raises(DataError, match="There is no recording"):
        verify_recording(tmp_path / "absent.rrd")
    recording.record_rollout(tmp_path / "a.rrd", bent, predicted(bent))
    content = (tmp_path / "a.rrd").read_bytes()
    (tmp_path / "half.rrd").write_bytes(content[: len(content) // 2])
    with pytest.raises(DataError, match="is broken"):
        verify_recording(tmp_path / "half.rrd")


def test_skin_of_a_brick_is_closed_and_points_outward():
    body = brick((3, 2, 4))
    skin = surface_of(body)
    corners = body.points[skin.nodes][skin.triangles]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    size = np.array([0.15, 0.1, 0.2])
    np.testing.assert_allclose(areas.sum(axis=0), 0.0, atol=1e-12)
    assert np.linalg.norm(areas, axis=1).sum() == pytest.approx(
        2 * (size[0] * size[1] + size[1] * size[2] + size[2] * size[0])
    )
    volume = np.einsum("ti,ti->", corners.mean(axis=1), areas) / 3  # divergence theorem: positive if outward
    assert volume == pytest.approx(np.prod(size))
    lengths = np.linalg.norm(np.diff(body.points[skin.nodes][skin.edges], axis=1)[:, 0], axis=1)
    assert lengths.sum() == pytest.approx(4 * size.sum())  # the twelve edges
    inner = np.setdiff1d(np.arange(body.nodes), skin.nodes)
    assert len(inner) == 2 * 1 * 3


def test_a_body_without_cells_has_no_skin():
    body = brick()
    with pytest.raises(DataError, match="has no cells"):
        surface_of(Body(body.points, body.pairs, body.clamped, body.mass, 0.1, 0.05))


def test_colours_run_between_common_limits():
    palette = Palette("viridis", -1.0, 3.0)
    low, middle, high, above, lost = palette.colours(np.array([-1.0, 1.0, 3.0, 99.0, np.nan]))
    assert (above == high).all() and (lost == 128).all() and (low != high).any()
    assert low[:3].sum() < middle[:3].sum() < high[:3].sum()  # lighter means more
    assert colour_bar(palette, "von Mises stress [Pa]").shape[2] == 3
