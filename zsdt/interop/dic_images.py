"""Real images of a deforming specimen with a referee's displacements: open-hole tension, DIC Challenge sample 12.

Images and displacements come from github.com/dicengine/dice (BSD-3-Clause), tests/regression/dic_challenge_12. The
displacements are those of another program, DICe (subsets of 27 px, every image against the first one): a referee,
not absolute truth.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64, Int64, UInt8

from zsdt.errors import DataError
from zsdt.files import data_root

FOLDER = "dic_images"
STEPS = 5  # deformed images at hand
COLUMNS = ("COORDINATE_X", "COORDINATE_Y", "DISPLACEMENT_X", "DISPLACEMENT_Y")


@dataclass(frozen=True)
class DicImages:
    """Images [steps + 1, h, w] (grey levels), points [points, 2] px in the first one, displacement [steps, points, 2]
    px since the first one as the referee found it, edges [edges, 2] between points beside each other."""

    images: UInt8[np.ndarray, "frames h w"]
    points: Float64[np.ndarray, "points 2"]
    displacement: Float64[np.ndarray, "steps points 2"]
    edges: Int64[np.ndarray, "edges 2"]


def read_dic_images(folder: Path | None = None) -> DicImages:
    """Reads images and referee from `folder` (default: ``dic_images`` below the data root).

    Raises: DataError where a file is missing, is no image, or names other points than the first one.
    """
    folder = data_root() / FOLDER if folder is None else folder
    images = [_read_image(folder / f"oht_cfrp_{step:02d}.tiff") for step in range(STEPS + 1)]
    tables = [_read_table(folder / "gold" / f"DICe_solution_{step:02d}.txt") for step in range(1, STEPS + 1)]
    points = tables[0][:, :2]
    for step, table in enumerate(tables, start=1):
        if table.shape != tables[0].shape or not np.array_equal(table[:, :2], points):
            raise DataError(f"Step {step} of {folder} has other points than step 1; restore the files of its source.")
    if len({image.shape for image in images}) != 1:
        raise DataError(f"The images in {folder} differ in size; restore the files of its source.")
    return DicImages(np.stack(images), points, np.stack([table[:, 2:4] for table in tables]), neighbour_edges(points))


def neighbour_edges(points: Float64[np.ndarray, "points 2"]) -> Int64[np.ndarray, "edges 2"]:
    """Edges between points of a square lattice (with holes) that are one spacing apart along x or y."""
    apart = np.abs(points[:, None] - points[None])
    spacing = float(np.min(apart.max(axis=2) + np.where(np.eye(len(points)), np.inf, 0.0)))
    beside = (np.abs(apart.sum(axis=2) - spacing) < 0.01 * spacing) & (apart.min(axis=2) < 0.01 * spacing)
    left, right = np.nonzero(np.triu(beside))
    return np.stack([left, right], axis=1)


def _read_image(path: Path) -> UInt8[np.ndarray, "h w"]:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) if path.is_file() else None
    if image is None:
        raise DataError(f"{path} is missing or no image; set ZSDT_DATA to the folder that holds {FOLDER}.")
    return image


def _read_table(path: Path) -> Float64[np.ndarray, "points 4"]:
    if not path.is_file():
        raise DataError(f"{path} is missing; set ZSDT_DATA to the folder that holds {FOLDER}.")
    lines = [line for line in path.read_text().splitlines() if line and not line.startswith("*")]
    try:
        header = lines[0].split(",")
        wanted = [header.index(name) for name in COLUMNS]
        return np.array([[float(line.split(",")[column]) for column in wanted] for line in lines[1:]])
    except (IndexError, ValueError) as error:
        raise DataError(f"{path} is no table of DICe with the columns {', '.join(COLUMNS)}: {error}.") from error
