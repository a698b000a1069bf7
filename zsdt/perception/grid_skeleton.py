"""From the probability of grid lines to crossings and to which of them the painted lines connect.

The seed's way: mask, skeleton, Shi-Tomasi corners, edges by skeletal connectivity. Branch points of the skeleton join
the corners, because each finds what the other one misses (a corner sees the L at the end of the face, a branch
point the faint crossing). All lengths are pixels of the picture.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks
from scipy.spatial import cKDTree
from skimage.morphology import skeletonize

NEIGHBOURS = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.uint8)
PORE = 4.0  # squares of the width of a line, below which a hole is none of the grid's cells
WIDEST = 0.1  # of the picture: wider paint is an area, no line
SPECK = 40  # px of paint below which a component is noise
BIN = 0.02  # of the logarithm of a distance, where pitches are counted
GROUPS = 3  # grids that may be in one picture
SECOND = 0.5  # height of a second pitch against the commonest one


@dataclass(frozen=True)
class Skeleton:
    """Centre lines of the painted mask.

    mask and lines [h, w], width_px: mean width of the lines, origin (u, v): where the cut-out lies in the picture.
    """

    probability: Float[np.ndarray, "h w"]
    mask: Bool[np.ndarray, "h w"]
    lines: Bool[np.ndarray, "h w"]
    width_px: float
    origin: Int[np.ndarray, "2"]


@dataclass(frozen=True)
class Crossings:
    """Where lines cross or end in a corner.

    points [n, 2] px, links [m, 2]: pairs of points that a painted line connects.
    """

    points: Float[np.ndarray, "points 2"]
    links: Int[np.ndarray, "links 2"]


def skeleton_of(probability: Float[np.ndarray, "h w"], threshold: float) -> Skeleton | None:
    """Mask above `threshold` without specks, thinned to lines of one pixel; None where no lines are painted."""
    mask = cv2.morphologyEx((probability > threshold).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    _, label, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    mask = (stats[:, cv2.CC_STAT_AREA] >= SPECK)[label] & (mask > 0)
    columns, rows = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
    if not len(columns):
        return None
    box = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]  # thinning the rest would only take time
    cut = _without_pores(np.pad(mask[box], 1))
    lines = skeletonize(cut)
    width = float(cut.sum() / max(1, lines.sum()))
    if width > WIDEST * min(probability.shape):
        return None
    return Skeleton(
        probability=np.pad(probability[box], 1).astype(np.float32),
        mask=cut,
        lines=_without_spurs(lines, round(width)),
        width_px=width,
        origin=np.array([columns[0] - 1, rows[0] - 1], np.int64),
    )


def _without_pores(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Fills holes that are small against the width of the lines; each would make a loop in the skeleton."""
    inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 3)[mask]
    width = 4.0 * float(inside.mean())  # pixels of a strip are a quarter of its width from its sides, on average
    _, label, stats, _ = cv2.connectedComponentsWithStats((~mask).astype(np.uint8), connectivity=4)
    return mask | (stats[:, cv2.CC_STAT_AREA] < PORE * width**2)[label]


def _without_spurs(lines: Bool[np.ndarray, "h w"], length: int) -> Bool[np.ndarray, "h w"]:
    """Takes `length` pixels from every free end: spurs of ragged paint vanish, lines only become a little shorter."""
    thin = lines.astype(np.uint8)
    for _ in range(length):
        neighbours = cv2.filter2D(thin, -1, NEIGHBOURS, borderType=cv2.BORDER_CONSTANT)
        thin[neighbours <= 1] = 0
    return skeletonize(thin > 0)  # the feet of the spurs


def branch_points(skeleton: Skeleton) -> Float[np.ndarray, "points 2"]:
    """Where three or more lines of the skeleton meet [px]; a crossing that thinning splits in two counts once."""
    lines = skeleton.lines.astype(np.uint8)
    meeting = (lines > 0) & (cv2.filter2D(lines, -1, NEIGHBOURS, borderType=cv2.BORDER_CONSTANT) >= 3)
    joined = cv2.dilate(meeting.astype(np.uint8), _disc(0.6 * skeleton.width_px + 1))
    _, label = cv2.connectedComponents(joined, connectivity=8)
    rows, columns = np.nonzero(meeting)
    if not len(rows):
        return np.zeros((0, 2))
    group = label[rows, columns]
    count = np.bincount(group).astype(np.float64)
    used = count > 0
    return np.stack([np.bincount(group, columns)[used], np.bincount(group, rows)[used]], axis=1) / count[used, None]


