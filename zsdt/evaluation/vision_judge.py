"""One picture of which the truth is known against what vision saw in it."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from zsdt.errors import DataError
from zsdt.perception.camera import ClampSide
from zsdt.perception.grid_graph import ClampChoice, GridGraph, GridOptions, extract_grid
from zsdt.perception.segmentation import Segmenter
from zsdt.perception.vision_train import iou_of

NEAR = 0.25  # of the pitch: how far a node may lie from a true one to count as that one


@runtime_checkable
class JudgedStill(Protocol):
    """A picture with its truth, such as `zsdt.lab.stills.Still`."""

    @property
    def image(self) -> UInt8[np.ndarray, "h w 3"]:
        """BGR."""

    @property
    def grid_mask(self) -> UInt8[np.ndarray, "h w"]:
        """Cover of the grid lines, 0 to 255."""

    @property
    def node_pixels(self) -> Float[np.ndarray, "columns rows 2"]:
        """Exact pixels of the nodes, column 0 at the clamp, row 0 at the bottom."""

    @property
    def clamp_side(self) -> ClampSide:
        """Where the clamp is."""


@dataclass(frozen=True)
class Case:
    """What was seen in one picture: its row of the table, the grid (None where none was found), and the probability."""

    row: dict[str, Any]
    errors_px: Float[np.ndarray, " matched"]
    grid: GridGraph | None
    probability: Float[np.ndarray, "h w"]
    still: JudgedStill


def judge_still(segmenter: Segmenter, still: JudgedStill, number: int, options: GridOptions) -> Case:
    """One picture against its truth."""
    began, cpu_began = time.perf_counter(), time.process_time()
    probability = segmenter.probability(still.image)
    between, cpu_between = time.perf_counter(), time.process_time()
    row: dict[str, Any] = {"image": number}
    grid: GridGraph | None = None
    try:
        grid = extract_grid(probability, still.image, options)
        clamp = "right" if grid.clamp_side is still.clamp_side else "wrong"
    except DataError as error:
        clamp = "asked"
        told = replace(options, clamp_side=ClampChoice(still.clamp_side.value))
        try:
            grid = extract_grid(probability, still.image, told)
        except DataError:
            clamp = "-"
            row["failure"] = str(error)
    ended, cpu_ended = time.perf_counter(), time.process_time()
    errors = np.zeros(0)
    found = matched = 0
    if grid is not None:
        errors, found = match_nodes(grid.pixels, grid.found, still.node_pixels)
        matched = len(errors)
    true = still.node_pixels.shape[0] * still.node_pixels.shape[1]
    row |= {
        "columns": still.node_pixels.shape[0],
        "rows": still.node_pixels.shape[1],
        "iou": iou_of(probability, still.grid_mask),
        "iou_of_face": 0.0 if grid is None else iou_of(paint_of_face(probability, grid), still.grid_mask),
        "nodes_true": true,
        "nodes_found": found,
        "nodes_matched": matched,
        "node_precision": matched / found if found else 0.0,
        "node_recall": matched / true,
        "error_px_median": float(np.median(errors)) if matched else float("nan"),
        "error_px_p95": float(np.percentile(errors, 95)) if matched else float("nan"),
        "error_px_max": float(errors.max()) if matched else float("nan"),
        "in_order": grid is not None and in_order(grid, still.node_pixels),
        "clamp": clamp,
        "unet_ms": 1e3 * (between - began),
        "grid_ms": 1e3 * (ended - between),
        "unet_cpu_ms": 1e3 * (cpu_between - cpu_began),
        "grid_cpu_ms": 1e3 * (cpu_ended - cpu_between),
    }
    return Case(row, errors, grid, probability, still)


def paint_of_face(probability: Float[np.ndarray, "h w"], grid: GridGraph) -> Float[np.ndarray, "h w"]:
    """The paint that is left when only the face of the found grid counts, as it does for the twin."""
    inside = np.zeros(probability.shape, np.uint8)
    ring = np.rint(grid.outline * 16).astype(np.int32)
    cv2.fillPoly(inside, [ring], 1, cv2.LINE_8, 4)
    cv2.polylines(inside, [ring], True, 1, 5, cv2.LINE_8, 4)  # outlines may bulge a little between their nodes
    return np.where(inside > 0, probability, np.float32(0))


def pitch_of(nodes: Float[np.ndarray, "columns rows 2"]) -> float:
    """Median distance of neighbours [px]."""
    steps = [np.linalg.norm(np.diff(nodes, axis=axis), axis=-1).ravel() for axis in (0, 1)]
    return float(np.median(np.concatenate(steps)))


def match_nodes(
    pixels: Float[np.ndarray, "columns rows 2"],
    found: Bool[np.ndarray, "columns rows"],
    truth: Float[np.ndarray, "a b 2"],
) -> tuple[Float[np.ndarray, " matched"], int]:
    """Distances [px] of found nodes to the true ones that they stand for, and the number of found nodes.

    Pairs are one to one, of least total distance, and nearer than a quarter of the pitch. Nodes that were filled in
    count neither as found nor as matched.
    """
    seen, true = pixels[found], truth.reshape(-1, 2)
    limit = NEAR * pitch_of(truth)
    distance = cdist(seen, true)
    first, second = linear_sum_assignment(np.minimum(distance, 4 * limit))
    pairs = distance[first, second]
    return pairs[pairs < limit], len(seen)


def in_order(grid: GridGraph, truth: Float[np.ndarray, "columns rows 2"]) -> bool:
    """Whether the lattice has the true columns and rows and every found node is nearest to its own true one."""
    if grid.pixels.shape != truth.shape:
        return False
    number = np.arange(grid.found.size).reshape(grid.found.shape)[grid.found]
    nearest = cdist(grid.pixels[grid.found], truth.reshape(-1, 2)).argmin(axis=1)
    return bool((nearest == number).all())
