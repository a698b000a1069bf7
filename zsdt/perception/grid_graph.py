"""The painted grid in the first frame as a graph of columns and rows (seed: topology initialisation).

probability -> mask -> skeleton -> Shi-Tomasi corners and branch points -> links -> lattice -> line fits -> clamp side.
Everything is in pixels of the picture (u right, v down, centres at integers); lens and depth come later.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from zsdt.errors import DataError, OptionError
from zsdt.perception.camera import ClampSide
from zsdt.perception.clamp_side import find_clamp_side
from zsdt.perception.grid_lattice import Lattice, fill_holes, lattices
from zsdt.perception.grid_refine import Refined, centroids, refine
from zsdt.perception.grid_skeleton import Skeleton, branch_points, crossings, pitches, skeleton_of

log = logging.getLogger(__name__)

MOST_CROSSINGS = 1200  # that are looked at; a face of 1 m x 1 m has 441
CANDIDATES = 3  # lattices of one pitch that are looked at
PAINTED = 0.4  # share of its lines that must be painted for another column or row
BARE = 0.15  # share of its nodes that must be seen, or a column or row at a side is given up


class ClampChoice(StrEnum):
    """auto: the clamp is looked for in the picture. left, right: told."""

    auto = "auto"
    left = "left"
    right = "right"


@dataclass
class GridOptions:
    """threshold: probability from which a pixel is paint. clamp_side: where the beam is clamped. min_columns and
    min_rows: of nodes, below which no grid was found. max_spread: difference of two steps in line, relative to the
    pitch, above which the grid is not regular. min_found: share of the nodes that must be seen.
    """

    threshold: float = 0.5
    clamp_side: ClampChoice = ClampChoice.auto
    min_columns: int = 3
    min_rows: int = 2
    max_spread: float = 0.15
    min_found: float = 0.5

    def __post_init__(self) -> None:
        if not 0 < self.threshold < 1 or not 0 < self.min_found <= 1:
            raise OptionError("threshold must lie in (0, 1) and min_found in (0, 1].")
        if self.min_columns < 2 or self.min_rows < 2 or self.max_spread <= 0:
            raise OptionError("A grid needs at least 2 columns and 2 rows of nodes, and max_spread above 0.")


@dataclass(frozen=True)
class GridGraph:
    """Nodes of the grid in the picture.

    pixels [columns, rows, 2]: column 0 at the clamp, row 0 at the bottom. found: seen in the picture; the others were
    filled in from their neighbours. pitch_px: median distance of neighbours; pitch_spread: by how much one step
    differs from the next in line, relative to the pitch (90th percentile). linked: which of `edges` are painted.
    """

    pixels: Float[np.ndarray, "columns rows 2"]
    found: Bool[np.ndarray, "columns rows"]
    clamp_side: ClampSide
    pitch_px: float
    pitch_spread: float
    linked: Bool[np.ndarray, " edges"]

    @property
    def columns(self) -> int:
        """Nodes from the clamp to the tip."""
        return self.pixels.shape[0]

    @property
    def rows(self) -> int:
        """Nodes from the bottom to the top."""
        return self.pixels.shape[1]

    @property
    def edges(self) -> Int[np.ndarray, "edges 2"]:
        """Neighbours in the lattice; node (c, r) has the number c * rows + r."""
        number = np.arange(self.columns * self.rows).reshape(self.columns, self.rows)
        along = np.stack([number[:-1].ravel(), number[1:].ravel()], axis=1)
        across = np.stack([number[:, :-1].ravel(), number[:, 1:].ravel()], axis=1)
        return np.concatenate([along, across]).astype(np.int64)

    @property
    def outline(self) -> Float[np.ndarray, "corners 2"]:
        """Nodes around the face, once [px]."""
        p = self.pixels
        return np.concatenate([p[:-1, 0], p[-1, :-1], p[:0:-1, -1], p[0, :0:-1]])

    def sentence(self) -> str:
        """What was found, for a person."""
        return (
            f"Grid of {self.columns} x {self.rows} nodes, {int((~self.found).sum())} of them not seen but filled in; "
            f"pitch {self.pitch_px:.1f} px, regular to {100 * self.pitch_spread:.1f} %; "
            f"clamp at the {self.clamp_side.value}."
        )


def extract_grid(
    probability: Float[np.ndarray, "h w"],
    image: UInt8[np.ndarray, "h w 3"] | None = None,
    options: GridOptions | None = None,
) -> GridGraph:
    """Finds the painted grid in the probability of grid lines; the picture [BGR] helps to find the clamp.

    Of several grids the one with the longest painted lines wins. Raises: DataError where there is no regular grid,
    or where the clamp's side cannot be told.
    """
    options = options or GridOptions()
    skeleton = skeleton_of(probability, options.threshold)
    if skeleton is None:
        raise DataError(
            "No paint of a grid is seen in the picture. Check that the beam's painted face is in it, sharp and lit; "
            "if it is, train the segmentation on photos like this one (stage train_vision)."
        )
    grid, pitch = _largest(skeleton, options)
    refined = _grown(refine(grid, skeleton.probability, pitch, skeleton.width_px), skeleton, pitch)
    pixels = refined.pixels + skeleton.origin
    refined = replace(refined, found=refined.found & _inside(pixels, probability.shape))
    pitch, spread = _regularity(pixels, refined.found)
    _check(refined, pitch, spread, options)
    graph = _oriented(pixels, refined, ClampSide.left, pitch, spread)
    side = ClampSide.left
    if options.clamp_side is ClampChoice.auto:
        side = find_clamp_side(graph.pixels, graph.found, image)
    else:
        side = ClampSide(options.clamp_side.value)
    if side is ClampSide.right:
        graph = _oriented(pixels, refined, side, pitch, spread)
    log.info("%s", graph.sentence())
    return graph


def _largest(skeleton: Skeleton, options: GridOptions) -> tuple[Lattice, float]:
    """The lattice [px of the skeleton's cut-out] that explains most of the painted lines, and its pitch [px]."""
    branches = branch_points(skeleton)
    if len(branches) > MOST_CROSSINGS:
        raise DataError(
            f"Lines cross at {len(branches)} places of the picture: no grid of a beam, but a texture; train the "
            "segmentation on photos like this one (stage train_vision)."
        )
    best: tuple[float, Lattice, float] | None = None
    seen = 0
    for pitch in pitches(skeleton, branches):
        for grid in lattices(crossings(skeleton, branches, pitch), pitch)[:CANDIDATES]:
            seen = max(seen, int(np.isfinite(grid[..., 0]).sum()))
            if _large_enough(grid, options):
                length = _painted_length(grid, skeleton, pitch)
                if best is None or length > best[0]:
                    best = (length, grid, pitch)
    if best is None:
        raise DataError(
            f"The paint in the picture makes no grid of at least {options.min_columns} x {options.min_rows} nodes "
            f"(the largest regular patch has {seen}). Check that the painted face is seen whole and sharp."
        )
    return best[1], best[2]


def _painted_length(grid: Lattice, skeleton: Skeleton, pitch: float) -> float:
    """Length of the painted edges [px]: little for a lattice across the lines, or one that skips every second line."""
    whole = fill_holes(grid)
    edges = [centroids(whole, axis, skeleton.probability, pitch, skeleton.width_px).support for axis in (0, 1)]
    return float(sum((part**2).sum() for part in edges)) * pitch


def _large_enough(grid: Lattice, options: GridOptions) -> bool:
    """Whether a lattice has columns and rows enough; it may still lack an outline."""
    columns, rows = sorted(grid.shape[:2], reverse=True)
    return columns >= options.min_columns and rows >= min(options.min_rows, 2)


def _grown(refined: Refined, skeleton: Skeleton, pitch: float) -> Refined:
    """Adds columns and rows at the sides as far as paint is there, also behind one that is hidden; drops bare ones."""
    changed = True
    while changed:
        changed = False
        for axis in (0, 1):
            for end in (0, -1):
                trial = _side_added(refined, axis, end, skeleton, pitch)
                if trial is not None:
                    refined, changed = trial, True
    while min(refined.pixels.shape[:2]) > 2:
        bare = [(axis, end) for axis in (0, 1) for end in (0, -1) if np.take(refined.found, end, axis).mean() < BARE]
        if not bare:
            break
        axis, end = bare[0]
        refined = refine(np.delete(refined.pixels, end, axis=axis), skeleton.probability, pitch, skeleton.width_px)
    return refined


def _side_added(refined: Refined, axis: int, end: int, skeleton: Skeleton, pitch: float) -> Refined | None:
    """The lattice with one more column or row (two, if only the second is painted); None where there is none."""
    grid = np.moveaxis(refined.pixels, axis, 0)
    grid = grid if end == -1 else grid[::-1]
    step = grid[-1] - grid[-2]
    for extra in (1, 2):
        wider = np.concatenate([grid, grid[-1] + np.arange(1, extra + 1)[:, None, None] * step])
        last = wider[-2:]
        across = centroids(last, 1, skeleton.probability, pitch, skeleton.width_px).support[-1]
        along = centroids(last, 0, skeleton.probability, pitch, skeleton.width_px).support[0]
        if min(across.mean(), along.mean()) > PAINTED:
            whole = np.moveaxis(wider if end == -1 else wider[::-1], 0, axis)
            trial = refine(np.ascontiguousarray(whole), skeleton.probability, pitch, skeleton.width_px)
            if np.take(trial.found, end, axis).mean() > BARE:
                return trial
    return None


def _inside(pixels: Lattice, shape: tuple[int, ...]) -> Bool[np.ndarray, "columns rows"]:
    """Where a node lies in the picture."""
    u, v = pixels[..., 0], pixels[..., 1]
    return (u > -0.5) & (u < shape[1] - 0.5) & (v > -0.5) & (v < shape[0] - 0.5)


def _regularity(pixels: Lattice, found: Bool[np.ndarray, "columns rows"]) -> tuple[float, float]:
    """Median distance of neighbours that were seen [px], and by how much one step differs from the next.

    The latter is the 90th percentile of the difference of two steps in line, relative to the pitch: bending and
    perspective change the steps little by little, clutter does it at once.
    """
    seen = np.where(found[..., None], pixels, np.nan)
    steps = [np.linalg.norm(np.diff(seen, axis=axis), axis=-1) for axis in (0, 1)]
    changes = np.concatenate([np.abs(np.diff(step, axis=axis)).ravel() for axis, step in enumerate(steps)])
    distance = np.concatenate([step.ravel() for step in steps])
    distance, changes = distance[np.isfinite(distance)], changes[np.isfinite(changes)]
    if not len(distance) or not len(changes):
        return float("nan"), float("inf")
    pitch = float(np.median(distance))
    return pitch, float(np.percentile(changes, 90)) / pitch


def _check(refined: Refined, pitch: float, spread: float, options: GridOptions) -> None:
    """Raises: DataError where the grid is too small, too bare or not regular."""
    columns, rows = refined.found.shape
    if max(columns, rows) < options.min_columns or min(columns, rows) < options.min_rows:
        raise DataError(
            f"The largest grid in the picture has {columns} x {rows} nodes; at least {options.min_columns} x "
            f"{options.min_rows} are needed. Check that the painted face is seen whole and sharp."
        )
    if refined.found.mean() < options.min_found:
        raise DataError(
            f"Only {refined.found.sum()} of {refined.found.size} nodes of the grid are seen; clear the view of the "
            "painted face, or lower min_found."
        )
    if not spread <= options.max_spread:
        raise DataError(
            f"The grid's spacing of {pitch:.1f} px jumps by {100 * spread:.0f} % from node to node, so it is not the "
            "regular grid of a beam's face; look at it more squarely, or raise max_spread."
        )


def _oriented(pixels: Lattice, refined: Refined, side: ClampSide, pitch: float, spread: float) -> GridGraph:
    """Columns along the flatter axis of the lattice from the clamp on, rows upwards."""
    right, up = refined.right, refined.up
    found = refined.found
    run = [np.abs(np.diff(pixels, axis=axis).mean(axis=(0, 1))) for axis in (0, 1)]
    if run[0][1] * run[1][0] > run[0][0] * run[1][1]:  # the lattice was labelled on a steep part of the beam
        pixels, found = pixels.swapaxes(0, 1), found.T
        right, up = up.T, right.T
    leftwards = (pixels[-1] - pixels[0]).mean(axis=0)[0] < 0
    if leftwards != (side is ClampSide.right):
        pixels, found, right, up = pixels[::-1], found[::-1], right[::-1], up[::-1]
    if (pixels[:, -1] - pixels[:, 0]).mean(axis=0)[1] > 0:
        pixels, found, right, up = pixels[:, ::-1], found[:, ::-1], right[:, ::-1], up[:, ::-1]
    linked = np.concatenate([right.ravel(), up.ravel()]) > 0.5
    return GridGraph(np.ascontiguousarray(pixels), np.ascontiguousarray(found), side, pitch, spread, linked)
