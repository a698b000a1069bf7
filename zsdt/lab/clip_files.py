"""What clips of all laboratories have in common on the disk: frames, cards, an index, and a set that resumes."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from tqdm import tqdm

from zsdt.errors import DataError
from zsdt.files import atomic_path
from zsdt.perception.video import FrameSource, open_video, write_frames, write_video
from zsdt.workers import NamedJob, plain, run_all

JPEG_QUALITY = 95
VIDEO = "video.webm"


class Storage(Enum):
    """How frames are kept: a video file (small, slow to write), a folder of JPG (fast), or of PNG (without loss)."""

    video = "video"
    jpg = "jpg"
    png = "png"


def keep_frames(
    folder: Path, frames: Iterable[UInt8[np.ndarray, "height width 3"]], storage: Storage, fps: float
) -> None:
    """Writes the frames of a clip. Raises: DataError where the disk does not take them."""
    if storage is Storage.video:
        write_video(folder / VIDEO, frames, fps)
    else:
        write_frames(folder / "frames", frames, JPEG_QUALITY if storage is Storage.jpg else None)


def kept_frames(folder: Path, fps: float) -> FrameSource:
    """The frames that `keep_frames` wrote."""
    frames = folder / "frames"
    return open_video(frames if frames.is_dir() else folder / VIDEO, fps)


def write_card(path: Path, card: dict[str, Any]) -> None:
    """Writes plain values, enums and options as JSON."""
    path.write_text(json.dumps(plain(card), indent=1))


def read_card(path: Path) -> dict[str, Any]:
    """Reads JSON. Raises: DataError where the file is missing or broken."""
    try:
        card = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise DataError(f"{path} is missing or broken ({error}); make the clip again.") from error
    if not isinstance(card, dict):
        raise DataError(f"{path} does not hold what a clip promises; make the clip again.")
    return card


def read_scene_card(folder: Path, schema: str, version: int) -> dict[str, Any]:
    """What the twin is told, without the schema. Raises: DataError where the folder is no clip or of another one."""
    if not (folder / "scene.json").is_file():
        raise DataError(f"{folder} holds no clip (scene.json is missing); run the stage that makes clips first.")
    card = read_card(folder / "scene.json")
    found = (card.pop("schema", None), card.pop("schema_version", None))
    if found != (schema, version):
        raise DataError(f"{folder} is of schema {found[0]} version {found[1]}, not {schema} {version}; make it again.")
    return card


def read_array(path: Path) -> np.ndarray:
    """Reads a .npy file. Raises: DataError where it is missing or broken."""
    try:
        return np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise DataError(f"{path} is missing or broken ({error}); make the clip again.") from error


def read_index(folder: Path) -> list[dict[str, str]]:
    """Rows of `index.csv` of a set. Raises: DataError where there is none."""
    index = folder / "index.csv"
    if not index.is_file():
        raise DataError(f"{folder} holds no clips (index.csv is missing); run the stage that makes them first.")
    with index.open(newline="") as lines:
        return list(csv.DictReader(lines))


def write_clip_index(folder: Path, columns: Sequence[str], rows: Iterable[dict[str, Any]]) -> None:
    """Writes `index.csv` of a set."""
    with atomic_path(folder / "index.csv") as beside, beside.open("w", newline="") as lines:
        writer = csv.DictWriter(lines, columns)
        writer.writeheader()
        writer.writerows(rows)


def make_set(
    make: Callable[..., dict[str, Any]],
    plans: Sequence[NamedJob],
    options: Any,
    out: str | os.PathLike[str],
    workers: int,
) -> dict[str, dict[str, Any]]:
    """Runs `make(plan, options, folder)` for all plans whose folder is not there yet; gives back their figures.

    plans: the most costly first. Clips that are complete stay, if they were made with the same options.
    Raises: DataError (other options, disk); whatever `make` raises.
    """
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    card, wanted = folder / "options.json", json.dumps(plain(asdict(options)), indent=1, sort_keys=True)
    if card.exists() and card.read_text() != wanted:
        raise DataError(f"{out} holds clips made with other options; choose another folder or delete it.")
    with atomic_path(card) as beside:
        beside.write_text(wanted)
    todo = [plan for plan in plans if not (folder / plan.name).is_dir()]
    made: dict[str, dict[str, Any]] = {}
    with tqdm(total=len(plans), initial=len(plans) - len(todo), desc="clips", unit="clip", disable=None) as bar:
        run_all(make, {p.name: (p, options, str(folder / p.name)) for p in todo}, workers, made, bar)
    return made


def set_figures(plans: int, frames: int, made: dict[str, dict[str, Any]], workers: int) -> dict[str, Any]:
    """Numbers for a manifest: clips, rejections by cause, processor seconds of simulation and of filming.

    frames: of the clips in `made`; each of these says `rejected`, `simulate_s` and `film_s`.
    """
    return {
        "clips": plans,
        "made": len(made),
        "rejections": sorted(cause for figures in made.values() for cause in figures["rejected"]),
        "simulate_s": sum(figures["simulate_s"] for figures in made.values()),
        "film_s": sum(figures["film_s"] for figures in made.values()),
        "film_s_per_frame": sum(figures["film_s"] for figures in made.values()) / max(frames, 1),
        "workers": workers,
    }
