"""The recording, the video and the figure of a run hold what a person needs to see."""

import cv2
import numpy as np
import pytest
from rerun.chunk import RrdReader

from tests.twin.made_up_run import FRAMES, made_up_run, pictures_of
from zsdt.errors import DataError
from zsdt.twin import twin_recording
from zsdt.twin.field_scale import ShownName
from zsdt.twin.overlay import OverlayOptions
from zsdt.twin.overlay_video import comparison, overlay_frames, overlay_pictures, scale_of_run
from zsdt.twin.surface import surface_of
from zsdt.twin.twin_errors import distances, relative_errors
from zsdt.twin.twin_plots import run_summary
from zsdt.twin.verification import verify_recording


@pytest.fixture(scope="module")
def sides():
    return made_up_run()


@pytest.fixture(scope="module")
def pictures(sides):
    return list(pictures_of(sides[2]))


@pytest.fixture(scope="module")
def recorded(sides, pictures, tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "twin.rrd"
    closed, free, truth = sides
    twin_recording.record_twin(path, closed, iter(pictures), truth, free, config_text="gain: 0.5")
    return path


def test_entities_timelines_and_frames_are_there(recorded):
    found = verify_recording(recorded)
    assert found["application"] == "zsdt" and found["blueprints"] == 1 and found["timelines"] == ["frame", "time"]
    entities = found["entities"]
    assert entities["/world/camera/picture"] == FRAMES and "/world/camera" in found["static"]
    for field in ("von_mises", "axial_stress", "displacement", "speed"):
        assert f"/legend/{field}" in found["static"]
        assert entities[f"/world/{field}/twin"] == entities[f"/world/{field}/truth"] == FRAMES
    assert entities["/world/innovation/nodes"] == entities["/world/shape/lost"] == FRAMES
    for outline in ("twin", "truth", "truth_outline", "open_loop"):
        assert entities[f"/world/shape/{outline}"] == FRAMES
    for curve in (
        "tip/truth", "error/closed_loop_displacement", "error/open_loop_stress", "seen/share", "latency/track",
        "latency/all", "energy/elastic", "energy/true_elastic", "innovation/rms",
    ):  # fmt: skip
        assert entities[f"/plots/{curve}"] == FRAMES
    assert entities["/plots/entropy/closed_loop"] == FRAMES - 1
    assert entities["/log"] == 3  # corrected, dark, corrected again
    assert {"/about", "/config"} <= set(found["static"])
    assert found["bytes"] < FRAMES * 60_000 + 1e6


def test_places_colours_and_pictures_in_the_file_are_those_of_the_run(recorded, sides, pictures):
    closed, _, truth = sides
    seen = {}
    for chunk in RrdReader(str(recorded)).stream():
        for column, values in chunk.to_record_batch().to_pydict().items():
            seen[(chunk.entity_path, column.rpartition(":")[2])] = values
    skin = surface_of(closed.body).nodes
    drawn = np.array(seen[("/world/von_mises/twin", "vertex_positions")][-1])
    np.testing.assert_allclose(drawn, closed.positions[-1, skin], atol=1e-6)
    scale = twin_recording.scales_of(closed, truth, OverlayOptions())["von_mises"]
    colours = scale.palette.colours(scale.factor * closed.values("von_mises")[-1, skin]).astype(np.uint32)
    packed = (colours << np.array([24, 16, 8, 0], np.uint32)).sum(axis=1)
    np.testing.assert_array_equal(seen[("/world/von_mises/twin", "vertex_colors")][-1], packed)
    below = np.array(seen[("/world/von_mises/truth", "vertex_positions")][-1]) - truth.positions[-1, skin]
    assert np.ptp(below, axis=0).max() < 1e-6 and below[0, 2] < -0.1
    lost = seen[("/world/shape/lost", "positions")]
    assert [len(points or []) for points in lost] == [int((~s).sum()) for s in closed.seen]
    blob = np.array(seen[("/world/camera/picture", "blob")][5][0], np.uint8)
    shown = cv2.imdecode(blob, cv2.IMREAD_COLOR).astype(float)
    overlay = list(overlay_pictures(closed, pictures))[5]
    assert np.abs(shown - overlay).mean() < 6.0 and np.abs(shown - pictures[5][1]).mean() > 8.0
    errors = np.array(seen[("/plots/error/open_loop_displacement", "scalars")]).ravel()
    np.testing.assert_allclose(errors, 100 * relative_errors(sides[1], truth)["displacement"], rtol=1e-6)


def test_the_twin_lies_on_the_body_in_the_picture(sides, pictures):
    closed, _, truth = sides
    gap = np.linalg.norm(closed.pixels() - truth.pixels(), axis=3)
    assert gap.max() < 6.0
    frames = list(overlay_pictures(closed, pictures))
    assert len(frames) == FRAMES and frames[0].shape == pictures[0][1].shape
    scale = scale_of_run(closed, OverlayOptions())
    assert scale.palette.high * 1e3 >= np.percentile(closed.on_front(closed.values("von_mises")), 99)
    changed = (frames[0] != pictures[0][1]).any(axis=2)
    u, v = np.rint(closed.pixels()[0, 3:-3, 1:-1].reshape(-1, 2)).astype(int).T
    assert changed[v, u].all()


def test_a_frame_that_never_came_is_drawn_over_the_last_picture(sides, pictures, monkeypatch, tmp_path):
    closed = sides[0]
    faults = ["missing" if k in (4, 5, FRAMES - 1) else "" for k in range(FRAMES)]
    holed = type(closed)(**{**vars(closed), "faults": faults})
    came = [(n, image) for n, image in pictures if not faults[n]]
    frames = dict(overlay_frames(holed, came))
    assert list(frames) == list(range(FRAMES))
    again = dict(overlay_frames(holed, [(4, pictures[3][1])]))[4]
    np.testing.assert_array_equal(frames[4], again)
    monkeypatch.setattr(twin_recording, "PICTURE_FRAMES", 5)
    twin_recording.record_twin(tmp_path / "a.rrd", holed, came)
    entities = verify_recording(tmp_path / "a.rrd")["entities"]
    assert entities["/world/camera/picture"] == 5 and entities["/log"] == 4


def test_a_comparison_has_a_row_for_each_side(sides, pictures):
    chosen = {n: image for n, image in pictures if n in (1, 7)}
    closed, free, truth = sides
    sheet = comparison(chosen, [closed, free, truth])
    alone = comparison(chosen, [truth])
    assert sheet.shape[1] == alone.shape[1] and sheet.shape[0] > 1.7 * alone.shape[0]
    with pytest.raises(DataError, match="has no frame 99"):
        comparison({99: pictures[0][1]}, [closed])
    with pytest.raises(DataError, match="at least one picture"):
        comparison({}, [closed])


def test_a_run_without_truth_latency_or_stress(sides, pictures, tmp_path):
    closed = sides[0]
    closed = type(closed)(
        **{
            **vars(closed),
            "fields": {"velocity": closed.fields["velocity"]},
            "latency": {},
            "account": {},
            "source": "",
        }
    )
    with pytest.raises(DataError, match="has not decoded stress"):
        twin_recording.record_twin(tmp_path / "a.rrd", closed, pictures)
    assert not list(tmp_path.iterdir())
    options = OverlayOptions(field=ShownName.displacement)
    twin_recording.record_twin(tmp_path / "a.rrd", closed, pictures, options=options)
    entities = verify_recording(tmp_path / "a.rrd")["entities"]
    assert "/world/speed/twin" in entities and "/world/von_mises/twin" not in entities
    assert "/plots/latency/all" not in entities and "/world/shape/truth" not in entities
    assert run_summary(closed)[:4] == b"\x89PNG"
    with pytest.raises(DataError, match="None of the pictures"):
        twin_recording.record_twin(tmp_path / "b.rrd", closed, [(500, pictures[0][1])], options=options)


def test_errors_are_those_of_the_fields(sides):
    closed, free, truth = sides
    moved = type(closed)(**{**vars(truth), "name": "moved", "positions": truth.positions + np.array([0, 0, 1e-3])})
    np.testing.assert_allclose(distances(moved, truth), 1e-3, atol=1e-12)
    assert relative_errors(truth, truth)["stress"].max() == 0.0
    assert relative_errors(free, truth)["stress"].mean() > 5 * relative_errors(closed, truth)["stress"].mean()
    assert run_summary(closed, truth, free)[:4] == b"\x89PNG"


def test_a_run_of_other_frames_is_refused(sides, tmp_path):
    closed, _, truth = sides
    short = made_up_run(6)[1]
    with pytest.raises(DataError, match="different frames"):
        twin_recording.record_twin(tmp_path / "a.rrd", closed, [], truth, short)
    with pytest.raises(DataError, match="instead of 12"):
        type(closed)(**{**vars(closed), "faults": ["", "dark"]})
