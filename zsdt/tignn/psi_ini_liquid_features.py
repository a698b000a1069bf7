"""What Psi_ini of a liquid sees: scalars that do not change when glass and motion are turned about gravity or mirrored.

Vectors (pushes that are left of the vessel's motion, their potential flow, wall normals) wait in `basis` for the
decoder, which combines them with decoded scalars; inside the network there are inner products of them alone. So the
field turns with the vessel, and no motion at all gives no velocity at all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from zsdt.errors import OptionError
from zsdt.fluid.impulse import Impulse, impulse_of
from zsdt.fluid.vessel import Vessel
from zsdt.graph import Graph
from zsdt.radius_graph import radius_graph
from zsdt.tignn.vessel_history import FADING, MEMORIES, History, Swing, history_of, swing_of
from zsdt.tignn.wiring import Wiring, merge_wirings
from zsdt.trajectory import Body

CUTOFF = 1.6  # spacings: edges of the network
FALL = 0.03  # s: for how long a surface is thought to have fallen back, to make a velocity of its acceleration
SHORT, LONG = 1, len(FADING)  # of the memories, those whose pushes are looked at closely: it fades soon, or swings
NODE_FEATURES, EDGE_FEATURES, BASIS = 31 + 8 * MEMORIES, 7, MEMORIES + 6


@dataclass(frozen=True)
class LiquidInputs:
    """A liquid at one moment, or several side by side, as the network sees it.

    node [nodes, NODE_FEATURES], edge [directed, EDGE_FEATURES]; basis [nodes, BASIS, 3]: vectors over `speed`, first
    the potential flows of the pushes and of gravity; speed [nodes, 1] m/s and heat [nodes, 1] J/kg: scales of
    what is decoded, zero where nothing ever moved.
    """

    wiring: Wiring
    node: torch.Tensor
    edge: torch.Tensor
    basis: torch.Tensor
    speed: torch.Tensor
    heat: torch.Tensor


def merge_inputs(parts: list[LiquidInputs]) -> LiquidInputs:
    """Several liquids side by side."""
    if len(parts) == 1:
        return parts[0]
    joined: dict[str, Any] = {
        n: torch.cat([getattr(p, n) for p in parts]) for n in ("node", "edge", "basis", "speed", "heat")
    }
    return LiquidInputs(wiring=merge_wirings([p.wiring for p in parts]), **joined)


@dataclass(frozen=True)
class Place:
    """Geometry of a liquid.

    up: unit vector against gravity; distance to the wall [m] and its normal; impulse response; first sloshing mode;
    size [m]: cube root of the volume; centroid, and offset of each particle from it, over the size.
    """

    up: Float[np.ndarray, "3"]
    distance: Float[np.ndarray, " n"]
    normal: Float[np.ndarray, "n 3"]
    impulse: Impulse
    swing: Swing
    size: float
    centroid: Float[np.ndarray, "3"]
    offset: Float[np.ndarray, "n 3"]


def place_of(body: Body, positions: Float[np.ndarray, "n 3"]) -> Place:
    """Geometry of a liquid at `positions` [m] in its vessel.

    Raises: OptionError where the body is no liquid in a vessel; RunRejected where a position is not finite.
    """
    if body.liquid is None or body.vessel is None:
        raise OptionError("Psi_ini of a liquid needs a liquid and its vessel; this body has none.")
    positions = np.ascontiguousarray(positions, np.float64)
    vessel = Vessel(body.vessel)
    distance, normal = vessel.distance_and_normal(positions)
    impulse = impulse_of(positions, distance, normal, body.pitch)
    size = body.pitch * len(positions) ** (1.0 / 3.0)
    strength = max(float(np.linalg.norm(body.gravity)), 1e-12)
    level, liquid = vessel.level(size**3), body.liquid
    radius = float(vessel.radius(level)) * math.sqrt(body.vessel.aspect)
    swing = swing_of(radius, level, strength, liquid.viscosity / liquid.density)
    up, centroid = -body.gravity / strength, positions.mean(0)
    return Place(up, distance, normal, impulse, swing, size, centroid / size, (positions - centroid) / size)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return (a * b).sum(-1)


def _shape_columns(body: Body, place: Place) -> list[np.ndarray]:
    """Scalars of the geometry alone, one number per particle each."""
    spacing, u, up = body.pitch, place.impulse.response, place.up
    clear = np.clip(place.distance / spacing, -1.0, 6.0)  # a stray one is no reason for large numbers
    turn = u - u.transpose(0, 2, 1)
    depth = -place.impulse.pressure @ up
    height = place.offset @ up
    flat = place.offset - height[:, None] * up
    return [
        clear / 3.0,
        np.exp(-clear),
        place.distance / place.size,
        place.normal @ up,
        _dot(place.normal, flat),
        depth / place.size,
        np.exp(-np.maximum(depth / spacing, -1.0)),
        place.impulse.air,
        np.einsum("a,nab,b->n", up, u, up),
        np.trace(u, axis1=1, axis2=2) / 3.0,
        np.sqrt((u**2).sum((1, 2))),
        np.sqrt((turn**2).sum((1, 2))),
        np.einsum("na,nab,nb->n", place.normal, u, place.normal),
        np.einsum("na,nab,b->n", place.normal, u, up),
        height,
        np.linalg.norm(flat, axis=1),
    ]


def _push_columns(
    place: Place, pushes: Float[np.ndarray, "memories 3"], flows: Float[np.ndarray, "n memories 3"]
) -> list[np.ndarray]:
    """Scalars of each push (over the speed) at each particle."""
    columns = []
    for k, push in enumerate(pushes):
        flow = flows[:, k]
        columns += [
            flow @ place.up,
            np.linalg.norm(flow, axis=1),
            _dot(flow, place.normal),
            place.impulse.pressure @ push / place.size,
            place.normal @ push,
            place.offset @ push,
        ]
    short, long = pushes[SHORT], pushes[LONG]
    return [*columns, flows[:, SHORT] @ short, flows[:, LONG] @ long, flows[:, LONG] @ short]


def _whole_columns(
    body: Body,
    place: Place,
    history: History,
    pushes: Float[np.ndarray, "memories 3"],
    flows: Float[np.ndarray, "n memories 3"],
) -> list[float]:
    """Scalars of the whole liquid."""
    assert body.liquid is not None  # place_of has checked it
    strength = max(float(np.linalg.norm(body.gravity)), 1e-12)
    viscous = body.liquid.viscosity / body.liquid.density * 0.1 / place.size**2
    mean = flows.mean(0)
    return [
        math.log(place.size / body.pitch),
        math.log(max(history.speed, 1e-3) / math.sqrt(strength * place.size)),
        math.log10(max(viscous, 1e-8)),
        *np.linalg.norm(pushes, axis=1),
        float(pushes[SHORT] @ pushes[LONG]),
        *(history.spent / max(history.heat, 1e-12)),
        float(mean[SHORT] @ pushes[SHORT]),
        float(mean[LONG] @ pushes[LONG]),
        float(place.centroid @ pushes[LONG]),
    ]


def _edge_columns(
    place: Place, graph: Graph, arm: Float[np.ndarray, "m 3"], push: Float[np.ndarray, "3"]
) -> list[np.ndarray]:
    """Scalars of each directed edge; arm: from receiver to sender over the cutoff."""
    to = np.repeat(np.arange(graph.nodes), np.diff(graph.offset))
    length = np.linalg.norm(arm, axis=1)
    return [
        length,
        (1.0 - length) ** 2,
        arm @ place.up,
        arm @ push,
        _dot(arm, place.normal[to]),
        _dot(place.normal[graph.neighbour], place.normal[to]),
        place.impulse.air[graph.neighbour] - place.impulse.air[to],
    ]


def _wiring(positions: Float[np.ndarray, "n 3"], radius: float) -> Wiring:
    """Who is within the radius of whom."""
    graph = radius_graph(positions, radius)
    halves = np.empty((len(graph.pairs), 2), np.int64)
    halves[graph.pair, (graph.sign < 0).astype(np.int64)] = np.arange(len(graph.pair))
    return Wiring(
        graph=graph,
        to=torch.from_numpy(np.repeat(np.arange(graph.nodes), np.diff(graph.offset))),
        source=torch.from_numpy(graph.neighbour),
        halves=halves,
        member=torch.from_numpy(graph.member),
        bodies=1,
        share=torch.full((graph.nodes, 1), 1.0 / max(graph.nodes, 1)),
    )


def inputs_of(
    body: Body, positions: Float[np.ndarray, "n 3"], later: float = 0.0, place: Place | None = None
) -> LiquidInputs:
    """Features of a liquid at `positions` [m], `later` [s] after the last sample of its vessel's motion.

    Raises: OptionError where the body is no liquid, has no vessel or no motion; RunRejected where a position is not
    finite.
    """
    place = place or place_of(body, positions)
    history = history_of(body.motion, place.swing, later)
    n, unit = len(positions), max(history.speed, 1e-9)
    response = place.impulse.response
    pushes = history.pushes / unit
    flows = np.einsum("nab,kb->nka", response, pushes)
    fall = response @ body.gravity * (FALL / unit)
    fall /= np.sqrt(1.0 + (fall**2).sum(1, keepdims=True))
    columns = _shape_columns(body, place) + _push_columns(place, pushes, flows)
    columns += [fall @ place.up, np.linalg.norm(fall, axis=1), _dot(fall, place.normal)]
    columns += [fall @ pushes[SHORT], fall @ pushes[LONG]]
    columns += [np.full(n, v) for v in _whole_columns(body, place, history, pushes, flows)]
    flat = place.offset - (place.offset @ place.up)[:, None] * place.up
    same = [np.broadcast_to(v, (n, 3)) for v in (pushes[SHORT], pushes[LONG], place.up)]
    basis = np.concatenate([flows, np.stack([fall, *same, place.normal, flat], axis=1)], axis=1)
    wiring = _wiring(positions, CUTOFF * body.pitch)
    to = np.repeat(np.arange(n), np.diff(wiring.graph.offset))
    arm = (positions[wiring.graph.neighbour] - positions[to]) / (CUTOFF * body.pitch)
    edge = np.stack(_edge_columns(place, wiring.graph, arm, pushes[LONG]), axis=1)

    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(np.ascontiguousarray(values), dtype=torch.float32)

    return LiquidInputs(
        wiring=wiring,
        node=tensor(np.stack(columns, axis=1)),
        edge=tensor(edge),
        basis=tensor(basis),
        speed=tensor(np.full((n, 1), history.speed)),
        heat=tensor(np.full((n, 1), history.heat)),
    )