def pitches(skeleton: Skeleton, points: Float[np.ndarray, "points 2"]) -> list[float]:
    """Distances between neighbouring crossings [px], one for each grid in the picture, that of the most paint first.

    Connected paint makes a grid; in each the commonest distances from a crossing to its four nearest others count.
    """
    reach = cv2.dilate(skeleton.mask.astype(np.uint8), _disc(1.5 * skeleton.width_px + 2))
    count, label = cv2.connectedComponents(reach, connectivity=8)
    whose = label[points[:, 1].astype(int), points[:, 0].astype(int)] if len(points) else np.zeros(0, int)
    paint = np.bincount(label[skeleton.lines], minlength=count)
    found: list[float] = []
    for group in sorted(range(1, count), key=lambda g: -int(paint[g]))[:GROUPS]:
        for pitch in _commonest_distances(points[whose == group], 2.0 * skeleton.width_px):
            if all(abs(np.log(pitch / known)) > 0.15 for known in found):
                found.append(pitch)
    # Paint in pieces: perhaps no piece has crossings enough, but all of them together do.
    return found or _commonest_distances(points, 2.0 * skeleton.width_px)


def _commonest_distances(points: Float[np.ndarray, "points 2"], least: float) -> list[float]:
    """Peaks of the distances [px] to the four nearest points that are farther than `least`, the highest first."""
    if len(points) < 4:
        return []
    distance = np.asarray(cKDTree(points).query(points, k=min(7, len(points)))[0])
    distance = np.where(distance < least, np.inf, distance)
    near = np.sort(distance, axis=1)[:, :4]
    near = near[np.isfinite(near)]
    if not len(near):
        return []
    place = np.log(near)
    edges = np.arange(place.min() - 0.5, place.max() + 0.5, BIN)
    counts = gaussian_filter1d(np.histogram(place, edges)[0].astype(np.float64), 0.06 / BIN)
    peaks, _ = find_peaks(counts, height=SECOND * counts.max(), distance=round(0.2 / BIN))
    highest = sorted(peaks, key=lambda k: -float(counts[k]))[:2]
    return [float(np.exp(np.median(place[np.abs(place - edges[k] - BIN / 2) < 0.12]))) for k in highest]


def crossings(skeleton: Skeleton, branches: Float[np.ndarray, "points 2"], pitch: float) -> Crossings:
    """Shi-Tomasi corners on the lines, at least half a pitch apart, branch points that they miss, and all links."""
    paint = cv2.GaussianBlur(
        np.where(skeleton.mask, skeleton.probability, np.float32(0)), (0, 0), max(1.0, 0.06 * pitch)
    )
    near = cv2.dilate(skeleton.lines.astype(np.uint8), np.ones((5, 5), np.uint8))
    # OpenCV's stubs do not know that a picture of floats is fine here.
    corners = cv2.goodFeaturesToTrack(paint, 1500, 0.05, 0.5 * pitch, mask=near, blockSize=int(max(5, 0.3 * pitch)) | 1)
    points = np.zeros((0, 2)) if corners is None else corners.reshape(-1, 2).astype(np.float64)
    if len(branches):
        missed = branches
        if len(points):
            missed = branches[cKDTree(points).query(branches)[0] > 0.35 * pitch]
        points = _merge(np.concatenate([points, missed]), 0.35 * pitch)
    return Crossings(points, _links(skeleton.lines, points, pitch))


def _merge(points: Float[np.ndarray, "points 2"], radius: float) -> Float[np.ndarray, "kept 2"]:
    """Drops every point that has one before it within `radius`."""
    kept = np.ones(len(points), bool)
    for first, second in sorted(cKDTree(points).query_pairs(radius)):
        if kept[first]:
            kept[second] = False
    return points[kept]


def _links(
    lines: Bool[np.ndarray, "h w"], points: Float[np.ndarray, "points 2"], pitch: float
) -> Int[np.ndarray, "links 2"]:
    """Pairs of points between which the skeleton runs (seed: skeletal connectivity).

    Discs around the points are cut out of the skeleton; a remaining piece that touches exactly two discs is a link.
    """
    if not len(points):
        return np.zeros((0, 2), np.int64)
    owner = np.zeros(lines.shape, np.float32)  # number of the point + 1; cv2 dilates no int32
    radius = max(3, round(0.28 * pitch))
    for number, (u, v) in enumerate(np.rint(points).astype(int), start=1):
        cv2.circle(owner, (int(u), int(v)), radius, float(number), -1)
    rest = (lines & (owner == 0)).astype(np.uint8)
    _, piece = cv2.connectedComponents(rest, connectivity=8)
    touched = cv2.dilate(owner, np.ones((3, 3), np.uint8)).astype(np.int64)
    rows, columns = np.nonzero((rest > 0) & (touched > 0))
    contacts = np.unique(np.stack([piece[rows, columns], touched[rows, columns] - 1], axis=1), axis=0)
    _, first, count = np.unique(contacts[:, 0], return_index=True, return_counts=True)
    pair = first[count == 2]
    links = np.stack([contacts[pair, 1], contacts[pair + 1, 1]], axis=1) if len(pair) else np.zeros((0, 2), np.int64)
    return np.unique(np.sort(links, axis=1), axis=0)


def _disc(radius: float) -> UInt8[np.ndarray, "size size"]:
    size = 2 * round(radius) + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), np.uint8)
