"""The stage of the twin as a user meets it: a folder of pictures, a video file, a broken file, an unknown camera."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest

from pipelines import footage
from pipelines.app import main
from pipelines.registry import APPLICATION
from zsdt.lab.beam_lab import BeamLabOptions, Storage
from zsdt.lab.clips import Clip, ClipSet, make_clips
from zsdt.perception.video import VideoFrame, WebcamSource, open_video, write_video
from zsdt.solid.sampler import SizeRange

FRAMES = 12


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Clip:
    folder = tmp_path_factory.mktemp("lab") / "clips"
    sizes = SizeRange([45, 55], [15, 15], [10, 15])
    make_clips(BeamLabOptions(clips=1, frames=FRAMES, width=640, height=360, sizes=sizes, storage=Storage.jpg), folder)
    return ClipSet(folder)[0]


def told(clip: Clip, out: Path, *more: str) -> list[str]:
    """What a user types about the beam in front of the camera."""
    words = ["experiment=beam_ci", "stages=[twin]", f"machine.outputs={out}", "twin.recording=false"]
    words += [f"scene.width={clip.scene.beam_width}", f"scene.depth={clip.scene.depth}", "scene.fps=60"]
    return [*words, *more]


def test_a_folder_of_pictures_gets_a_twin_and_the_same_video_one_that_agrees(tmp_path: Path, clip: Clip) -> None:
    camera = f"twin.camera={clip.folder / 'camera.json'}"
    frames = clip.folder / "frames"
    video = tmp_path / "beam.webm"
    write_video(video, (frame.image for frame in open_video(frames, 60.0)), 60.0)
    tips = []
    for name, source in (("pictures", frames), ("video", video)):
        assert main(APPLICATION, told(clip, tmp_path / name, camera, f"twin.video={source}")) == 0
        (artifact,) = (p.parent for p in (tmp_path / name / "artifacts" / "twin").glob("[!.]*/manifest.json"))
        table = pd.read_csv(artifact / "frames.csv")
        assert len(table) == FRAMES and (table["seen"] > 0).all()
        assert open_video(artifact / "twin.webm").size == (640, 360)
        tips.append(table["innovation_mm"].dropna().to_numpy())
        figures = json.loads((artifact / "manifest.json").read_text())["figures"]
        assert "open" not in figures, "without the truth there is no error to report"
    # The innovation is the camera's shake and the unknown load: millimetres, in both encodings of the same frames.
    assert all(np.median(values) < 3.0 for values in tips)


def test_a_live_camera_is_watched_for_as_long_as_was_asked(
    tmp_path: Path, clip: Clip, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    images = [frame.image for frame in clip.source()]

    class PlayedWebcam(WebcamSource):
        """Shows the clip again and again, sixty times a second; no device is touched."""

        def __iter__(self) -> Iterator[VideoFrame]:
            for k in itertools.count():
                yield VideoFrame(k, k / 60.0, images[k % len(images)])

    played = PlayedWebcam("0", 60.0, (640, 360), cv2.VideoCapture())
    monkeypatch.setattr(footage, "open_video", lambda source, fps: played)
    camera = f"twin.camera={clip.folder / 'camera.json'}"
    assert main(APPLICATION, told(clip, tmp_path, camera, "twin.video='0'")) == 1
    assert "A webcam never ends" in capfd.readouterr().err
    for run in (1, 2):  # what is live is never reused
        assert main(APPLICATION, told(clip, tmp_path, camera, "twin.video='0'", "twin.loop.frames=10")) == 0
        artifacts = [p.parent for p in (tmp_path / "artifacts" / "twin").glob("[!.]*/manifest.json")]
        assert len(artifacts) == run
    table = pd.read_csv(artifacts[0] / "frames.csv")
    assert len(table) == 10 and "corrected" in set(table["status"])
    assert open_video(artifacts[0] / "twin.webm").size == (640, 360)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["twin.video=BROKEN", "twin.focal_px=700"], "cannot be read as a video"),
        (["twin.video=NOWHERE.mp4"], "There is no file or folder NOWHERE.mp4"),
        (["twin.video=FRAMES"], "The camera is unknown"),
        (["twin.video=EMPTY", "twin.focal_px=700"], "holds no pictures"),
    ],
)
def test_what_cannot_be_watched_is_said_in_one_sentence(
    tmp_path: Path, clip: Clip, capfd: pytest.CaptureFixture[str], words: list[str], sentence: str
) -> None:
    (tmp_path / "broken.mp4").write_text("no video")
    (tmp_path / "empty").mkdir()
    places = {"BROKEN": tmp_path / "broken.mp4", "FRAMES": clip.folder / "frames", "EMPTY": tmp_path / "empty"}
    filled = [word.replace(name, str(path)) for word in words for name, path in places.items() if name in word]
    filled += [word for word in words if not any(name in word for name in places)]
    assert main(APPLICATION, told(clip, tmp_path / "out", *filled)) == 1
    error = capfd.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("error: ") and sentence in error
    assert not list((tmp_path / "out").rglob("twin.webm")), "nothing half-written is left"
