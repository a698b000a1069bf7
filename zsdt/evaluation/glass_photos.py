"""Real photos through the segmentation, before and after fine-tuning on them as a user would.

`python -m zsdt.evaluation.glass_photos WEIGHTS OUT` judges trained weights on the photos of
`zsdt.interop.vessel_photos` and the camera frame of the sloshing cylinder, found in the whole picture as the twin finds
its glass. Then it writes the photos as a folder of pictures and masks, fine-tunes on two thirds of them (beside painted
glasses) and judges on the third that was left out, three times over, so that every photo is judged by weights that
never saw it.
"""

from __future__ import annotations

import argparse
import logging
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import UInt8

from zsdt.errors import DataError, ZsdtError
from zsdt.evaluation.glass_vision_judge import GlassCase, judge_glass
from zsdt.evaluation.glass_vision_pictures import sheet, strip, write_sheet
from zsdt.evaluation.glass_vision_training import painted_glasses
from zsdt.evaluation.liquid_report import markdown_table
from zsdt.evaluation.tables import write_csv
from zsdt.files import atomic_path, data_root
from zsdt.interop.vessel_photos import VesselPhoto, read_vessel_photos, write_training_folder
from zsdt.lab.styles import Pool
from zsdt.perception.glass_segmentation import GlassMasks, GlassSegmenter, load_glass_segmenter, trained_size
from zsdt.perception.glass_vision_data import LabelledGlasses, no_glasses, read_glass_folder
from zsdt.perception.glass_vision_train import GlassVisionOptions, train_glass_segmenter
from zsdt.perception.glass_window import Window
from zsdt.perception.region_of_interest import RegionOfInterest
from zsdt.perception.unet import UNetOptions
from zsdt.perception.unet_weights import unet_card
from zsdt.perception.vision_data import drawn_polygons

log = logging.getLogger(__name__)

FRAME = "sloshing_cylinder/frame_Trial.png"
# Outlines (u, v) px in that frame, by eye: the cylinder, which the picture cuts off above, and the dyed water in it.
CYLINDER = [(631, 0), (1329, 0), (1331, 900), (1300, 990), (1230, 1060), (740, 1060), (660, 1000), (631, 900)]
WATER = [(631, 570), (1329, 570), *CYLINDER[2:]]
FOLDS = 3


class Searching:
    """A segmentation that is not told where to look: a region of interest finds the glass first."""

    def __init__(self, segmenter: GlassSegmenter):
        self._segmenter = segmenter

    def masks(self, image: UInt8[np.ndarray, "h w 3"], window: Window | None = None) -> GlassMasks:
        """See `zsdt.perception.glass_segmentation.GlassSegmenter`; the window is not looked at."""
        return RegionOfInterest(self._segmenter).masks(image)


def as_labelled(photos: Sequence[VesselPhoto]) -> LabelledGlasses:
    """Photos with their masks."""
    empty = [np.zeros_like(photo.container) for photo in photos]
    liquids = [e if photo.liquid is None else photo.liquid for photo, e in zip(photos, empty, strict=True)]
    return LabelledGlasses(
        [photo.image for photo in photos],
        [photo.container for photo in photos],
        liquids,
        [photo.name for photo in photos],
        [photo.liquid is not None for photo in photos],
    )


def cylinder_frame() -> LabelledGlasses:
    """The camera frame of the sloshing cylinder, outlined by eye. Raises: DataError where it is missing."""
    path = data_root() / FRAME
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise DataError(f"{path} is missing or broken; restore the file.")
    size = (image.shape[0], image.shape[1])
    masks = [drawn_polygons([np.array(outline, np.float64)], size) for outline in (CYLINDER, WATER)]
    return LabelledGlasses([np.asarray(image, np.uint8)], [masks[0]], [masks[1]], ["sloshing cylinder"], [True])


