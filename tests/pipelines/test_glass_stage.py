"""The stage of the glass twin as a user meets it: a folder of pictures, an empty table, a scene that makes no sense."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest

from pipelines.app import main
from pipelines.registry import APPLICATION
from zsdt.lab.beam_lab import Storage
from zsdt.lab.glass_clips import GlassClip, GlassClipSet, make_glass_clips
from zsdt.lab.glass_lab import GlassLabOptions
from zsdt.perception.video import open_video
from zsdt.scene import VesselFamily
from zsdt.shipped import PARTS, WEIGHTS

pytestmark = pytest.mark.skipif(
    not all((WEIGHTS / "glycerin_glass" / part).is_dir() for part in PARTS),
    reason="no weights of the glass are shipped",
)
SIZE = (320, 240)


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> GlassClip:
    folder = tmp_path_factory.mktemp("lab") / "clips"
    options = GlassLabOptions(
        clips=1, families=[VesselFamily.cylinder], particles=[300, 350], lead=[12, 12], after=20, width=SIZE[0],
        height=SIZE[1], glass_px=[110.0, 120.0], storage=Storage.jpg, seed=3,
    )  # fmt: skip
    make_glass_clips(options, folder)
    return GlassClipSet(folder)[0]


def told(out: Path, *more: str) -> list[str]:
    """What a user types."""
    words = ["experiment=glass_demo", f"machine.outputs={out}", "twin.recording=false", "twin.compare_open=false"]
    return [*words, "scene.fps=60", "scene.particles=250", *more]


def test_a_folder_of_pictures_gets_a_twin_of_what_is_in_the_glass(tmp_path: Path, clip: GlassClip) -> None:
    video, camera = clip.folder / "frames", clip.folder / "camera.json"
    glass = [f"scene.wall={clip.scene.wall}", f"scene.floor={clip.scene.floor}"]
    assert main(APPLICATION, told(tmp_path, f"twin.video={video}", f"twin.camera={camera}", *glass)) == 0
    (artifact,) = (p.parent for p in (tmp_path / "artifacts" / "twin").glob("[!.]*/manifest.json"))
    table = pd.read_csv(artifact / "frames.csv")
    assert len(table) == len(clip.pose)
    assert {"waiting", "moving"} & set(table["status"]) and "corrected" in set(table["status"])
    level = table["level_left_mm"].dropna()
    assert 10 < level.mean() < 120, "mm: the liquid's own height"
    assert open_video(artifact / "twin.webm").size[0] >= SIZE[0]
    assert (artifact / "strip.png").is_file() and (artifact / "summary.png").is_file()
    figures = json.loads((artifact / "manifest.json").read_text())["figures"]
    assert "closed" not in figures, "without the truth there is no error to report"


def test_a_table_without_a_glass_is_said_in_one_sentence(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    frames = tmp_path / "frames"
    frames.mkdir()
    rng = np.random.default_rng(0)
    for k in range(12):
        image = np.full((SIZE[1], SIZE[0], 3), (150, 165, 175), np.uint8)
        image[150:] = (70, 95, 120)
        noisy = np.clip(image + rng.normal(0.0, 3.0, image.shape), 0, 255).astype(np.uint8)
        cv2.imwrite(str(frames / f"{k:05d}.png"), noisy)
    assert main(APPLICATION, told(tmp_path / "out", f"twin.video={frames}", "twin.focal_px=600")) == 1
    error = capfd.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("error: ") and "glass" in error
    assert not list((tmp_path / "out").rglob("twin.webm")), "nothing half-written is left"
