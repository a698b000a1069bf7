"""Real photos of laboratory glass with the outline of the vessel, as a folder that segmentation can be trained on.

Photos and outlines come from github.com/sagieppel/Computer-vision-based-recognition-of-liquid-surface-and-liquid-level-
in-transparent-vessel (MIT). Their makers outlined the vessel, by a contour of one pixel, and not the liquid: where it
begins and ends was read off by eye for this project, to 1 or 2 px.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from scipy.ndimage import binary_closing, binary_fill_holes

from zsdt.errors import DataError
from zsdt.files import atomic_path, data_root

FOLDER = "vessel_photos"
OUTLINE = "_BORDERS.tif"
GAP = 3  # px of an outline that may be missing
# First row of the liquid (far edge of its surface) and one beyond its last, by eye. None: a column of wet silica.
LEVELS: dict[str, tuple[int, int] | None] = {
    "IMG_2860": (224, 259),
    "IMG_2917": (141, 187),
    "IMG_3262": (76, 113),
    "IMG_3267": (125, 184),
    "IMG_3294": (132, 164),
    "IMG_3506": (171, 200),
    "IMG_3904": (145, 162),
    "IMG_4268": (233, 419),
    "IMG_5510": None,
}


@dataclass(frozen=True)
class VesselPhoto:
    """A photo (BGR), its vessel with what is inside, and its liquid [h, w], 0 or 255; liquid None: nobody can tell."""

    name: str
    image: UInt8[np.ndarray, "h w 3"]
    container: UInt8[np.ndarray, "h w"]
    liquid: UInt8[np.ndarray, "h w"] | None


def read_vessel_photos(folder: Path | None = None) -> list[VesselPhoto]:
    """Reads photos and outlines from `folder` (default: ``vessel_photos`` below the data root).

    Outlines that are a pixel larger than their photo are cut off at the right and the bottom. Raises: DataError where
    there are none, a photo is missing, or an outline encloses nothing.
    """
    folder = data_root() / FOLDER if folder is None else folder
    outlines = sorted(folder.glob(f"*{OUTLINE}")) if folder.is_dir() else []
    if not outlines:
        raise DataError(f"{folder} holds no outlines *{OUTLINE}; restore the files of its source.")
    photos = []
    for path in outlines:
        name = path.name.removesuffix(OUTLINE)
        image = cv2.imread(str(folder / f"{name}.JPG"), cv2.IMREAD_COLOR)
        outline = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if image is None or outline is None:
            raise DataError(f"{folder / name}.JPG or its outline is missing or broken; restore the files.")
        h, w = image.shape[:2]
        if abs(outline.shape[0] - h) > 2 or abs(outline.shape[1] - w) > 2:
            raise DataError(f"The outline of {name} has another size than its photo; restore the files.")
        line = np.zeros((h, w), bool)
        part = outline[:h, :w] > 127
        line[: part.shape[0], : part.shape[1]] = part
        container = filled(line, name)
        photos.append(VesselPhoto(name, np.asarray(image, np.uint8), container, _liquid(name, container)))
    return photos


def _liquid(name: str, container: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"] | None:
    rows = LEVELS.get(name)
    if rows is None:
        return None
    liquid = np.zeros_like(container)
    liquid[slice(*rows)] = container[slice(*rows)]
    return liquid


def filled(line: np.ndarray, name: str) -> UInt8[np.ndarray, "h w"]:
    """What a closed outline [h, w] encloses, itself included, 0 or 255; small gaps are closed first.

    Raises: DataError where it encloses nothing.
    """
    for gap in range(0, GAP + 1):
        wide = np.pad(line, gap + 1)
        closed = binary_closing(wide, np.ones((2 * gap + 1, 2 * gap + 1), bool)) if gap else wide
        inside = binary_fill_holes(closed)[gap + 1 : -gap - 1, gap + 1 : -gap - 1]
        if inside.sum() > 3 * line.sum():
            return np.where(inside, 255, 0).astype(np.uint8)
    raise DataError(f"The outline of {name} is not closed; it must enclose the vessel.")


def write_training_folder(photos: list[VesselPhoto], folder: Path) -> None:
    """Writes `images/NAME.png`, `masks/NAME_container.png` and `masks/NAME_liquid.png`, which `read_glass_folder` and
    the stage train_vision read. Photos of unknown liquid are passed over."""
    for photo in photos:
        if photo.liquid is None:
            continue
        for place, picture in (
            (folder / "images" / f"{photo.name}.png", photo.image),
            (folder / "masks" / f"{photo.name}_container.png", photo.container),
            (folder / "masks" / f"{photo.name}_liquid.png", photo.liquid),
        ):
            good, png = cv2.imencode(".png", picture)
            if not good:
                raise DataError(f"OpenCV could not write {place}.")
            with atomic_path(place) as beside:
                beside.write_bytes(png.tobytes())
