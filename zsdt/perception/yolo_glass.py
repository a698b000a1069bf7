"""Container and liquid by YOLO11-seg, the segmentation of the seed, behind the same interface as the U-Net.

An optional extra (`pip install zsdt[yolo]`): the package ultralytics is licensed under the AGPL-3.0, which also binds
those who offer a program that uses it over a network, and it needs torchvision. Nothing of it is part of zsdt.
The seed fine-tuned YOLO11s-seg at 768 px for 300 epochs on 160 frames, from weights that ultralytics offers for
download; this module never downloads: give a file, or the name of an architecture (`yolo11s-seg.yaml`) to begin anew.
"""

from __future__ import annotations

import importlib
import json
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from jaxtyping import Float, UInt8

from zsdt.errors import DataError, OptionError
from zsdt.files import atomic_path
from zsdt.perception.glass_segmentation import YOLO_CARD, GlassMasks
from zsdt.perception.glass_vision_data import CLASSES, LabelledGlasses
from zsdt.perception.glass_window import Window, cut, put_back

log = logging.getLogger(__name__)

WEIGHTS = "yolo.pt"
SIZE = 768  # px, as in the seed
FEWEST = 3  # corners of a polygon


@dataclass
class YoloOptions:
    """model: a file of weights to fine-tune, or an architecture of ultralytics to begin anew. images, raytraced, folder
    are what it learns from, see `zsdt.perception.glass_vision_train.GlassVisionOptions`. epochs, size [px], batch as in
    the seed. held_out: share of the pictures by which ultralytics keeps the best weights. confidence: below which a
    found instance does not count."""

    model: str = "yolo11s-seg.yaml"
    images: int = 160
    raytraced: int = 0
    folder: str | None = None
    epochs: int = 300
    size: int = SIZE
    batch: int = 8
    held_out: float = 0.1
    confidence: float = 0.25
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.images, self.raytraced) < 0 or (self.images + self.raytraced == 0 and self.folder is None):
            raise OptionError("Nothing to learn from: give a number of rendered images, a folder of pictures, or both.")
        if min(self.epochs, self.batch) < 1 or self.size < 32 or self.size % 32:
            raise OptionError("epochs and batch must be at least 1, size a multiple of 32.")
        if not 0 < self.held_out < 1 or not 0 <= self.confidence < 1:
            raise OptionError("held_out and confidence must lie between 0 and 1.")


def load_ultralytics() -> Any:
    """The module. Raises: OptionError where it, or torchvision, is not installed."""
    try:
        return importlib.import_module("ultralytics")
    except ImportError as error:
        raise OptionError(
            f"The segmentation yolo_seg needs the package ultralytics (AGPL-3.0) and torchvision ({error}); run "
            "`pip install zsdt[yolo]`, or use the U-Net (vision=glass), which needs neither."
        ) from error


