"""Pictures with masks of their grid lines, from which segmentation learns: painted ones, or a folder of a user's own.

Masks are coverage in 0..255: how much of a pixel is paint. A folder holds either pictures with masks of the same
name, or pictures with one JSON of polygons in the COCO format (as CVAT, Label Studio or Roboflow export it).
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from zsdt.errors import DataError

log = logging.getLogger(__name__)

PICTURES = (".png", ".jpg", ".jpeg")
FINE = 4  # times the resolution at which polygons are drawn before they are averaged down

Picture = UInt8[np.ndarray, "_ _ 3"]  # every picture of a set has its own size
Mask = UInt8[np.ndarray, "_ _"]


@dataclass(frozen=True)
class LabelledImages:
    """images [h, w, 3] BGR and masks [h, w], each pair of its own size, with a name for messages."""

    images: Sequence[Picture]
    masks: Sequence[Mask]
    names: Sequence[str]

    def __post_init__(self) -> None:
        if not len(self.images) == len(self.masks) == len(self.names):
            raise DataError("Pictures, masks and names must be as many; give a mask for every picture.")
        for image, mask, name in zip(self.images, self.masks, self.names, strict=True):
            if image.shape[:2] != mask.shape:
                raise DataError(
                    f"The mask of {name} has {mask.shape[1]} x {mask.shape[0]} px, its picture {image.shape[1]} x "
                    f"{image.shape[0]}; export both at one size."
                )

    def __len__(self) -> int:
        return len(self.images)

    def pick(self, which: Sequence[int] | Int[np.ndarray, " count"]) -> LabelledImages:
        """The pairs of the given numbers."""
        order = [int(k) for k in which]
        return LabelledImages(
            [self.images[k] for k in order], [self.masks[k] for k in order], [self.names[k] for k in order]
        )

    def held_out(self, share: float, seed: int) -> tuple[LabelledImages, LabelledImages]:
        """Pairs to learn from and pairs to judge by, at least one of each, drawn by `seed`.

        Raises: DataError where there are fewer than two pairs.
        """
        learned, judged = split(len(self), share, seed)
        return self.pick(learned), self.pick(judged)

    def __add__(self, other: LabelledImages) -> LabelledImages:
        return LabelledImages([*self.images, *other.images], [*self.masks, *other.masks], [*self.names, *other.names])


def split(count: int, share: float, seed: int) -> tuple[Int[np.ndarray, " learned"], Int[np.ndarray, " judged"]]:
    """Numbers of the pictures to learn from and to judge by, of `count`; at least one of each, drawn by `seed`.

    Raises: DataError where there are fewer than two pictures.
    """
    if count < 2:
        raise DataError(f"{count} labelled pictures are too few to train: at least 2 are needed, 55 are good.")
    order = np.random.default_rng(seed).permutation(count)
    judged = min(count - 1, max(1, round(share * count)))
    return order[judged:], order[:judged]


def labelled(pairs: Iterable[tuple[np.ndarray, np.ndarray]], name: str = "painted") -> LabelledImages:
    """Pairs of a picture [h, w, 3] uint8 and a mask [h, w] of uint8, bool, or floats in 0..1."""
    images, masks = [], []
    for image, mask in pairs:
        images.append(np.asarray(image, np.uint8))
        masks.append(coverage(mask))
    return LabelledImages(images, masks, [f"{name} {k}" for k in range(len(images))])


def coverage(mask: np.ndarray) -> Mask:
    """Coverage 0..255 of a mask of uint8, bool, or floats in 0..1."""
    if mask.dtype == np.uint8:
        return mask
    return np.rint(np.clip(mask.astype(np.float32), 0, 1) * 255).astype(np.uint8)


def read_folder(folder: str | Path, category: str | None = None) -> LabelledImages:
    """A user's own pictures and masks.

    Either `images/` and `masks/` with files of the same stem (photos and masks may also lie in one folder as
    `name.jpg` and `name.png`), or pictures beside a COCO JSON of polygons, of which `category` picks one class.
    Raises: DataError where the folder holds neither or a file is missing or broken.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise DataError(f"There is no folder {folder}; name one with pictures and masks.")
    annotations = sorted(folder.glob("*.json")) + sorted(folder.glob("annotations/*.json"))
    if len(annotations) > 1:
        raise DataError(
            f"{folder} holds {len(annotations)} JSON files; keep the one with the polygons of all pictures."
        )
    found = _coco(annotations[0], folder, category) if annotations else _pairs(folder)
    if not len(found):
        raise DataError(f"{folder} holds no PNG or JPG pictures; put them into {folder / 'images'}.")
    log.info("%d labelled pictures from %s", len(found), folder)
    return found


def pictures_in(folder: Path) -> dict[str, Path]:
    """Stem -> picture; several of one stem: the last of the alphabet is left to the caller."""
    return {p.stem: p for p in sorted(folder.iterdir()) if p.suffix.lower() in PICTURES}


