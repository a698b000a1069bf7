"""The reader of the silicone recordings, on a made-up file and on the real ones."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from zsdt.errors import DataError
from zsdt.files import data_root
from zsdt.interop.silicone_beam import (
    MARKERS,
    PLACES,
    RECORDINGS,
    read_markers,
    read_silicone,
    release_frame,
    rigid_placement,
)

# Beam axes in capture axes: x along capture z, y against capture y, z along capture x, then 7 degrees down.
AXES = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
TILT = Rotation.from_euler("y", 7.0, degrees=True).as_matrix()


def made_up(drop=0.007, frames=200, release=60):
    """Markers [frames, 6, 3] m in capture axes: held, then the tip sinks by `drop` along capture -x."""
    held = PLACES @ TILT @ AXES + np.array([0.05, 0.03, -0.02])
    markers = np.repeat(held[None], frames, axis=0)
    sunk = drop * np.clip((np.arange(frames) - release) / 10.0, 0.0, 1.0)
    markers[:, :3, 0] -= sunk[:, None]
    return markers


def write(path, markers, unit="m", factor=1.0):
    head = ["t_s"] + [f"{name}_{axis}_{unit}" for name in MARKERS for axis in "xyz"]
    rows = [",".join(head)]
    for k, frame in enumerate(markers.reshape(len(markers), -1)):
        rows.append(",".join([f"{3.0 + 0.01 * k:.4f}"] + ["" if np.isnan(v) else f"{v * factor:.7f}" for v in frame]))
    path.write_text("\n".join(rows) + "\n")


def test_a_release_is_read_in_beam_axes(tmp_path):
    write(tmp_path / "beam_gravity_V2_a.csv", made_up())
    recording = read_silicone("gravity", tmp_path)
    assert recording.release == 60
    assert recording.misfit < 1e-6
    assert np.allclose(recording.held, PLACES, atol=1e-6)
    assert np.allclose(recording.drop, 0.007, atol=1e-5)
    assert np.linalg.norm(recording.gravity) == pytest.approx(9.81)
    assert recording.gravity[2] == pytest.approx(-9.81 * np.cos(np.radians(7.0)), rel=1e-5)
    assert recording.times[0] == 0.0 and recording.base_motion.max() < 1e-5


def test_millimetres_and_gaps(tmp_path):
    markers = made_up()
    markers[100:110, 1, 2] = np.nan
    write(tmp_path / "file.csv", markers, "mm", 1e3)
    times, read = read_markers(tmp_path / "file.csv")
    assert np.isnan(read[100:110, 1]).all() and np.isfinite(read[:, 0]).all()
    assert np.allclose(read[:100], markers[:100], atol=1e-7)
    assert times[-1] == pytest.approx(1.99)


def test_one_frame_off_is_no_release():
    markers = made_up()[:, :3]
    markers[30] += 0.01
    assert release_frame(markers) == 60


def test_placement_recovers_a_rigid_movement():
    turn, shift, miss = rigid_placement(made_up()[0], PLACES)
    assert np.allclose(made_up()[0] @ turn.T + shift, PLACES) and miss < 1e-12
    assert np.linalg.det(turn) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace("Tip-2_y_m", "Tip-2_y"), "no column Tip-2_y"),
        (lambda text: text[: len(text) // 2].rsplit(",", 3)[0], "cut off"),
        (lambda text: text.replace("3.0500", "what"), "no number"),
        (lambda text: text.replace("3.0500", "3.0900"), "equal steps"),
        (lambda text: "", "cut off"),
    ],
)
def test_broken_files_are_named(tmp_path, change, message):
    path = tmp_path / "beam_gravity_V2_a.csv"
    write(path, made_up())
    path.write_text(change(path.read_text()))
    with pytest.raises(DataError, match=message):
        read_silicone("gravity", tmp_path)


def test_nothing_there_and_nothing_let_go(tmp_path):
    with pytest.raises(DataError, match="no silicone recording"):
        read_silicone("load7", tmp_path)
    with pytest.raises(DataError, match="ZSDT_DATA"):
        read_silicone("gravity", tmp_path)
    write(tmp_path / "beam_gravity_V2_a.csv", made_up(drop=0.0))
    with pytest.raises(DataError, match="no release"):
        read_silicone("gravity", tmp_path)


@pytest.mark.skipif(not (data_root() / "silicone_beam").is_dir(), reason="the silicone data are not here (ZSDT_DATA)")
@pytest.mark.parametrize(("name", "millimetres"), [("gravity", 6.7), ("load52", 17.5), ("load101", 27.6)])
def test_the_real_recordings_say_what_their_source_says(name, millimetres):
    recording = read_silicone(name)
    assert recording.load == RECORDINGS[name]
    assert 1e3 * recording.drop[0] == pytest.approx(millimetres, abs=0.1)
    assert np.isfinite(recording.markers).all()
    assert recording.misfit < 1.2e-3
    assert 6.0 < np.degrees(np.arcsin(recording.gravity[0] / 9.81)) < 8.0