class YoloGlassSegmenter:
    """See `zsdt.perception.glass_segmentation.GlassSegmenter`; the largest probability of a class's instances."""

    def __init__(self, folder: str | Path, size: int | None = None):
        folder = Path(folder)
        try:
            card = json.loads((folder / YOLO_CARD).read_text())
            self._size, self._confidence = int(size or card["size"]), float(card["confidence"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise DataError(f"No trained YOLO in {folder} ({error}); train one or name another folder.") from error
        if not (folder / WEIGHTS).is_file():
            raise DataError(f"{folder} holds no {WEIGHTS}; train it again or name another folder.")
        self._model = load_ultralytics().YOLO(str(folder / WEIGHTS))

    def masks(self, image: UInt8[np.ndarray, "h w 3"], window: Window | None = None) -> GlassMasks:
        """See `GlassSegmenter`."""
        h, w = image.shape[:2]
        window = window or Window.whole(h, w)
        found = self._model.predict(
            cut(image, window, self._size), imgsz=self._size, conf=self._confidence, verbose=False, retina_masks=True
        )[0]
        container, liquid = self._united(found)
        container = np.maximum(container, liquid)  # the container holds its liquid, here as in the training masks
        return GlassMasks(put_back(container, window, h, w), put_back(liquid, window, h, w), window)

    def _united(self, found: Any) -> Float[np.ndarray, "2 size size"]:
        """One mask for each class."""
        both = np.zeros((len(CLASSES), self._size, self._size), np.float32)
        if found.masks is None:
            return both
        parts = found.masks.data.cpu().numpy().astype(np.float32)
        for part, number in zip(parts, found.boxes.cls.cpu().numpy().astype(int), strict=True):
            if part.shape != both.shape[1:]:
                part = cv2.resize(part, (self._size, self._size), interpolation=cv2.INTER_LINEAR)
            both[number] = np.maximum(both[number], part)
        return both


def train_yolo(data: LabelledGlasses, options: YoloOptions, out: str | Path, scratch: str | Path) -> dict[str, Any]:
    """Fine-tunes YOLO through ultralytics and writes `yolo.pt` and `yolo.json` into `out`; returns the card.

    scratch: where the data set and the runs of ultralytics are written. Raises: OptionError where ultralytics is not
    installed, DataError for too few pictures.
    """
    ultralytics = load_ultralytics()
    learned, judged = data.held_out(options.held_out, options.seed)
    listing = write_yolo_dataset(learned, judged, Path(scratch) / "yolo")
    model = ultralytics.YOLO(options.model)
    model.train(
        data=str(listing),
        epochs=options.epochs,
        imgsz=options.size,
        batch=options.batch,
        seed=options.seed,
        deterministic=True,
        plots=False,
        project=str(Path(scratch) / "runs"),
        exist_ok=True,
    )
    card = {
        "kind": "yolo_seg",
        "model": options.model,
        "size": options.size,
        "confidence": options.confidence,
        "pictures": len(learned),
        "pictures_held_out": len(judged),
        "licence": "AGPL-3.0 (ultralytics)",
    }
    with atomic_path(Path(out) / WEIGHTS) as beside:
        beside.write_bytes(Path(model.trainer.best).read_bytes())
    with atomic_path(Path(out) / YOLO_CARD) as beside:
        beside.write_text(json.dumps(card, indent=1))
    return card


def write_yolo_dataset(learned: LabelledGlasses, judged: LabelledGlasses, folder: Path) -> Path:
    """Writes pictures and polygons as ultralytics reads them; returns the path of its `data.yaml`.

    Raises: DataError where a picture's liquid is not labelled, which YOLO would learn as none.
    """
    for name, part in (("train", learned), ("val", judged)):
        if not all(part.liquid_known):
            raise DataError("YOLO needs the liquid labelled in every picture; label it, or train the U-Net.")
        for number, image in enumerate(part.images):
            lines = [
                " ".join([str(kind), *(f"{value:.6f}" for value in polygon.ravel())])
                for kind, masks in enumerate((part.containers, part.liquids))
                for polygon in polygons_of(masks[number])
            ]
            with atomic_path(folder / "labels" / name / f"{number:05d}.txt") as beside:
                beside.write_text("\n".join(lines) + "\n" if lines else "")
            with atomic_path(folder / "images" / name / f"{number:05d}.png") as beside:
                beside.write_bytes(cv2.imencode(".png", image)[1].tobytes())
    listing = {
        "path": str(folder.resolve()),
        "train": "images/train",
        "val": "images/val",
        "names": dict(enumerate(CLASSES)),
    }
    with atomic_path(folder / "data.yaml") as beside:
        beside.write_text(yaml.safe_dump(listing))
    return folder / "data.yaml"


def polygons_of(mask: UInt8[np.ndarray, "h w"]) -> list[Float[np.ndarray, "points 2"]]:
    """Outer outlines of a mask, (u, v) as shares of width and height."""
    h, w = mask.shape
    lines, _ = cv2.findContours((mask > 127).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    shares = [(line[:, 0] + 0.5) / (w, h) for line in lines if len(line) >= FEWEST]
    return [np.asarray(share, np.float64) for share in shares]
