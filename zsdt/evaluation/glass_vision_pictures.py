"""Pictures of what vision saw of glasses: outlines of container and liquid over the photo, truth beside."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from zsdt.errors import DataError
from zsdt.evaluation.glass_vision_judge import GlassCase
from zsdt.files import atomic_path

SHOWN = 6  # cases on a sheet
COLUMNS = 3
TILE = 300  # px: height of a picture on a sheet
CONTAINER, LIQUID, TRUE = (90, 220, 60), (30, 120, 255), (255, 255, 255)  # BGR


def outlined(
    image: UInt8[np.ndarray, "h w 3"], container: Float[np.ndarray, "h w"], liquid: Float[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w 3"]:
    """The picture with container outlined green, liquid filled and outlined orange."""
    canvas = image.copy()
    wet = liquid > 0.5
    canvas[wet] = np.rint(0.65 * canvas[wet] + 0.35 * np.array(LIQUID)).astype(np.uint8)
    for mask, colour in ((container > 0.5, CONTAINER), (wet, LIQUID)):
        lines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(canvas, lines, -1, colour, 1, cv2.LINE_AA)
    return canvas


def strip(case: GlassCase, height: int = TILE) -> UInt8[np.ndarray, "height width 3"]:
    """What was seen and what is true side by side, with a line of figures below."""

    def scaled(layer: np.ndarray) -> np.ndarray:
        factor = height / layer.shape[0]
        how = cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR
        return cv2.resize(layer, (max(1, round(layer.shape[1] * factor)), height), interpolation=how)

    image = np.asarray(scaled(case.image), np.uint8)
    seen = outlined(image, scaled(case.masks.container), scaled(case.masks.liquid))
    truth = [scaled(mask.astype(np.float32) / 255) for mask in (case.container, case.liquid)]
    both = np.concatenate([seen, outlined(image, *truth)], axis=1)
    row = case.row
    text = f"container {row['container_iou']:.3f}" if np.isfinite(row["container_iou"]) else "no container"
    if np.isfinite(row["liquid_iou"]):
        text += f"  liquid {row['liquid_iou']:.3f}  level {row['level_px_median']:.1f} px"
    wide = max(both.shape[1], 330)
    both = np.pad(both, ((0, 22), (0, wide - both.shape[1]), (0, 0)))
    cv2.putText(both, text, (4, height + 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, TRUE, 1, cv2.LINE_AA)
    return both


def sheet(tiles: Sequence[UInt8[np.ndarray, "h _ 3"]], columns: int = COLUMNS) -> UInt8[np.ndarray, "height width 3"]:
    """Pictures of one height in rows of `columns`."""
    rows = [np.concatenate(tiles[k : k + columns], axis=1) for k in range(0, len(tiles), columns)]
    wide = max(row.shape[1] for row in rows)
    return np.concatenate([np.pad(row, ((0, 4), (0, wide - row.shape[1]), (0, 0))) for row in rows])


def write_sheet(path: Path, image: UInt8[np.ndarray, "h w 3"]) -> None:
    """Raises: DataError where OpenCV cannot write the picture."""
    good, packed = cv2.imencode(path.suffix, image, [cv2.IMWRITE_JPEG_QUALITY, 90])
    if not good:
        raise DataError(f"OpenCV could not write the picture {path.name}.")
    with atomic_path(path) as beside:
        beside.write_bytes(packed.tobytes())


def write_glass_cases(folder: Path, cases: Sequence[GlassCase]) -> list[str]:
    """Writes `worst.jpg` (least IoU of liquid, or container where no liquid is labelled) and `typical.jpg`; returns
    the names without ending."""

    def score(case: GlassCase) -> float:
        seen = [case.row["liquid_iou"], case.row["container_iou"], 1 - case.row["false_container"]]
        return float(np.nanmin([*seen, 1 - case.row["false_liquid"]]))

    order = sorted(cases, key=score)
    middle = max(0, (len(order) - SHOWN) // 2)
    for name, chosen in (("worst", order[:SHOWN]), ("typical", order[middle : middle + SHOWN])):
        write_sheet(folder / f"{name}.jpg", sheet([strip(case) for case in chosen]))
    return ["worst", "typical"]
