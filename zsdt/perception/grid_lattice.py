"""Crossings put into columns and rows: the lattice grows from crossing to crossing, with a local idea of both steps.

A site (i, j) counts steps to the right and steps up in the picture. Growing takes the best fitting crossing first
(Prim's order), links of the skeleton before jumps over missing paint; a site that is surrounded but empty is bridged.
"""

from __future__ import annotations

import heapq
from itertools import count

import numpy as np
from jaxtyping import Float
from scipy.interpolate import RBFInterpolator
from scipy.spatial import cKDTree

from zsdt.perception.grid_skeleton import Crossings

Site = tuple[int, int]
Lattice = Float[np.ndarray, "columns rows 2"]
STEPS: tuple[Site, ...] = ((1, 0), (-1, 0), (0, 1), (0, -1))
REACH = 0.3  # of a pitch: how far a crossing may lie from where it is expected
JUMP = 0.25  # price of a step without a link
STUB = 0.15  # price of a crossing with fewer than two links: often the end of a line that is partly missing
STRETCH = (0.6, 1.5)  # a step against the pitch
OUTLIER = 0.2  # of a pitch: how far a crossing may lie from what its neighbours say
ATTEMPTS = 40  # lattices that are grown, from the most regular crossings on
FULL = 0.5  # share of a column or row that must be there


def lattices(crossings: Crossings, pitch: float) -> list[Lattice]:
    """All grids of the given pitch [px] among the crossings, the one over the widest area first.

    Each is an array [columns, rows, 2] of pixels, columns to the right and rows upwards, NaN where no crossing is.
    """
    points = crossings.points
    if len(points) < 4:
        return []
    neighbours: list[set[int]] = [set() for _ in points]
    for a, b in crossings.links:
        neighbours[a].add(int(b))
        neighbours[b].add(int(a))
    free = np.ones(len(points), bool)
    tree = cKDTree(points)
    found: list[Lattice] = []
    grown = 0
    for seed in _seeds(points, neighbours, pitch):
        if not free[seed]:
            continue
        if grown == ATTEMPTS:
            break
        grown += 1
        sites = _Growth(points, tree, neighbours, free, pitch).run(seed)
        free[list(sites.values())] = False
        grid = _rectangle(_array(sites, points), pitch)
        if grid is not None:
            found.append(grid)
    return sorted(found, key=lambda g: -int(np.isfinite(g[..., 0]).sum()))


def _seeds(points: Float[np.ndarray, "points 2"], neighbours: list[set[int]], pitch: float) -> list[int]:
    """Points with two to four links of about a pitch, the most regular first."""

    def irregularity(k: int) -> float:
        vectors = points[sorted(neighbours[k])] - points[k]
        off = np.abs(np.log(np.linalg.norm(vectors, axis=1) / pitch))
        return float(off.mean()) + 0.3 * abs(4 - len(vectors))

    linked = [k for k in range(len(points)) if 2 <= len(neighbours[k]) <= 6]
    return sorted(linked, key=irregularity)


class _Growth:
    """One lattice while it grows."""

    def __init__(
        self,
        points: Float[np.ndarray, "points 2"],
        tree: cKDTree,
        neighbours: list[set[int]],
        free: np.ndarray,
        pitch: float,
    ):
        self.points, self.neighbours, self.pitch = points, neighbours, pitch
        self.free = free.copy()
        self.tree = tree
        self.sites: dict[Site, int] = {}
        self.bases: dict[Site, np.ndarray] = {}
        self.bridges: dict[Site, np.ndarray] = {}
        self.heap: list[tuple[float, int, Site, int, np.ndarray]] = []
        self.order = count()

    def run(self, seed: int) -> dict[Site, int]:
        """Point at each site of the lattice around `seed`."""
        self._push(0.0, (0, 0), seed, self._basis(seed))
        while True:
            before = len(self.sites)
            self._spread()
            if len(self.sites) == before or not self._bridge():
                return self.sites

    def _basis(self, seed: int) -> np.ndarray:
        """Step to the right and step up [2, 2] at the seed, from its links."""
        vectors = self.points[sorted(self.neighbours[seed])] - self.points[seed]
        flat = vectors[np.argmax(np.abs(vectors[:, 0]) / np.linalg.norm(vectors, axis=1))]
        right = flat * np.sign(flat[0] or 1.0)
        right = right * self.pitch / np.linalg.norm(right)
        up = np.array([right[1], -right[0]])
        along = vectors @ up / (np.linalg.norm(vectors, axis=1) * self.pitch)
        best = int(np.argmax(np.abs(along)))
        if abs(along[best]) > 0.8:
            up = vectors[best] * np.sign(along[best])
        return np.stack([right, up])

    def _push(self, price: float, site: Site, point: int, basis: np.ndarray) -> None:
        heapq.heappush(self.heap, (price, next(self.order), site, point, basis))

    def _spread(self) -> None:
        while self.heap:
            price, _, site, point, basis = heapq.heappop(self.heap)
            if site in self.sites or not self.free[point]:
                continue
            agreed = self._off(site, point)
            if agreed > REACH:
                continue
            if self.heap and price < agreed and agreed > self.heap[0][0]:
                self._push(agreed, site, point, basis)  # neighbours that came later make it less likely
                continue
            self.free[point] = False
            self.sites[site], self.bases[site] = point, basis
            self.bridges.pop(site, None)
            self._look_around(site, self.points[point], basis, self.neighbours[point], 0.0)

    def _off(self, site: Site, point: int) -> float:
        """How far [pitches] a point lies from where all neighbours of a site, taken together, expect it."""
        around = [(n, step) for step in STEPS if (n := (site[0] - step[0], site[1] - step[1])) in self.sites]
        if not around:
            return 0.0
        expected = np.mean([self.points[self.sites[n]] + np.array(step) @ self.bases[n] for n, step in around], axis=0)
        return float(np.linalg.norm(self.points[point] - expected)) / self.pitch

    def _look_around(self, site: Site, here: np.ndarray, basis: np.ndarray, linked: set[int], price: float) -> None:
        for step in STEPS:
            there = (site[0] + step[0], site[1] + step[1])
            if there in self.sites:
                continue
            expected = here + np.array(step) @ basis
            for point in self.tree.query_ball_point(expected, REACH * self.pitch):
                if self.free[point]:
                    off = float(np.linalg.norm(self.points[point] - expected)) / self.pitch
                    turned = self._turned(basis, step, self.points[point] - here)
                    if turned is not None:
                        loose = STUB if len(self.neighbours[point]) < 2 else 0.0
                        self._push(price + off + loose + (0.0 if point in linked else JUMP), there, point, turned)

    def _turned(self, basis: np.ndarray, step: Site, vector: np.ndarray) -> np.ndarray | None:
        """The basis one step on: half of the way to the step just made, the other axis turned with it."""
        axis = 0 if step[0] else 1
        old = basis[axis]
        new = 0.5 * (old + vector * (step[0] + step[1]))
        if not STRETCH[0] < np.linalg.norm(new) / self.pitch < STRETCH[1]:
            return None
        angle = np.arctan2(old[0] * new[1] - old[1] * new[0], old @ new)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        turned = basis @ turn.T
        turned[axis] = new
        return turned

    def _bridge(self) -> bool:
        """Expects a crossing at every empty site between occupied ones and looks on from there; False if in vain."""
        known = {**{s: self.points[p] for s, p in self.sites.items()}, **self.bridges}
        new: dict[Site, np.ndarray] = {}
        for site in {(i + a, j + b) for i, j in known for a, b in STEPS} - set(known):
            around = [(n, (-a, -b)) for a, b in STEPS if (n := (site[0] + a, site[1] + b)) in known]
            if len(around) >= 2:
                new[site] = np.mean([known[n] + np.array(step) @ self.bases[n] for n, step in around], axis=0)
                self.bases[site] = np.mean([self.bases[n] for n, _ in around], axis=0)
        for site, here in new.items():
            self.bridges[site] = here
            self._look_around(site, here, self.bases[site], set(), 0.5)
        return bool(new) and bool(self.heap)


