"""What a segmentation of a glass is worth against the truth: IoU, and the level that it shows, column by column."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from zsdt.perception.glass_segmentation import GlassSegmenter
from zsdt.perception.glass_vision_data import LabelledGlasses
from zsdt.perception.glass_window import Window, boxes_of
from zsdt.perception.region_of_interest import RegionOptions
from zsdt.perception.vision_train import iou_of

MARGIN = RegionOptions().near  # beside the container, share of its longer side: what the region of interest shows
JUDGED = 0.25  # the same of what is judged


def window_of(container: UInt8[np.ndarray, "h w"], margin: float = MARGIN) -> Window:
    """The window that the region of interest has on the largest container; the whole picture without one.

    margin: beside the container, share of its longer side.
    """
    boxes = boxes_of(container > 127)
    if not boxes:
        return Window.whole(*container.shape)
    return Window.around(boxes[0].middle, boxes[0].extent * (1 + 2 * margin))


def judged_pixels(container: UInt8[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """What a picture is judged by: a window about the largest glass, wider than the one that is looked at (what lies
    beyond that counts as not seen), without other glasses, which may be cut by it."""
    shown = np.zeros(container.shape, bool)
    shown[window_of(container, JUDGED).inside(*container.shape)] = True
    count, labels, stats, _ = cv2.connectedComponentsWithStats((container > 127).astype(np.uint8), connectivity=4)
    if count > 2:
        main = 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
        others = ((labels != main) & (labels > 0)).astype(np.uint8)
        shown &= cv2.dilate(others, np.ones((5, 5), np.uint8)) == 0
    return shown


def iou_where(
    judged: Bool[np.ndarray, "h w"], probability: Float[np.ndarray, "h w"], mask: UInt8[np.ndarray, "h w"]
) -> float:
    """IoU over the judged pixels. NaN where the truth shows nothing; what is seen there is told by `false_share`."""
    if not (mask[judged] > 127).any():
        return float("nan")
    return iou_of(np.where(judged, probability, np.float32(0)), np.where(judged, mask, 0))


def false_share(
    judged: Bool[np.ndarray, "h w"], probability: Float[np.ndarray, "h w"], mask: UInt8[np.ndarray, "h w"]
) -> float:
    """Share of the judged pixels in which something is seen that is not there."""
    return float(((probability[judged] > 0.5) & (mask[judged] <= 127)).mean())


def mean_ious(segmenter: GlassSegmenter, data: LabelledGlasses) -> tuple[float, float]:
    """Mean IoU of container and liquid over the pictures that show them; NaN where none does."""
    containers, liquids = [], []
    for k in range(len(data)):
        masks = segmenter.masks(data.images[k], window_of(data.containers[k]))
        judged = judged_pixels(data.containers[k])
        containers.append(iou_where(judged, masks.container, data.containers[k]))
        if data.liquid_known[k]:
            liquids.append(iou_where(judged, masks.liquid, data.liquids[k]))
    return _mean(containers), _mean(liquids)


def _mean(values: list[float]) -> float:
    known = [value for value in values if np.isfinite(value)]
    return float(np.mean(known)) if known else float("nan")


def top_edge(share: Float[np.ndarray, "h w"]) -> Float[np.ndarray, " w"]:
    """Row [px, sub-pixel] at which a mask begins in every column, seen from above; NaN where it never does.

    The border runs where the share passes one half, between the centres of two pixels.
    """
    wet = share > 0.5
    first = wet.argmax(axis=0)
    columns = np.arange(share.shape[1])
    here = share[first, columns].astype(np.float64)
    above = np.where(first > 0, share[np.maximum(first - 1, 0), columns], 0.0)
    back = (here - 0.5) / np.maximum(here - above, 1e-9)
    return np.where(wet.any(axis=0), first - np.clip(back, 0, 1), np.nan)


def main_body(share: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """The largest part of a mask that hangs together; drops, and slivers that a wall of glass shows, are left out."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats((share > 0.5).astype(np.uint8), connectivity=4)
    if count <= 2:
        return share
    largest = 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
    return np.where((labels == largest) | (share <= 0.5), share, np.float32(0))


def level_errors(
    seen: Float[np.ndarray, "h w"], truth: Float[np.ndarray, "h w"], sides: float = 0.04
) -> Float[np.ndarray, " columns"]:
    """Distance [px] of the seen top edge of the liquid from the true one in every column that both have, of the main
    body of each.

    sides: share of the liquid's width at either side that does not count: there the edge runs down the wall.
    """
    seen, truth = main_body(seen), main_body(truth)
    wet = np.flatnonzero((truth > 0.5).any(axis=0))
    if not len(wet):
        return np.zeros(0)
    inset = sides * (wet[-1] - wet[0])
    columns = wet[(wet >= wet[0] + inset) & (wet <= wet[-1] - inset)]
    errors = top_edge(seen)[columns] - top_edge(truth)[columns]
    return errors[np.isfinite(errors)]
