"""An optional depth map (RGB-D) beside the picture: it replaces the constant depth where it has a value.

The seed names planar motion at one constant depth as its main limit; a depth camera lifts it. Depth is measured along
the optical axis, in m, and the map has the size of the picture (registered to it).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int

from zsdt.errors import DataError, OptionError

SUFFIXES = (".npy", ".png")


@dataclass(frozen=True)
class DepthLookup:
    """Depth of each asked pixel [m], and how many of them got the constant because the map has no value there."""

    depth: Float[np.ndarray, " points"]
    missing: int


@dataclass
class DepthOptions:
    """folder: with one map per frame, sorted by name (.npy in m, or 16 bit .png); empty: no maps. unit [m]: of one
    grey level of a .png. nearest, furthest [m]: values outside count as missing. jump [m]: what lies this much further
    away than its neighbours is another object behind them."""

    folder: str = ""
    unit: float = 1e-3
    nearest: float = 0.05
    furthest: float = 20.0
    jump: float = 0.02

    def __post_init__(self) -> None:
        if self.unit <= 0 or self.jump <= 0 or not 0 <= self.nearest < self.furthest:
            raise OptionError("Depth maps need a positive unit and jump, and nearest below furthest.")


def read_depth_map(path: str | os.PathLike[str], unit: float = 1e-3) -> Float[np.ndarray, "height width"]:
    """Depth map [m]; 0 and NaN mean missing and come back as NaN. `unit` [m]: of one grey level of a PNG.

    Raises: DataError where the file is missing, broken, or no map of one value per pixel.
    """
    file = Path(path)
    if not file.is_file():
        raise DataError(f"There is no depth map {path}; correct the path or leave depth maps out.")
    if file.suffix.lower() == ".npy":
        try:
            values = np.load(file, allow_pickle=False)
        except (ValueError, OSError, EOFError) as error:
            raise DataError(f"The depth map {path} is broken ({error}); write it again with numpy.save.") from error
        scale = 1.0
    else:
        values = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        if values is None or values.dtype != np.uint16:
            raise DataError(f"{path} is no depth map: it must be a .npy in m or a grey .png of 16 bits.")
        scale = unit
    if values.ndim != 2 or not np.issubdtype(values.dtype, np.number):
        raise DataError(f"The depth map {path} has shape {values.shape}; it must hold one number for each pixel.")
    depth = values.astype(np.float64) * scale
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)


def look_up(
    depth_map: Float[np.ndarray, "height width"] | None,
    pixels: Float[np.ndarray, "points 2"],
    constant: float,
    options: DepthOptions | None = None,
) -> DepthLookup:
    """Depth [m] at pixels: of the map where it has values, else `constant` [m], counted as missing.

    Nodes often lie on the edge of the beam: of the 3 x 3 pixels around one, those that have a value and do not lie
    `jump` behind the nearest of them count, with weights that fall linearly to nothing at one pixel and a half; on a
    smooth surface that is its depth at the very place.
    """
    if depth_map is None:
        return DepthLookup(np.full(len(pixels), float(constant)), len(pixels))
    limits = options or DepthOptions()
    height, width = depth_map.shape
    inside = np.isfinite(pixels).all(axis=1)
    place = np.where(inside[:, None], pixels, 0.0)
    inside &= (place > -0.5).all(axis=1) & (place[:, 0] < width - 0.5) & (place[:, 1] < height - 0.5)
    center = np.rint(np.clip(place, 0.0, [width - 1.0, height - 1.0])).astype(np.int64)
    around = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1], indexing="ij"), axis=-1).reshape(9, 2)
    near = center[:, None] + around
    held = np.clip(near, 0, [width - 1, height - 1])
    values = depth_map[held[..., 1], held[..., 0]]
    with np.errstate(invalid="ignore"):
        good = (values >= limits.nearest) & (values <= limits.furthest) & (near == held).all(axis=2)
    values = np.where(good, values, np.inf)
    good &= values <= values.min(axis=1, keepdims=True) + limits.jump
    weight = np.where(good, np.prod(1.5 - np.abs(near - place[:, None]), axis=2).clip(0.0), 0.0)
    total = weight.sum(axis=1)
    known = inside & (total > 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        depth = _plane_at(place, near, np.where(good, values, 0.0), weight)
    return DepthLookup(np.where(known, depth, float(constant)), int((~known).sum()))


def _plane_at(
    place: Float[np.ndarray, "points 2"],
    near: Int[np.ndarray, "points 9 2"],
    values: Float[np.ndarray, "points 9"],
    weight: Float[np.ndarray, "points 9"],
) -> Float[np.ndarray, " points"]:
    """Weighted mean of the values, moved to `place` along their slope where the pixels fix one."""
    total = np.maximum(weight.sum(axis=1, keepdims=True), 1e-12)
    share = weight / total
    middle = np.einsum("pk,pka->pa", share, near.astype(np.float64))
    mean = (share * values).sum(axis=1)
    away = near - middle[:, None]
    spread = np.einsum("pk,pka,pkb->pab", share, away, away)
    joint = np.einsum("pk,pka,pk->pa", share, away, values - mean[:, None])
    # A little stiffness: a slope that hangs on one row of pixels is not followed across it.
    slope = np.linalg.solve(spread + 1e-3 * np.eye(2), joint[..., None])[..., 0]
    return mean + ((place - middle) * slope).sum(axis=1)


@dataclass(frozen=True)
class DepthMaps:
    """The depth maps of a video, one file per frame; a frame beyond the last has none."""

    paths: Sequence[Path] = ()
    options: DepthOptions = field(default_factory=DepthOptions)

    def __len__(self) -> int:
        return len(self.paths)

    def frame(self, index: int) -> Float[np.ndarray, "height width"] | None:
        """Map [m] of a frame, None where there is none. Raises: DataError where its file is broken."""
        return read_depth_map(self.paths[index], self.options.unit) if 0 <= index < len(self.paths) else None


def open_depth_maps(options: DepthOptions) -> DepthMaps | None:
    """The maps that the options name; None where they name no folder.

    Raises: DataError where the folder is missing or has no maps.
    """
    if not options.folder:
        return None
    root = Path(options.folder)
    paths = sorted(p for p in root.iterdir() if p.suffix.lower() in SUFFIXES) if root.is_dir() else []
    if not paths:
        raise DataError(f"{root} holds no depth maps ({', '.join(SUFFIXES)}); correct depth.folder or leave it empty.")
    return DepthMaps(tuple(paths), options)