def _array(sites: dict[Site, int], points: Float[np.ndarray, "points 2"]) -> Lattice:
    place = np.array(list(sites))
    low = place.min(axis=0)
    grid = np.full((*(place.max(axis=0) - low + 1), 2), np.nan)
    for site, point in sites.items():
        grid[site[0] - low[0], site[1] - low[1]] = points[point]
    return grid


def _rectangle(grid: Lattice, pitch: float) -> Float[np.ndarray, "_ _ 2"] | None:
    """The lattice without outliers and without ragged columns and rows at its sides; None where little is left."""
    grid = drop_outliers(grid, OUTLIER * pitch)
    while True:
        if min(grid.shape[:2]) < 2:
            return None
        here = np.isfinite(grid[..., 0])
        ends = {(0, 0): here[0], (0, -1): here[-1], (1, 0): here[:, 0], (1, -1): here[:, -1]}
        (axis, end), worst = min(ends.items(), key=lambda item: float(item[1].mean()))
        if worst.mean() >= FULL:
            return grid
        grid = np.delete(grid, end, axis=axis)


def surprise(grid: Lattice) -> Float[np.ndarray, "columns rows"]:
    """How far each node lies from the middle of its neighbours, where it has some on both sides [px].

    Otherwise two thirds of how far from the line through two neighbours, for extrapolation is less sure; zero where
    nothing is known.
    """
    padded = np.pad(grid, ((2, 2), (2, 2), (0, 0)), constant_values=np.nan)
    columns, rows = grid.shape[:2]

    def shifted(a: int, b: int) -> np.ndarray:
        return padded[2 + a : 2 + a + columns, 2 + b : 2 + b + rows]

    between = np.stack([(shifted(1, 0) + shifted(-1, 0)) / 2, (shifted(0, 1) + shifted(0, -1)) / 2])
    beyond = np.stack([2 * shifted(a, b) - shifted(2 * a, 2 * b) for a, b in STEPS])
    inner, outer = (_mean_of_known(part) for part in (between, beyond))
    off = np.linalg.norm(grid - np.where(np.isfinite(inner), inner, outer), axis=-1)
    return np.nan_to_num(np.where(np.isfinite(inner[..., 0]), off, off / 1.5))


def _mean_of_known(parts: Float[np.ndarray, "parts columns rows 2"]) -> Lattice:
    known = np.isfinite(parts)
    total = np.where(known, parts, 0.0).sum(axis=0)
    number = known.sum(axis=0)
    return np.where(number > 0, total / np.maximum(number, 1), np.nan)


def drop_outliers(grid: Lattice, limit: float) -> Lattice:
    """Takes out nodes that lie farther than `limit` [px] from what their neighbours say, the worst first."""
    grid = grid.copy()
    while True:
        off = surprise(grid)
        worst = np.unravel_index(off.argmax(), off.shape)
        if off[worst] <= limit:
            return grid
        grid[worst] = np.nan


def fill_holes(grid: Lattice) -> Lattice:
    """Missing nodes from a thin plate through the others."""
    here = np.isfinite(grid[..., 0])
    if here.all():
        return grid
    sites = np.moveaxis(np.indices(here.shape), 0, -1).astype(np.float64)
    plate = RBFInterpolator(sites[here], grid[here], kernel="thin_plate_spline")
    filled = grid.copy()
    filled[~here] = plate(sites[~here])
    return filled
