"""Pictures with masks of container and liquid, from which segmentation learns: rendered ones, or a user's own folder.

Three ways to label (one folder holds one of them):

- `images/NAME.jpg` and `masks/NAME.png` of class numbers: 0 background, 1 container, 2 liquid.
- `images/NAME.jpg` and a mask for each class, white where it is: `masks/NAME_container.png` (liquid included) and
  `masks/NAME_liquid.png`. Clips of the virtual lab have them (their pictures are in `frames/`). Where no liquid was
  labelled in any picture, only the container is learned.
- pictures beside one COCO JSON of polygons of the classes `container` and `liquid`.
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
from jaxtyping import Int, UInt8

from zsdt.errors import DataError
from zsdt.perception.vision_data import (
    Mask,
    Picture,
    coverage,
    drawn_polygons,
    listed_picture,
    outlines_of,
    pictures_in,
    read_picture,
    split,
)

log = logging.getLogger(__name__)

CLASSES = "container", "liquid"
CONTAINER, LIQUID = 1, 2  # class numbers of a mask


@dataclass(frozen=True)
class LabelledGlasses:
    """images [h, w, 3] BGR; containers (liquid included) and liquids [h, w], coverage 0..255; names for messages.

    liquid_known: whether a picture's liquid was labelled; where not, its mask is empty and says nothing.
    """

    images: Sequence[Picture]
    containers: Sequence[Mask]
    liquids: Sequence[Mask]
    names: Sequence[str]
    liquid_known: Sequence[bool]

    def __post_init__(self) -> None:
        if len({len(part) for part in (self.images, self.containers, self.liquids, self.names, self.liquid_known)}) > 1:
            raise DataError("Pictures, masks and names must be as many; give both masks for every picture.")
        for image, container, liquid, name in zip(self.images, self.containers, self.liquids, self.names, strict=True):
            for mask in (container, liquid):
                if image.shape[:2] != mask.shape:
                    raise DataError(
                        f"A mask of {name} has {mask.shape[1]} x {mask.shape[0]} px, its picture {image.shape[1]} x "
                        f"{image.shape[0]}; export both at one size."
                    )

    def __len__(self) -> int:
        return len(self.images)

    def pick(self, which: Sequence[int] | Int[np.ndarray, " count"]) -> LabelledGlasses:
        """The pictures of the given numbers."""
        parts = (self.images, self.containers, self.liquids, self.names, self.liquid_known)
        return LabelledGlasses(*([part[int(k)] for k in which] for part in parts))  # type: ignore[arg-type]

    def held_out(self, share: float, seed: int) -> tuple[LabelledGlasses, LabelledGlasses]:
        """Pictures to learn from and to judge by, see `zsdt.perception.vision_data.split`."""
        learned, judged = split(len(self), share, seed)
        return self.pick(learned), self.pick(judged)

    def __add__(self, other: LabelledGlasses) -> LabelledGlasses:
        return LabelledGlasses(
            [*self.images, *other.images],
            [*self.containers, *other.containers],
            [*self.liquids, *other.liquids],
            [*self.names, *other.names],
            [*self.liquid_known, *other.liquid_known],
        )


def labelled_glasses(
    shots: Iterable[tuple[np.ndarray, np.ndarray, np.ndarray]], name: str = "painted"
) -> LabelledGlasses:
    """Pictures [h, w, 3] uint8 with container and liquid [h, w] of uint8, bool, or floats in 0..1."""
    images, containers, liquids = [], [], []
    for image, container, liquid in shots:
        images.append(np.asarray(image, np.uint8))
        containers.append(coverage(container))
        liquids.append(coverage(liquid))
    names = [f"{name} {k}" for k in range(len(images))]
    return LabelledGlasses(images, containers, liquids, names, [True] * len(images))


def no_glasses() -> LabelledGlasses:
    """No picture at all."""
    return LabelledGlasses([], [], [], [], [])


def read_glass_folder(folder: str | Path) -> LabelledGlasses:
    """A user's own pictures and masks, in one of the ways of this module.

    Raises: DataError where the folder holds none of them or a file is missing or broken.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise DataError(f"There is no folder {folder}; name one with pictures and masks.")
    if (folder / "masks").is_dir():
        found = _pairs(folder)
    else:
        annotations = sorted(folder.glob("*.json")) + sorted(folder.glob("annotations/*.json"))
        if len(annotations) != 1:
            raise DataError(
                f"{folder} holds no masks/ and {len(annotations)} JSON files; put masks into {folder / 'masks'}, or "
                "one COCO JSON of polygons beside the pictures."
            )
        found = _coco(annotations[0], folder)
    if not len(found):
        raise DataError(f"{folder} holds no labelled PNG or JPG pictures; put them into {folder / 'images'}.")
    if not any((container > 127).any() for container in found.containers):
        raise DataError(f"No mask in {folder} shows a container; white (255) or 1 must mark it.")
    log.info("%d labelled glasses from %s, %d with liquid", len(found), folder, sum(found.liquid_known))
    return found


