"""What stages film or watch: a clip of the virtual lab or a video of a user's own, and what the twin is told of it."""

from __future__ import annotations

import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from omegaconf import DictConfig

from pipelines import weights
from pipelines.kinds import Kind, kind_of
from pipelines.options import Watching
from zsdt.errors import DataError, OptionError
from zsdt.perception.camera import Camera, load_camera
from zsdt.perception.video import FrameSource, open_video


def applies(config: DictConfig) -> bool:
    """Whether there is a scene (group `scene`)."""
    return config.scene is not None


def sources(cfg: SimpleNamespace) -> list[Path]:
    """Video, camera and shipped weights.

    Raises: DataError where a named file is missing.
    """
    found = weights.files_of(cfg.twin.weights, kind_of(cfg.scene, cfg.twin))
    for name in (cfg.twin.video, cfg.twin.camera):
        if name is None or name.isdigit():
            continue
        if not Path(name).exists():
            raise DataError(f"There is no file or folder {name}; correct twin.video or twin.camera.")
        found += sorted(p for p in Path(name).rglob("*") if p.is_file()) if Path(name).is_dir() else [Path(name)]
    return found


def narrow(read: dict[str, Any]) -> dict[str, Any]:
    """A live camera never shows the same twice, so a run of it gets the time into its key; a budget counts only where
    it is planned by."""
    video = read["twin"]["video"]
    if "budget" in read and not read["twin"].get("plan"):
        read = {name: part for name, part in read.items() if name != "budget"}
    if video is not None and video.isdigit():
        return {**read, "taken": time.time()}
    return {**read, "twin": {k: v for k, v in read["twin"].items() if k not in ("video", "camera")}}


def clip_of(twin: Watching, inputs: dict[str, Path], kind: Kind) -> Any:
    """The clip of the lab that is watched, None for a video.

    Raises: OptionError where the lab has not so many.
    """
    if twin.video is not None:
        return None
    clips = kind.clips(inputs["film"])
    if not 0 <= twin.clip < len(clips):
        raise OptionError(f"There is no clip {twin.clip}; the virtual lab has {len(clips)}, counted from 0.")
    return clips[twin.clip]


def source_of(cfg: SimpleNamespace, clip: Any) -> FrameSource:
    """The frames. Raises: DataError where the video does not open."""
    return clip.source() if clip is not None else open_video(str(cfg.twin.video), cfg.scene.fps or None)


def told(cfg: SimpleNamespace, clip: Any, source: FrameSource, kind: Kind) -> tuple[Any, Camera]:
    """Scene and camera as the twin is told them: by the lab, or by the options.

    Raises: OptionError where nobody says what the camera is.
    """
    if clip is not None:
        return kind.told(cfg.scene, clip), clip.camera
    if cfg.twin.camera is not None:
        return cfg.scene, kind.placed(load_camera(cfg.twin.camera), cfg.twin)
    if cfg.twin.focal_px is None:
        raise OptionError(
            "The camera is unknown: calibrate it (stages=[calibrate_camera] camera.images=FOLDER) and set "
            "twin.camera to the file, or give its focal length in pixels as twin.focal_px."
        )
    width, height = source.size
    focal = cfg.twin.focal_px
    matrix = np.array([[focal, 0.0, 0.5 * (width - 1)], [0.0, focal, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])
    camera = Camera(matrix, np.zeros(5), np.eye(3), np.zeros(3), width, height)
    return cfg.scene, kind.placed(camera, cfg.twin)
