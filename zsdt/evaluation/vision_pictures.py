"""Pictures of what vision saw: nodes and edges drawn over the photo, the probability of paint beside it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from zsdt.errors import DataError
from zsdt.evaluation.vision_judge import Case
from zsdt.files import atomic_path
from zsdt.perception.grid_graph import GridGraph

SHOWN = 3  # cases on a sheet
LINKED, BARE, FOUND, FILLED, TRUE = (80, 220, 80), (0, 150, 255), (255, 255, 0), (0, 0, 255), (255, 255, 255)  # BGR
CLAMP = (255, 0, 255)


def drawn_grid(
    image: UInt8[np.ndarray, "h w 3"],
    grid: GridGraph | None,
    truth: Float[np.ndarray, "columns rows 2"] | None = None,
) -> UInt8[np.ndarray, "height width 3"]:
    """The picture at double size with the graph over it.

    Edges green where they are painted, orange where not; nodes cyan where found, red where filled in; the column at the
    clamp magenta; small white crosses at the true nodes.
    """
    canvas = np.asarray(cv2.resize(image, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR), np.uint8)
    if grid is not None:
        place = _doubled(grid.pixels).reshape(-1, 2)
        for (a, b), linked in zip(grid.edges, grid.linked, strict=True):
            cv2.line(canvas, _at(place[a]), _at(place[b]), LINKED if linked else BARE, 2, cv2.LINE_AA, 4)
        for node, (point, found) in enumerate(zip(place, grid.found.ravel(), strict=True)):
            colour = FILLED if not found else CLAMP if node < grid.rows else FOUND
            cv2.circle(canvas, _at(point), 5 * 16, colour, 2, cv2.LINE_AA, 4)
    if truth is not None:
        for point in _doubled(truth).reshape(-1, 2):
            cv2.drawMarker(canvas, (round(point[0]), round(point[1])), TRUE, cv2.MARKER_CROSS, 6, 1)
    return canvas


def _doubled(pixels: np.ndarray) -> np.ndarray:
    """Pixels of the picture in one of double size (pixel centres at integers)."""
    return 2 * pixels + 0.5


def _at(point: np.ndarray) -> tuple[int, int]:
    return round(float(point[0]) * 16), round(float(point[1]) * 16)


def write_cases(folder: Path, cases: Sequence[Case]) -> list[str]:
    """Writes `worst.png` and `typical.png`; the names without ending.

    Worst: least recall, then largest error. Typical: error at the 95th percentile nearest to the median of all.
    """

    def badness(case: Case) -> tuple[float, float]:
        return 1 - case.row["node_recall"], case.row["error_px_p95"]

    known = [case.row["error_px_p95"] for case in cases if case.grid is not None]
    middle = float(np.median(known)) if known else 0.0
    worst = sorted(cases, key=badness, reverse=True)[:SHOWN]
    typical = sorted(cases, key=lambda c: abs(np.nan_to_num(c.row["error_px_p95"], nan=1e9) - middle))[:SHOWN]
    for name, chosen in (("worst", worst), ("typical", typical)):
        sheet = np.concatenate([_strip(case, *cases[0].still.image.shape[:2]) for case in chosen])
        with atomic_path(folder / f"{name}.png") as beside:
            good, png = cv2.imencode(".png", sheet)
            if not good:
                raise DataError(f"OpenCV could not write the picture {name}.png.")
            beside.write_bytes(png.tobytes())
    return ["worst", "typical"]


def _strip(case: Case, height: int, width: int) -> UInt8[np.ndarray, "h w 3"]:
    """Photo with the graph, and the probability, side by side, with a line of figures."""
    photo = drawn_grid(case.still.image, case.grid, case.still.node_pixels)
    paint = np.rint(255 * case.probability).astype(np.uint8)
    paint = cv2.applyColorMap(np.asarray(cv2.resize(paint, photo.shape[1::-1]), np.uint8), cv2.COLORMAP_INFERNO)
    row = case.row
    text = (
        f"image {row['image']}: {row['columns']} x {row['rows']} nodes, IoU {row['iou']:.3f}, recall "
        f"{row['node_recall']:.3f}, error {row['error_px_median']:.2f} / p95 {row['error_px_p95']:.2f} px, "
        f"clamp {row['clamp']} {row.get('failure', '')}"
    )
    both = np.concatenate([photo, paint], axis=1)
    both = np.asarray(cv2.resize(both, (2 * width, height), interpolation=cv2.INTER_AREA), np.uint8)
    cv2.rectangle(both, (0, 0), (both.shape[1], 30), (0, 0, 0), -1)
    cv2.putText(both, text, (10, 22), cv2.FONT_HERSHEY_SIMPLEX, 0.6, TRUE, 1, cv2.LINE_AA)
    return both
