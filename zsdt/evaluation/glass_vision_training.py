"""Training the segmentation of glasses from options alone: pictures are rendered or read, trained on, judged."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from tqdm import tqdm

from zsdt.evaluation.glass_vision_report import judge_glass_vision
from zsdt.lab.glass_stills import painted_glass
from zsdt.lab.styles import Pool
from zsdt.perception.glass_segmentation import load_glass_segmenter
from zsdt.perception.glass_vision_data import LabelledGlasses, labelled_glasses, no_glasses, read_glass_folder
from zsdt.perception.glass_vision_train import GlassVisionOptions, train_glass_segmenter
from zsdt.perception.yolo_glass import YoloOptions, train_yolo

FIRST_RAYTRACED = 100_000  # seed of the first ray-traced picture: other glasses than the painted ones show


def painted_glasses(first: int, count: int, pool: Pool) -> LabelledGlasses:
    """Painted stills of the seeds from `first` on."""
    stills = (painted_glass(first + k, pool) for k in tqdm(range(count), desc="paint", unit="picture", disable=None))
    return labelled_glasses(((s.image, s.container_mask, s.liquid_mask) for s in stills), f"painted {pool.value}")


def raytraced_glasses(first: int, count: int, pool: Pool) -> LabelledGlasses:
    """Ray-traced stills of the seeds from `first` on. Raises: OptionError without the extra ``zsdt[raytrace]``."""
    from zsdt.lab.raytrace_stills import raytraced_glass  # an optional package

    stills = (raytraced_glass(first + k, pool) for k in tqdm(range(count), desc="ray trace", disable=None))
    return labelled_glasses(((s.image, s.container_mask, s.liquid_mask) for s in stills), f"ray-traced {pool.value}")


def labelled_groups(options: GlassVisionOptions | YoloOptions) -> list[LabelledGlasses]:
    """The pictures that the options name, one group of each kind.

    Raises: OptionError where ray-traced ones are asked for and the extra is not installed, DataError for a folder
    that cannot be read.
    """
    groups = []
    if options.images:
        groups.append(painted_glasses(options.seed, options.images, Pool.train))
    if options.raytraced:
        groups.append(raytraced_glasses(FIRST_RAYTRACED + options.seed, options.raytraced, Pool.train))
    if options.folder is not None:
        groups.append(read_glass_folder(options.folder))
    return groups


def train_and_judge(
    options: GlassVisionOptions | YoloOptions, judged: int, out: str | Path, scratch: str | Path | None = None
) -> dict[str, Any]:
    """Trains into the folder `out` and judges on `judged` painted stills of unseen looks (0: none), `out/judged`.

    Returns the card of the weights without its options, and the summary under `unseen`. An interrupted training is
    kept in `scratch` and goes on from there.
    """
    groups = labelled_groups(options)
    if isinstance(options, YoloOptions):
        with tempfile.TemporaryDirectory() as place:
            card = train_yolo(sum(groups, no_glasses()), options, out, scratch or place)
    else:
        card = train_glass_segmenter(groups, options, out, scratch)
    unseen: dict[str, Any] = {}
    if judged:
        data = painted_glasses(0, judged, Pool.unseen)
        unseen = judge_glass_vision(load_glass_segmenter(out), data, Path(out) / "judged").summary
    return {**{name: value for name, value in card.items() if name != "options"}, "unseen": unseen}