def _pairs(folder: Path) -> LabelledGlasses:
    """Pictures with masks; a picture without any mask is passed over where others have one (clips mask some frames)."""
    places = [place for place in (folder / "images", folder / "frames") if place.is_dir()]
    if not places:
        raise DataError(f"{folder} holds masks/ but neither images/ nor frames/; put the pictures into images/.")
    photos, masks = pictures_in(places[0]), pictures_in(folder / "masks")
    strange = sorted(set(masks) - {f"{stem}{end}" for stem in photos for end in ("", "_container", "_liquid")})
    if strange:
        raise DataError(f"The mask {masks[strange[0]]} belongs to no picture in {places[0]}; give both the same name.")
    images, containers, liquids, names = [], [], [], []
    wet = any(stem.endswith("_liquid") for stem in masks) or any(stem in masks for stem in photos)
    for stem, path in photos.items():
        if stem in masks:
            container, liquid = _classes(masks[stem])
        elif f"{stem}_container" in masks:
            container = _white(masks[f"{stem}_container"])
            drawn = masks.get(f"{stem}_liquid")
            liquid = np.zeros_like(container) if drawn is None else _white(drawn)
        else:
            continue
        images.append(read_picture(path, cv2.IMREAD_COLOR))
        containers.append(np.maximum(container, liquid))
        liquids.append(liquid)
        names.append(stem)
    return LabelledGlasses(images, containers, liquids, names, [wet] * len(images))


def _classes(path: Path) -> tuple[Mask, Mask]:
    numbers = read_picture(path, cv2.IMREAD_GRAYSCALE)
    if numbers.max() > LIQUID:
        raise DataError(
            f"The mask {path} holds the class number {numbers.max()}; 0 background, 1 container and 2 liquid are "
            f"known. White masks are named {path.stem}_container.png and {path.stem}_liquid.png."
        )
    return np.where(numbers >= CONTAINER, 255, 0).astype(np.uint8), np.where(numbers == LIQUID, 255, 0).astype(np.uint8)


def _white(path: Path) -> UInt8[np.ndarray, "h w"]:
    mask = read_picture(path, cv2.IMREAD_GRAYSCALE)
    return mask * 255 if mask.max() == 1 else mask


def _coco(path: Path, folder: Path) -> LabelledGlasses:
    """Pictures that a COCO JSON lists, with its polygons drawn; a picture without polygons shows no glass."""
    try:
        content = json.loads(path.read_text())
        listed = {image["id"]: str(image["file_name"]) for image in content["images"]}
        names = {entry["id"]: str(entry["name"]).lower() for entry in content["categories"]}
        polygons: dict[tuple[Any, str], list[np.ndarray]] = {}
        for note in content["annotations"]:
            polygons.setdefault((note["image_id"], names[note["category_id"]]), []).extend(outlines_of(note, path))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path} is no COCO JSON of polygons ({error!r}); export the labels again.") from error
    if "container" not in names.values():
        raise DataError(
            f"{path} has the classes {', '.join(sorted(set(names.values()))) or 'none'}; "
            "name them container and liquid."
        )
    images, containers, liquids = [], [], []
    for key, name in listed.items():
        image = listed_picture(name, folder, path)
        container, liquid = (drawn_polygons(polygons.get((key, kind), []), image.shape[:2]) for kind in CLASSES)
        images.append(image)
        containers.append(np.maximum(container, liquid))
        liquids.append(liquid)
    known = "liquid" in names.values()
    return LabelledGlasses(images, containers, liquids, list(listed.values()), [known] * len(images))
