"""One picture of a glass of which the truth is known against what vision saw in it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from zsdt.perception.glass_segmentation import GlassMasks, GlassSegmenter, alone, instances
from zsdt.perception.glass_vision_data import LabelledGlasses
from zsdt.perception.glass_vision_score import false_share, iou_where, judged_pixels, level_errors, window_of
from zsdt.perception.glass_window import boxes_of

LEVEL_SIZE = 384  # px: errors of the level are given for a picture (or window, where smaller) of this side


@dataclass(frozen=True)
class GlassCase:
    """What was seen in one picture: its row of the table, errors of the level [columns] px at `LEVEL_SIZE`, masks."""

    row: dict[str, Any]
    level_px: Float[np.ndarray, " columns"]
    masks: GlassMasks
    image: UInt8[np.ndarray, "h w 3"]
    container: UInt8[np.ndarray, "h w"]
    liquid: UInt8[np.ndarray, "h w"]


def judge_glass(segmenter: GlassSegmenter, data: LabelledGlasses, number: int) -> GlassCase:
    """One picture against its truth, in the window that the region of interest would have on its largest glass, of
    which alone the masks count, as in the twin."""
    image, window = data.images[number], window_of(data.containers[number])

    def look() -> GlassMasks:
        masks = segmenter.masks(image, window)
        found = instances(masks)
        return alone(masks, found[0]) if found else masks

    return judge_masks(look, data, number)


def judge_masks(look: Callable[[], GlassMasks], data: LabelledGlasses, number: int) -> GlassCase:
    """What `look` sees of one picture against its truth, and how long it takes.

    The level's error is in px of a picture whose longer side has `LEVEL_SIZE` px.
    """
    image, container, liquid = data.images[number], data.containers[number], data.liquids[number]
    began, cpu_began = time.perf_counter(), time.process_time()
    masks = look()
    ended, cpu_ended = time.perf_counter(), time.process_time()
    known = data.liquid_known[number]
    errors = np.zeros(0)
    judged = judged_pixels(container)
    if known:
        seen, truth = (
            np.where(judged, mask, np.float32(0)) for mask in (masks.liquid, liquid.astype(np.float32) / 255)
        )
        errors = level_errors(seen, truth) * (LEVEL_SIZE / max(image.shape[:2]))
    magnitude = np.abs(errors)
    boxes = boxes_of(container > 127)
    row = {
        "image": data.names[number],
        "container_px": boxes[0].extent if boxes else 0,
        "container_iou": iou_where(judged, masks.container, container),
        "liquid_iou": iou_where(judged, masks.liquid, liquid) if known else float("nan"),
        "false_container": false_share(judged, masks.container, container),
        "false_liquid": false_share(judged, masks.liquid, liquid) if known else float("nan"),
        "level_px_median": float(np.median(magnitude)) if len(errors) else float("nan"),
        "level_px_p95": float(np.percentile(magnitude, 95)) if len(errors) else float("nan"),
        "level_px_bias": float(np.median(errors)) if len(errors) else float("nan"),
        "ms": 1e3 * (ended - began),
        "cpu_ms": 1e3 * (cpu_ended - cpu_began),
    }
    return GlassCase(row, errors, masks, image, container, liquid)
