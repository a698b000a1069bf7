"""Radius graph of particles: who lies within a radius of whom, by a compiled cell list with a Verlet skin.

Particles are sorted into cubic cells of half the reach (counting sort), every particle looks through the runs of
cells around its own, and the lists are transposed, which leaves the neighbours of every receiver in ascending order:
the result depends on the positions alone. The list is made for radius + skin and stays valid until somebody has moved
by more than half the skin, so that most frames of a calm liquid build nothing.
"""

from __future__ import annotations

import time
from typing import Any, no_type_check

import numba
import numpy as np
from jaxtyping import Float, Int

from zsdt.errors import OptionError, RunRejected
from zsdt.graph import Graph

_jit: Any = numba.njit(error_model="numpy", cache=True, nogil=True)

_DIVISIONS = 2  # cells along one reach
_CELLS_PER_PARTICLE, _SPARE_CELLS = 8, 512


def workspace(particles: int) -> tuple[np.ndarray, np.ndarray]:
    """Scratch arrays that `fill_neighbours` needs for `particles` particles: integers and floats."""
    return np.empty((2 + _CELLS_PER_PARTICLE) * particles + _SPARE_CELLS + 1, np.int32), np.empty((particles, 3))


@_jit
@no_type_check
def _sort_into_cells(positions, reach, low, counts, cell, order, start, packed):
    """Counting sort of particles by cell (z fastest); sets low [3] and counts [3], says whether all is finite."""
    n = positions.shape[0]
    side = reach / _DIVISIONS * (1.0 + 1e-9)
    extent = np.empty(3)
    for d in range(3):
        lowest, highest = positions[0, d], positions[0, d]
        for i in range(n):
            x = positions[i, d]
            if not np.isfinite(x):
                return -1.0
            lowest, highest = min(lowest, x), max(highest, x)
        low[d], extent[d] = lowest, highest - lowest
    while (extent[0] / side + 1) * (extent[1] / side + 1) * (extent[2] / side + 1) > start.size - 1:
        side *= 1.25  # a far stray must not cost memory: coarser cells are slower, never wrong
        if not np.isfinite(side):
            return -1.0
    for d in range(3):
        counts[d] = int(extent[d] / side) + 1
    total = counts[0] * counts[1] * counts[2]
    start[: total + 1] = 0
    for i in range(n):
        a = int((positions[i, 0] - low[0]) / side)
        b = int((positions[i, 1] - low[1]) / side)
        c = int((positions[i, 2] - low[2]) / side)
        cell[i] = (a * counts[1] + b) * counts[2] + c
        start[cell[i] + 1] += 1
    for k in range(total):
        start[k + 1] += start[k]
    for i in range(n - 1, -1, -1):  # counts down to the start of the cell, so that the order inside it is kept
        start[cell[i] + 1] -= 1
        order[start[cell[i] + 1]] = i
    for k in range(total):
        start[k] = start[k + 1]
    start[total] = n
    for k in range(n):
        for d in range(3):
            packed[k, d] = positions[order[k], d]
    return side


@_jit
@no_type_check
def fill_neighbours(positions, reach, integers, floats, offset, found, neighbour):
    """Neighbours of every particle nearer than `reach`, itself left out, as CSR sorted by receiver and neighbour.

    positions [n, 3] float64; integers, floats: of `workspace(n)`; offset [n + 1], found and neighbour (scratch and
    result, of one size) int32 are written. Returns the number of entries (both directions); unless it is smaller than
    that size nothing is complete: give larger arrays and call again. Returns -1 if a position is not finite.
    Allocates nothing to speak of.
    """
    n, capacity = positions.shape[0], found.size - 1
    offset[0] = 0
    if n == 0:
        return 0
    cell, order, start = integers[:n], integers[n : 2 * n], integers[2 * n :]
    low, counts = np.empty(3), np.empty(3, np.int64)
    side = _sort_into_cells(positions, reach, low, counts, cell, order, start, floats)
    if side < 0:
        return -1
    total, limit = 0, reach * reach
    for i in range(n):
        x, y, z = positions[i, 0], positions[i, 1], positions[i, 2]
        a, b, c = cell[i] // (counts[1] * counts[2]), cell[i] // counts[2] % counts[1], cell[i] % counts[2]
        first, last = max(c - _DIVISIONS, 0), min(c + _DIVISIONS, counts[2] - 1)
        for p in range(max(a - _DIVISIONS, 0), min(a + _DIVISIONS, counts[0] - 1) + 1):
            for q in range(max(b - _DIVISIONS, 0), min(b + _DIVISIONS, counts[1] - 1) + 1):
                row = (p * counts[1] + q) * counts[2]
                for k in range(start[row + first], start[row + last + 1]):
                    dx, dy, dz = floats[k, 0] - x, floats[k, 1] - y, floats[k, 2] - z
                    found[min(total, capacity)] = order[k]  # kept only if counted: no branch to mispredict
                    total += dx * dx + dy * dy + dz * dz <= limit and order[k] != i
        offset[i + 1] = total
    if total <= capacity:
        cursor = cell
        cursor[:] = offset[:n]
        for j in range(n):  # the list is symmetric: handing j out in ascending order sorts every row
            for k in range(offset[j], offset[j + 1]):
                i = found[k]
                neighbour[cursor[i]] = j
                cursor[i] += 1
    return total