def fine_tune(
    weights: str | Path, photos: Sequence[VesselPhoto], painted: LabelledGlasses, out: str | Path, steps: int
) -> GlassSegmenter:
    """Goes on from trained weights on a folder of photos and masks, beside painted pictures, at a low rate."""
    with tempfile.TemporaryDirectory() as place:
        write_training_folder(list(photos), Path(place) / "own")
        options = GlassVisionOptions(
            images=len(painted),
            folder=str(Path(place) / "own"),
            start=str(weights),
            steps=steps,
            size=trained_size(weights),
            learning_rate=5e-4,
            check_every=max(1, steps // 3),
            network=UNetOptions(list(unet_card(weights)["widths"])),
        )
        train_glass_segmenter([painted, read_glass_folder(Path(place) / "own")], options, out)
    return load_glass_segmenter(out)


def judge_photos(
    weights: str | Path, out: str | Path, *, steps: int = 120, painted: int = 60
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """A row for every picture (before and after), and means; writes photos.csv, photos.md and pictures into `out`.

    steps: of fine-tuning (0: none); painted: pictures of the virtual lab beside the photos. The cylinder's frame is
    judged after a fine-tuning on all photos.
    """
    out = Path(out)
    photos = read_vessel_photos()
    data, frame = as_labelled(photos), cylinder_frame()
    first = Searching(load_glass_segmenter(weights))
    before = [judge_glass(first, data, k) for k in range(len(data))] + [judge_glass(first, frame, 0)]
    after: list[GlassCase] = []
    if steps:
        beside = painted_glasses(0, painted, Pool.train) if painted else no_glasses()
        folds = np.random.default_rng(0).permutation(len(photos)) % FOLDS
        with tempfile.TemporaryDirectory() as place:
            judged: dict[int, GlassCase] = {}
            for fold in range(FOLDS):
                learned = [photo for photo, own in zip(photos, folds, strict=True) if own != fold]
                tuned = Searching(fine_tune(weights, learned, beside, Path(place) / str(fold), steps))
                judged |= {int(k): judge_glass(tuned, data, int(k)) for k in np.flatnonzero(folds == fold)}
            everything = Searching(fine_tune(weights, photos, beside, Path(place) / "all", steps))
            after = [judged[k] for k in range(len(photos))] + [judge_glass(everything, frame, 0)]
    rows = [_row(one, after[k] if after else None) for k, one in enumerate(before)]
    means = [_means("9 photos", rows[:-1])]
    _write(out, rows, means, before, after, steps, painted)
    return rows, means


def _row(before: GlassCase, after: GlassCase | None) -> dict[str, Any]:
    row: dict[str, Any] = {"image": before.row["image"]}
    for name in ("container_iou", "liquid_iou", "level_px_median"):
        for when, case in (("before", before), ("after", after)):
            if case is not None:
                value = case.row[name]
                row[f"{name}_{when}"] = None if np.isnan(value) else value
    return row


def _means(name: str, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    names = [key for key in rows[0] if key != "image"]
    found = {key: [row[key] for row in rows if row[key] is not None] for key in names}
    return {"image": name, **{key: float(np.mean(values)) if values else None for key, values in found.items()}}


def _write(
    out: Path,
    rows: list[dict[str, Any]],
    means: list[dict[str, Any]],
    before: Sequence[GlassCase],
    after: Sequence[GlassCase],
    steps: int,
    painted: int,
) -> None:
    write_csv(out / "photos.csv", rows)
    shown = {"photos_before": before, "photos_after": after}
    for name, cases in shown.items():
        if cases:
            write_sheet(out / f"{name}.jpg", sheet([strip(case, 260) for case in cases], columns=3))
    tuning = (
        f"After: fine-tuned for {steps} steps on the photos of two of {FOLDS} folds beside {painted} painted pictures, "
        "judged on the third; the cylinder after fine-tuning on all photos."
    )
    lines = [
        "# Real photos through the segmentation",
        "",
        "Before: the weights as they are shipped, which never saw a photo. The glass is searched in the whole picture. "
        "Container outlines of the photos are their makers'; liquids, and both outlines of the cylinder, were read off "
        "by eye (1-2 px). The level's error is the median over columns, in px of a picture of 384 px; a dash where "
        "none was seen or the liquid is not known. " + (tuning if after else ""),
        "",
        markdown_table([*means, *rows]),
        "",
        "Left what was seen, right the truth; green container, orange liquid.",
        "",
        *[f"![{name}]({name}.jpg)\n" for name, cases in shown.items() if cases],
    ]
    with atomic_path(out / "photos.md") as beside:
        beside.write_text("\n".join(lines))


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line; the exit status."""
    parser = argparse.ArgumentParser(prog="python -m zsdt.evaluation.glass_photos", description=__doc__)
    parser.add_argument("weights", type=Path, help="folder with unet.pt and unet.json")
    parser.add_argument("out", type=Path, help="folder for the report")
    parser.add_argument("--steps", type=int, default=120, help="of fine-tuning; 0: none")
    parser.add_argument("--painted", type=int, default=60, help="painted pictures beside the photos")
    parser.add_argument("--threads", type=int, default=1)
    given = parser.parse_args(arguments)
    torch.set_num_threads(given.threads)
    cv2.setNumThreads(1)
    try:
        rows, means = judge_photos(given.weights, given.out, steps=given.steps, painted=given.painted)
    except ZsdtError as error:
        print(error, file=sys.stderr)
        return 2
    print(markdown_table([*means, *rows]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