def _pairs(folder: Path) -> LabelledImages:
    if (folder / "images").is_dir() and (folder / "masks").is_dir():
        photos, masks = pictures_in(folder / "images"), pictures_in(folder / "masks")
    else:
        photos = {p.stem: p for p in sorted(folder.iterdir()) if p.suffix.lower() in (".jpg", ".jpeg")}
        masks = {p.stem: p for p in sorted(folder.glob("*.png"))}
    without = sorted(set(photos) - set(masks))
    if without:
        raise DataError(
            f"{len(without)} of {len(photos)} pictures in {folder} have no mask of the same name, for example "
            f"{without[0]}; put pictures into images/ and masks into masks/."
        )
    images = [read_picture(path, cv2.IMREAD_COLOR) for path in photos.values()]
    drawn = [read_picture(masks[stem], cv2.IMREAD_GRAYSCALE) for stem in photos]
    for mask, stem in zip(drawn, photos, strict=True):
        if mask.max() == 1:  # a mask of class numbers
            mask *= 255
        if mask.mean() > 127:
            raise DataError(f"The mask {masks[stem]} is mostly white; grid lines must be white on black.")
    return LabelledImages(images, drawn, list(photos))


def read_picture(path: Path, how: int) -> np.ndarray:
    """A picture or mask, uint8; how: a flag of cv2.imread. Raises: DataError where it cannot be read."""
    image = cv2.imread(str(path), how)
    if image is None:
        raise DataError(f"{path} is no readable picture; export it again as PNG or JPG.")
    return np.asarray(image, np.uint8)


def _coco(path: Path, folder: Path, category: str | None) -> LabelledImages:
    """Pictures that a COCO JSON lists, with its polygons drawn; a picture without polygons shows no grid."""
    try:
        content = json.loads(path.read_text())
        listed = {image["id"]: image for image in content["images"]}
        wanted = _category(content, category, path)
        polygons: dict[Any, list[np.ndarray]] = {key: [] for key in listed}
        for note in content["annotations"]:
            if note["category_id"] == wanted:
                polygons[note["image_id"]] += outlines_of(note, path)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path} is no COCO JSON of polygons ({error!r}); export the labels again.") from error
    images, masks, names = [], [], []
    for key, entry in listed.items():
        name = str(entry["file_name"])
        image = listed_picture(name, folder, path)
        images.append(image)
        masks.append(drawn_polygons(polygons[key], (image.shape[0], image.shape[1])))
        names.append(name)
    return LabelledImages(images, masks, names)


def listed_picture(name: str, folder: Path, path: Path) -> Picture:
    """The picture that the COCO JSON `path` calls `name`. Raises: DataError where it is not there."""
    places = [p for p in (folder / name, folder / "images" / name, folder / Path(name).name) if p.is_file()]
    if not places:
        raise DataError(f"{path} lists {name}, which is not in {folder}; copy the pictures beside it.")
    return read_picture(places[0], cv2.IMREAD_COLOR)


def _category(content: dict[str, Any], category: str | None, path: Path) -> Any:
    names = {entry["id"]: str(entry["name"]) for entry in content["categories"]}
    used = {note["category_id"] for note in content["annotations"]}
    matching = [key for key, name in names.items() if (key in used if category is None else name == category)]
    if len(matching) != 1:
        raise DataError(
            f"{path} has the classes {', '.join(sorted(names.values())) or 'none'}; say which one is the grid lines "
            "(option category)."
        )
    return matching[0]


def outlines_of(note: dict[str, Any], path: Path) -> list[np.ndarray]:
    """Polygons [points, 2] px of an annotation of the COCO JSON `path`. Raises: DataError for run-length masks."""
    parts = note["segmentation"]
    if isinstance(parts, dict):
        raise DataError(f"{path} holds run-length masks; export polygons, or PNG masks.")
    return [np.asarray(part, np.float64).reshape(-1, 2) for part in parts]


def drawn_polygons(polygons: Sequence[Float[np.ndarray, "points 2"]], size: tuple[int, int]) -> Mask:
    """Coverage [h, w] of polygons (u, v) whose origin is the corner of the first pixel, as COCO has it."""
    mask = np.zeros(size, np.uint8)
    for polygon in polygons:
        low = np.clip(np.floor(polygon.min(axis=0)).astype(int), 0, size[::-1])
        high = np.clip(np.ceil(polygon.max(axis=0)).astype(int), 0, size[::-1])
        w, h = high - low
        if min(w, h) < 1:
            continue
        corners = [np.rint(((polygon - low) * FINE - 0.5) * 16).astype(np.int32)]
        fine = np.zeros((h * FINE, w * FINE), np.uint8)
        cv2.fillPoly(fine, corners, 255, cv2.LINE_8, 4)
        cv2.polylines(fine, corners, True, 128, 1, cv2.LINE_8, 4)  # half of the pixels on the border is outside
        part = mask[low[1] : high[1], low[0] : high[0]]
        np.maximum(part, cv2.resize(fine, (int(w), int(h)), interpolation=cv2.INTER_AREA), out=part)
    return mask