@_jit
@no_type_check
def _moved(positions, since):
    """Largest squared distance [m2] of a particle from where it was; NaN counts as infinitely far."""
    farthest = 0.0
    for i in range(positions.shape[0]):
        square = 0.0
        for d in range(3):
            square += (positions[i, d] - since[i, d]) ** 2
        if not square <= farthest:
            farthest = square if square == square else np.inf
    return farthest


@_jit
@no_type_check
def _number_pairs(offset, neighbour, pairs, pair, sign):
    """Numbers each undirected edge (i < j, in the order of the list) and says which one every entry is."""
    n = offset.size - 1
    first, count = np.zeros(n, np.int64), 0
    for i in range(n):
        first[i] = count
        for k in range(offset[i], offset[i + 1]):
            j = neighbour[k]
            if j > i:
                pairs[count, 0], pairs[count, 1] = i, j
                pair[k], sign[k] = count, 1.0
                count += 1
            else:  # receivers come in ascending order, so row j's upper edges are met in the order of their numbers
                pair[k], sign[k] = first[j], -1.0
                first[j] += 1


class RadiusGraph:
    """Neighbour list within `radius` + `skin` [m] that is made anew only when somebody has moved by skin / 2.

    After `update`: offset [n + 1], neighbour [2 pairs] int32, symmetric, sorted by receiver and by neighbour. Every
    pair within `radius` is in it; those between radius and radius + skin are too, and whoever reads it gives them no
    weight. `builds` and `updates` count for the report, `seconds` is the wall time that `update` took. The arrays are
    views of buffers that the next build overwrites.

    Raises: OptionError where the radius is not positive or the skin negative.
    """

    def __init__(self, radius: float, skin: float = 0.0):
        if not radius > 0 or not skin >= 0:
            raise OptionError(f"A radius graph needs a radius > 0 and a skin >= 0, not {radius} and {skin}.")
        self.radius, self.skin = radius, skin
        self.builds = self.updates = 0
        self.seconds = 0.0
        self._since = np.empty((0, 3))
        self._graph: Graph | None = None
        self._buffers(0, 0)

    def _buffers(self, particles: int, entries: int) -> None:
        self._work = workspace(particles)
        self.offset = np.zeros(particles + 1, np.int32)
        self._found, self._neighbour = (np.empty(entries + 1, np.int32) for _ in range(2))
        self.neighbour: Int[np.ndarray, " directed"] = self._neighbour

    def update(self, positions: Float[np.ndarray, "particles 3"]) -> bool:
        """Makes the list fit `positions` [m]; True if it had to be built.

        Raises: RunRejected("not_finite") where a position is not a finite number.
        """
        began = time.perf_counter()
        built = self._update(np.ascontiguousarray(positions, np.float64))
        self.seconds += time.perf_counter() - began
        return built

    def _update(self, positions: Float[np.ndarray, "particles 3"]) -> bool:
        self.updates += 1
        same = self.builds > 0 and positions.shape == self._since.shape
        if same and _moved(positions, self._since) <= (0.5 * self.skin) ** 2:
            return False
        if positions.shape != self._since.shape:
            self._buffers(len(positions), 48 * len(positions))
            self._since = np.full(positions.shape, np.inf)  # until a build succeeds, everybody has moved
        self._build(positions)
        return True

    def _build(self, positions: Float[np.ndarray, "particles 3"]) -> None:
        reach = self.radius + self.skin
        while True:
            work = (*self._work, self.offset, self._found, self._neighbour)
            entries = fill_neighbours(positions, reach, *work)
            if entries < 0:
                raise RunRejected("not_finite", "A particle's position is not a finite number: the motion blew up.")
            if entries < self._found.size:
                break
            self._found, self._neighbour = (np.empty(int(1.2 * entries) + 1, np.int32) for _ in range(2))
        self.neighbour, self._graph = self._neighbour[:entries], None
        self._since[:] = positions
        self.builds += 1

    @property
    def graph(self) -> Graph:
        """The list as a `Graph` of one body (pairs numbered, own arrays); made once per build, when asked for."""
        if self._graph is None:
            entries, nodes = len(self.neighbour), len(self.offset) - 1
            pairs, pair = np.empty((entries // 2, 2), np.int64), np.empty(entries, np.int64)
            sign = np.empty(entries)
            _number_pairs(self.offset, self.neighbour, pairs, pair, sign)
            self._graph = Graph(
                pairs=pairs,
                offset=self.offset.astype(np.int64),
                neighbour=self.neighbour.astype(np.int64),
                pair=pair,
                sign=sign,
                member=np.zeros(nodes, np.int64),
            )
        return self._graph

    @property
    def pairs(self) -> Int[np.ndarray, "pairs 2"]:
        """The undirected edges, lower particle first."""
        return self.graph.pairs

    @property
    def reused(self) -> float:
        """Share of updates that could keep the list."""
        return 1.0 - self.builds / self.updates if self.updates else 0.0


def radius_graph(positions: Float[np.ndarray, "particles 3"], radius: float) -> Graph:
    """Graph of the particles at `positions` [m] with an edge wherever two are within `radius` [m].

    Raises: OptionError, RunRejected as `RadiusGraph` does.
    """
    built = RadiusGraph(radius)
    built.update(positions)
    return built.graph


def radius_pairs(positions: Float[np.ndarray, "particles 3"], radius: float) -> Int[np.ndarray, "pairs 2"]:
    """Undirected pairs (i < j, sorted) of particles at `positions` [m] within `radius` [m] of each other."""
    return radius_graph(positions, radius).pairs
