"""Stage `calibrate_camera`: the camera from pictures of a chessboard or a ChArUco board."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

from omegaconf import DictConfig

from pipelines.stages import Stage
from zsdt.errors import DataError, OptionError


def applies(config: DictConfig) -> bool:
    """Whether pictures of a board are named."""
    return "calibrate_camera" in config.stages


def sources(cfg: SimpleNamespace) -> list[Path]:
    """The pictures.

    Raises: OptionError where none are named, DataError where the folder is missing.
    """
    if cfg.camera.images is None:
        raise OptionError("Nothing to calibrate from: set camera.images to a folder of pictures of the board.")
    folder = Path(cfg.camera.images)
    if not folder.is_dir():
        raise DataError(f"There is no folder {folder}; correct camera.images.")
    return sorted(path for path in folder.iterdir() if path.is_file())


def run(cfg: SimpleNamespace, inputs: dict[str, Path], out: Path, scratch: Path) -> dict[str, Any]:
    """Writes `camera.json`, which `twin.camera` takes."""
    from zsdt.perception.calibration import calibrate_folder
    from zsdt.perception.camera import save_camera

    found = calibrate_folder(cfg.camera.images, cfg.camera.board)
    save_camera(out / "camera.json", found.camera)
    print(f"Error {found.rms_px:.3f} px over {len(found.used)} pictures; {len(found.rejected)} without a board.")
    return {"rms_px": found.rms_px, "used": len(found.used), "rejected": len(found.rejected)}


STAGE = Stage("calibrate_camera", 1, ("camera",), run, applies=applies, sources=sources, ignores=("camera.images",))
