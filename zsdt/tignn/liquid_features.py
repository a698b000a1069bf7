"""What the network sees of a liquid: numbers that do not change when the glass is turned about gravity or mirrored.

Inside the network there are scalars only (lengths, inner products, sums over the neighbourhood as SPH makes them);
the vectors that they come from wait in `basis` and along the edges for the decoder, which combines them with decoded
scalars. So predictions turn with the liquid, and no augmentation is needed (DESIGN 4.2). Nothing depends on where
the vessel stands. Large values are compressed by asinh: a stop begins ten times faster than it ends.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, no_type_check

import numba
import numpy as np
import torch
from jaxtyping import Float

from zsdt.graph import Graph
from zsdt.tignn.liquid_body import Links, LiquidBody
from zsdt.tignn.wiring import Wiring, merge_wirings

_jit: Any = numba.njit(error_model="numpy", cache=True, nogil=True)

EDGE_FEATURES = 9
EVEN_FEATURES = 5  # of those, the first ones are the same from both ends of an edge; the others change sign
NODE_FEATURES = 32
BASIS = 8
NEAR_WALL = 2.0  # particle spacings within which a wall is felt


@dataclass(frozen=True)
class LiquidState:
    """What changes: position [fluids, 3] m, velocity [fluids, 3] m/s, energy [fluids, 1] J/kg, float64 numpy arrays."""

    position: Float[np.ndarray, "fluids 3"]
    velocity: Float[np.ndarray, "fluids 3"]
    energy: Float[np.ndarray, "fluids 1"]


@dataclass
class LiquidScales:
    """Root mean squares over the training set: velocity [m/s], energy [J/kg], their increments per frame (d_...);
    frame_dt [s] and viscosity [m2/s, kinematic] of the training set."""

    velocity: float = 1.0
    energy: float = 1.0
    d_velocity: float = 1.0
    d_energy: float = 1.0
    frame_dt: float = 1.0
    viscosity: float = 1.0


@dataclass(frozen=True)
class LiquidBatch(Wiring):
    """One moment of one liquid, or of several side by side; velocities in scales of increments unless said otherwise.

    node [nodes, NODE_FEATURES], edge [directed, EDGE_FEATURES]: what the network sees. basis [nodes, BASIS, 3]:
    vectors that a node may move along. arm [directed, 3]: from sender to receiver over the radius; rate [directed, 3]:
    velocity of the receiver from the sender's, in velocity scales. fluid, near [nodes, 1]: 1 for a particle (0 for a
    wall point), 1 where a wall is near. velocity [nodes, 3]; energy [nodes, 1] J/kg; gravity, load [nodes, 3]:
    increments of a frame by gravity and by the load's acceleration. weight, dt [nodes, 1]: mass over the mean mass of
    the body, frame [s]. wall [nodes, 3]: unit normal where a wall is near, else 0; missing [nodes, 1]: neighbours that
    the wall takes away, weighed with the normal (see `wall_share`).
    """

    node: torch.Tensor
    edge: torch.Tensor
    basis: torch.Tensor
    arm: torch.Tensor
    rate: torch.Tensor
    fluid: torch.Tensor
    near: torch.Tensor
    velocity: torch.Tensor
    energy: torch.Tensor
    gravity: torch.Tensor
    load: torch.Tensor
    weight: torch.Tensor
    dt: torch.Tensor
    wall: torch.Tensor
    missing: torch.Tensor


def merge_liquids(batches: list[LiquidBatch]) -> LiquidBatch:
    """Several liquids side by side."""
    if len(batches) == 1:
        return batches[0]
    names = [f.name for f in fields(LiquidBatch) if f.name not in {g.name for g in fields(Wiring)}]
    joined: dict[str, Any] = {name: torch.cat([getattr(b, name) for b in batches]) for name in names}
    return LiquidBatch(**vars(merge_wirings(list(batches))), **joined)


@_jit
@no_type_check
def _look(offset, neighbour, x, v, wall, up, push, radius, v_scale, edge, arm, rate, sums):
    """Edge features from the receiver's side, vectors along edges, and sums over neighbours.

    sums [nodes, 10]: density, divergence, dissipation, gradient of the indicator (3), viscous Laplacian (3), and the
    sum of 1 - distance / radius.
    """
    r, w, mean = np.empty(3), np.empty(3), np.empty(3)
    for i in range(offset.size - 1):
        for k in range(offset[i], offset[i + 1]):
            j = neighbour[k]
            square, speed = 0.0, 0.0
            for d in range(3):
                r[d] = (x[i, d] - x[j, d]) / radius
                w[d] = (v[i, d] - v[j, d]) / v_scale
                mean[d] = (v[i, d] + v[j, d]) / v_scale
                square += r[d] * r[d]
                speed += w[d] * w[d]
                arm[k, d], rate[k, d] = r[d], w[d]
            length = np.sqrt(square) + 1e-12
            near = max(1.0 - length, 0.0)
            along, drift, rise, toward, apart, pushed = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for d in range(3):
                along += r[d] * w[d]
                drift += r[d] * mean[d]
                rise += r[d] * up[d]
                toward += r[d] * (wall[i, d] + wall[j, d])
                apart += r[d] * (wall[i, d] - wall[j, d])
                pushed += r[d] * push[i, d]
            edge[k, 0], edge[k, 1] = 2.0 * length - 1.0, 3.0 * near * near
            edge[k, 2], edge[k, 3] = np.arcsinh(3.0 * along), np.arcsinh(2.0 * np.sqrt(speed))
            edge[k, 4] = 2.0 * apart
            edge[k, 5], edge[k, 6], edge[k, 7] = np.arcsinh(drift), 2.0 * rise, toward
            edge[k, 8] = np.arcsinh(pushed)
            slope = near * near * near  # of a Wendland kernel over its distance, up to a constant
            sums[i, 0] += slope * near * (4.0 * length + 1.0)
            sums[i, 1] += slope * along
            sums[i, 2] += slope * speed
            sums[i, 9] += near
            for d in range(3):
                sums[i, 3 + d] += slope * r[d]
                sums[i, 6 + d] += slope * w[d]


def wall_share(distance: Float[np.ndarray, "*fluids"], cutoff: float) -> Float[np.ndarray, "*fluids"]:
    """Sum of (1 - r/c) r/|r| over the particles that a flat wall at `distance` takes away, one per unit volume.

    `pi (c^3/12 - c d^2/2 + 2 d^3/3 - d^4/(4c))` for 0 <= d <= c, along the normal; lengths in spacings.
    """
    d = np.clip(distance, 0.0, cutoff)
    share = np.pi * (cutoff**3 / 12 - cutoff * d**2 / 2 + 2 * d**3 / 3 - d**4 / (4 * cutoff))
    return np.maximum(share, 0.0)  # rounding at the cutoff


def filled_by_wall(distance: Float[np.ndarray, "*fluids"], cutoff: float) -> Float[np.ndarray, "*fluids"]:
    """Sum of 1 - r/c over the particles that a flat wall at `distance` takes away, over that of a full sphere.

    `2 pi (c^3/12 - d c^2/6 + d^3/6 - d^4/(12c))` over `pi c^3 / 3`; lengths in spacings.
    """
    d = np.clip(distance, 0.0, cutoff)
    return 6.0 * (cutoff**3 / 12 - d * cutoff**2 / 6 + d**3 / 6 - d**4 / (12 * cutoff)) / cutoff**3


def look(
    body: LiquidBody,
    state: LiquidState,
    load: Float[np.ndarray, "fluids 3"],
    scales: LiquidScales,
    context: bool,
    dtype: torch.dtype = torch.float32,
) -> LiquidBatch:
    """What the network sees of a moment; `load` [N] is the mean over the frame that comes.

    Without `context` the features that look at the liquid as a whole (centroid, mean velocity, level) are zero.
    """
    links = body.connect(state.position)
    count, fluids = len(links.nodes), body.fluids
    x = np.concatenate([state.position, body.wall_points[links.nodes[fluids:] - fluids]])

    def padded(values: np.ndarray) -> np.ndarray:
        """Values of the fluid, zero for points of the wall."""
        return np.concatenate([values, np.zeros((count - fluids, values.shape[1]))])

    v, push = padded(state.velocity), padded(load / body.mass * (body.frame_dt / scales.d_velocity))
    felt, wall, missing, fill = (padded(part) for part in _wall_features(body, state.position))
    moving = padded(np.ones((fluids, 1)))
    directed = len(links.neighbour)
    edge, arm, rate = np.empty((directed, EDGE_FEATURES)), np.empty((directed, 3)), np.empty((directed, 3))
    sums = np.zeros((count, 10))
    scaled = (wall * felt, body.up, push, body.radius, scales.velocity)
    _look(links.offset, links.neighbour, x, v, *scaled, edge, arm, rate, sums)
    fill += sums[:, 9:] * 4.0 / body.neighbours
    sums *= 20.0 / body.neighbours
    node, basis = _node_features(body, scales, x, v / scales.velocity, push, wall * felt, felt, sums, context)
    numbers = {
        "node": np.concatenate([node, 3.0 * fill - 2.0, moving], axis=1),
        "edge": edge,
        "basis": basis,
        "arm": arm,
        "rate": rate,
        "fluid": moving,
        "near": (felt > 0).astype(float),
        "velocity": v / scales.d_velocity,
        "energy": padded(state.energy),
        "gravity": moving * body.gravity * (body.frame_dt / scales.d_velocity),
        "load": push,
        "weight": padded(body.mass / body.mass.mean()) + 1.0 - moving,
        "dt": np.full((count, 1), body.frame_dt),
        "wall": wall,
        "missing": missing,
    }
    tensors: dict[str, Any] = {name: torch.as_tensor(values, dtype=dtype) for name, values in numbers.items()}
    return LiquidBatch(**_wiring(links, dtype), **tensors)


def _wall_features(body: LiquidBody, positions: np.ndarray) -> tuple[np.ndarray, ...]:
    """How near the wall is (0 ... 1.5), its normal where it is near, what it takes of the neighbourhood: weighed with
    the normal, and as a share. All zero where points of the wall are nodes."""
    if len(body.wall_points):
        one = np.zeros((len(positions), 1))
        return one, np.zeros((len(positions), 3)), one, one
    distance, normal = body.vessel.distance_and_normal(positions)
    away, cutoff = (distance / body.pitch)[:, None], body.radius / body.pitch
    felt = np.clip(1.0 - away / NEAR_WALL, 0.0, 1.5)
    return felt, normal * (felt > 0), wall_share(away, cutoff), filled_by_wall(away, cutoff)


def _wiring(links: Links, dtype: torch.dtype) -> dict[str, Any]:
    count = len(links.nodes)
    member = np.zeros(count, np.int64)
    graph = Graph(links.pairs, links.offset, links.neighbour, links.pair, links.sign, member)
    return {
        "graph": graph,
        "to": torch.from_numpy(np.repeat(np.arange(count), np.diff(links.offset))),
        "source": torch.from_numpy(links.neighbour),
        "halves": links.halves,
        "member": torch.from_numpy(member),
        "bodies": 1,
        "share": torch.full((count, 1), 1.0 / count, dtype=dtype),
    }


def _node_features(body, scales, x, v, push, wall, felt, sums, context):
    """Node features without the last two, and vectors of the decoder [nodes, BASIS, 3]."""
    count, fluids = len(x), body.fluids
    gradient, laplacian = sums[:, 3:6], sums[:, 6:9]
    up = np.broadcast_to(body.up, (count, 3))
    offset, drift, depth = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros((count, 1))
    if context:
        size = np.cbrt(fluids) * body.pitch
        offset = 2.0 * (x - x[:fluids].mean(0)) / size
        drift = np.broadcast_to(v[:fluids].mean(0), (count, 3))
        height = x @ body.up
        depth = np.maximum(np.quantile(height[:fluids], 0.97) - height, 0.0)[:, None] / body.pitch

    def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return (a * b).sum(1, keepdims=True)

    def size_of(a: np.ndarray) -> np.ndarray:
        return np.sqrt(dot(a, a))

    flat = offset - dot(offset, up) * up
    thickness = 0.2 * np.log(max(body.liquid.viscosity / body.liquid.density, 1e-9) / scales.viscosity)
    bent = [
        dot(wall, v), dot(wall, push), dot(v, up), size_of(v), size_of(push), 0.3 * dot(v, push),
        sums[:, 1:2], sums[:, 2:3], size_of(laplacian), dot(laplacian, v), dot(laplacian, up), dot(laplacian, wall),
        dot(gradient, v), dot(offset, v), dot(drift, v), dot(drift, wall), dot(drift, offset), size_of(drift),
        dot(laplacian, gradient), dot(drift, up),
    ]  # fmt: skip
    straight = [
        felt, dot(wall, up), 0.1 * sums[:, :1], dot(gradient, up), dot(gradient, wall), size_of(gradient),
        dot(offset, up), size_of(flat), 0.2 * depth, np.full((count, 1), thickness),
    ]  # fmt: skip
    node = np.concatenate([np.arcsinh(np.concatenate(bent, axis=1)), *straight], axis=1)
    basis = np.stack([v, wall, up, push, laplacian, gradient, offset, drift], axis=1)
    return node, basis
