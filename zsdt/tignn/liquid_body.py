"""A liquid in its vessel as the node form sees it: distances to the wall, wall nodes, and the graph of the moment."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any, no_type_check

import numba
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from zsdt.errors import DataError
from zsdt.fluid.vessel import Vessel
from zsdt.radius_graph import RadiusGraph
from zsdt.tignn.options import TignnOptions, Walls
from zsdt.trajectory import Body

_jit: Any = numba.njit(error_model="numpy", cache=True, nogil=True)

CORNERS = 4  # sweeps of the clamp: out of one wall may be into the next
WALL_SPACING = 0.9  # least distance of two wall nodes, in particle spacings


@dataclass(frozen=True)
class Links:
    """Edges within the radius, CSR sorted by receiver: offset [nodes + 1], neighbour and pair [directed], sign
    [directed] (+1 where the receiver is the pair's first node), pairs [pairs, 2], halves [pairs, 2] (rows of the
    directed list). nodes [nodes]: which of fluid particles and wall points they are; the fluid comes first."""

    offset: Int[np.ndarray, " rows"]
    neighbour: Int[np.ndarray, " directed"]
    pair: Int[np.ndarray, " directed"]
    sign: Float[np.ndarray, " directed"]
    pairs: Int[np.ndarray, "pairs 2"]
    halves: Int[np.ndarray, "pairs 2"]
    nodes: Int[np.ndarray, " nodes"]


@_jit
@no_type_check
def _cut(offset, neighbour, positions, fluids, radius, start, sender, rank, nodes, pair, sign, pairs, halves):
    """Edges no longer than `radius` of a list with skin, without those between two wall points and without wall points
    that touch no fluid; returns nodes, directed edges. Rows stay sorted, so halves are met in the order of pairs."""
    count, edges = 0, 0
    start[0] = 0
    for i in range(offset.size - 1):
        begin = edges
        for k in range(offset[i], offset[i + 1]):
            j = neighbour[k]
            if i >= fluids and j >= fluids:
                continue
            square = 0.0
            for d in range(3):
                square += (positions[i, d] - positions[j, d]) ** 2
            if square <= radius * radius:
                sender[edges] = j
                edges += 1
        rank[i] = -1
        if i < fluids or edges > begin:
            rank[i], nodes[count] = count, i
            count += 1
            start[count] = edges
    for k in range(edges):
        sender[k] = rank[sender[k]]
    found = 0
    for i in range(count):
        rank[i] = found
        for k in range(start[i], start[i + 1]):
            j = sender[k]
            if j > i:
                pairs[found, 0], pairs[found, 1] = i, j
                halves[found, 0], pair[k], sign[k] = k, found, 1.0
                found += 1
            else:
                pair[k], sign[k] = rank[j], -1.0
                halves[rank[j], 1] = k
                rank[j] += 1
    return count, edges


def wall_nodes(vessel: Vessel, spacing: float, top: float) -> Float[np.ndarray, "points 3"]:
    """Points on the wall of `vessel` below the height `top` [m], about `spacing` [m] apart (paper mode of walls)."""
    low, high = vessel.bounds()
    low, high = low - spacing, np.array([high[0] + spacing, high[1] + spacing, min(high[2], top)])
    axes = [np.arange(a, b + 0.5 * spacing, 0.5 * spacing) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    distance, normal = vessel.distance_and_normal(points)
    near = np.abs(distance) < 0.5 * spacing
    points = points[near] - distance[near, None] * normal[near]
    points = points[points[:, 2] <= top]
    tree, keep = cKDTree(points), np.ones(len(points), bool)
    for i, close in enumerate(tree.query_ball_point(points, WALL_SPACING * spacing)):
        if keep[i]:
            keep[[j for j in close if j > i]] = False
    return points[keep]


class LiquidBody:
    """What does not change while a liquid moves, and the graph that does.

    up [3]: against gravity; radius, skin [m] of the graph; wall_points [points, 3] m (none where walls are features);
    graph_milliseconds: wall time of the last `connect`.

    Raises: DataError where the body is no liquid in a vessel.
    """

    def __init__(self, body: Body, options: TignnOptions):
        if body.liquid is None or body.vessel is None:
            raise DataError("The node form of liquids needs a liquid and its vessel; this body is none.")
        self.body, self.liquid, self.vessel = body, body.liquid, Vessel(body.vessel)
        self.fluids, self.pitch, self.frame_dt = body.nodes, body.pitch, body.frame_dt
        self.mass = np.ascontiguousarray(body.mass.reshape(-1, 1))
        self.gravity = np.asarray(body.gravity, float)
        strength = float(np.linalg.norm(self.gravity))
        self.up = -self.gravity / strength if strength > 0 else np.array([0.0, 0.0, 1.0])
        chosen = options.liquid
        self.radius, self.skin = chosen.cutoff * body.pitch, chosen.skin * body.pitch
        self.clearance, self.relaxation = chosen.clamp * body.pitch, chosen.relaxation
        self.wall_points = np.zeros((0, 3))
        if chosen.walls is Walls.nodes:
            self.wall_points = wall_nodes(self.vessel, body.pitch, self.vessel.rim)
        self.search = RadiusGraph(self.radius, self.skin)
        self.graph_milliseconds = 0.0

    def connect(self, positions: Float[np.ndarray, "fluids 3"]) -> Links:
        """The graph of the moment. Raises: RunRejected where a position is not a number."""
        began = time.perf_counter()
        everything = np.concatenate([positions, self.wall_points])
        self.search.update(everything)
        offset, neighbour = self.search.offset, self.search.neighbour
        size, most = len(everything), len(neighbour)
        start, rank, nodes = (np.empty(size + 1, np.int64) for _ in range(3))
        sender, pair, sign = np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most)
        pairs, halves = (np.empty((most // 2 + 1, 2), np.int64) for _ in range(2))
        lists = (start, sender, rank, nodes, pair, sign, pairs, halves)
        count, edges = _cut(offset, neighbour, everything, self.fluids, self.radius, *lists)
        half = edges // 2
        self.graph_milliseconds = 1e3 * (time.perf_counter() - began)
        return Links(
            start[: count + 1], sender[:edges], pair[:edges], sign[:edges], pairs[:half], halves[:half], nodes[:count]
        )

    def keep_inside(
        self, positions: Float[np.ndarray, "fluids 3"], velocity: Float[np.ndarray, "fluids 3"]
    ) -> tuple[Float[np.ndarray, "fluids 3"], Float[np.ndarray, "fluids 3"], int]:
        """Positions at least the clearance away from the wall, velocities without the part into it, and how many had
        to be moved (DESIGN 4.2)."""
        count = 0
        for sweep in range(CORNERS):
            distance, normal = self.vessel.distance_and_normal(positions)
            close = distance < self.clearance * (1.0 - 1e-9)
            if not close.any():
                break
            positions, velocity, n = positions.copy(), velocity.copy(), normal[close]
            positions[close] += (self.clearance - distance[close])[:, None] * n
            into = np.minimum((velocity[close] * n).sum(1), 0.0)
            velocity[close] -= into[:, None] * n
            count = int(close.sum()) if sweep == 0 else count
        return positions, velocity, count

    def relax(self, positions: Float[np.ndarray, "fluids 3"]) -> Float[np.ndarray, "fluids 3"]:
        """Pushes apart particles nearer than 0.75 spacings, a little per sweep, their centre at rest: against the
        clustering of long rollouts; `relaxation` sweeps."""
        least = 0.75 * self.pitch
        for _ in range(self.relaxation):
            pairs = cKDTree(positions).query_pairs(least, output_type="ndarray")
            if not len(pairs):
                break
            pairs = pairs[np.lexsort(pairs.T[::-1])]
            arm = positions[pairs[:, 0]] - positions[pairs[:, 1]]
            length = np.linalg.norm(arm, axis=1, keepdims=True)
            push = 0.15 * (least - length) * arm / np.maximum(length, 1e-12)
            positions = positions.copy()
            np.add.at(positions, pairs[:, 0], push)
            np.add.at(positions, pairs[:, 1], -push)
        return positions

    @property
    def neighbours(self) -> float:
        """Particles that a full sphere of the graph's radius holds."""
        return 4.0 / 3.0 * math.pi * (self.radius / self.pitch) ** 3
