"""State of the node form, the graph that it lives on, and the dimensionless features that the network sees.

Nothing here depends on where a body stands: only displacements, velocities, differences along edges and the
reference edge vectors enter, so a translated body gives the same numbers. Scales are one number per field, never
per component, so that a rotated body stays in range (DESIGN 4.2).
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from zsdt.graph import graph_of
from zsdt.tignn.options import GraphScale, TignnOptions
from zsdt.tignn.wiring import Wiring, merge_wirings
from zsdt.trajectory import Body

_ROOT = {n: float(np.sqrt(n)) for n in (2, 3, 6)}
# Orthonormal coordinates of a symmetric tensor: first the pressure part, then five of the deviator. Rows act on the
# order 11 22 33 12 13 23.
STRESS_BASIS = np.array(
    [
        [1 / _ROOT[3], 1 / _ROOT[3], 1 / _ROOT[3], 0, 0, 0],
        [2 / _ROOT[6], -1 / _ROOT[6], -1 / _ROOT[6], 0, 0, 0],
        [0, 1 / _ROOT[2], -1 / _ROOT[2], 0, 0, 0],
        [0, 0, 0, _ROOT[2], 0, 0],
        [0, 0, 0, 0, _ROOT[2], 0],
        [0, 0, 0, 0, 0, _ROOT[2]],
    ]
)
_BASIS = torch.from_numpy(STRESS_BASIS)
SMALLEST_SCALE = 0.02
# What an edge sees saturates at this many scales, so that a rollout beyond the training range cannot run away.
LARGEST_FEATURE = 8.0


@dataclass(frozen=True)
class NodeState:
    """What changes: displacement [nodes, 3] m, velocity [nodes, 3] m/s, stress [nodes, 6] Pa, the last velocity
    increments [nodes, 3 history] m/s (newest first), thermal [nodes, 0 or 2] elastic and dissipated energy J/m3."""

    displacement: torch.Tensor
    velocity: torch.Tensor
    stress: torch.Tensor
    increments: torch.Tensor
    thermal: torch.Tensor

    def detach(self) -> NodeState:
        """The same numbers without a gradient."""
        return NodeState(**{f.name: getattr(self, f.name).detach() for f in fields(self)})


@dataclass(frozen=True)
class GraphBatch(Wiring):
    """One body, or several side by side, as tensors.

    arm [directed, 3]: reference vector from receiver to sender in pitches. free [nodes, 1]: 0 at the clamp. surface
    [nodes, 1]: edges of a node over 6. dt s, pitch m, mass kg, volume m3 [nodes, 1]; gravity [nodes, 3] m/s2.
    """

    arm: torch.Tensor
    free: torch.Tensor
    surface: torch.Tensor
    dt: torch.Tensor
    pitch: torch.Tensor
    mass: torch.Tensor
    volume: torch.Tensor
    gravity: torch.Tensor


def body_batch(body: Body, dtype: torch.dtype = torch.float32) -> GraphBatch:
    """The tensors of one body."""
    graph = graph_of(body.nodes, body.pairs)
    to = np.repeat(np.arange(graph.nodes), np.diff(graph.offset))
    place = np.empty((len(graph.pairs), 2), np.int64)
    side = (graph.sign < 0).astype(np.int64)
    place[graph.pair, side] = np.arange(len(to))
    arm = (body.points[graph.neighbour] - body.points[to]) / body.pitch
    volume = body.mass / body.material.density if body.material is not None else np.zeros(body.nodes)

    def column(values: np.ndarray | float) -> torch.Tensor:
        return torch.as_tensor(np.broadcast_to(values, body.nodes).reshape(-1, 1).copy(), dtype=dtype)

    return GraphBatch(
        graph=graph,
        to=torch.from_numpy(to),
        source=torch.from_numpy(graph.neighbour),
        halves=place,
        member=torch.from_numpy(graph.member),
        bodies=1,
        arm=torch.as_tensor(arm, dtype=dtype),
        free=column(~body.clamped),
        surface=column(np.diff(graph.offset) / 6.0),
        share=column(1.0 / body.nodes),
        dt=column(body.frame_dt),
        pitch=column(body.pitch),
        mass=column(body.mass),
        volume=column(volume),
        gravity=torch.as_tensor(body.gravity, dtype=dtype).expand(body.nodes, 3),
    )


def merge(batches: list[GraphBatch]) -> GraphBatch:
    """Several batches side by side."""
    if len(batches) == 1:
        return batches[0]
    names = ("arm", "free", "surface", "dt", "pitch", "mass", "volume", "gravity")
    joined: dict[str, Any] = {name: torch.cat([getattr(b, name) for b in batches]) for name in names}
    return GraphBatch(**vars(merge_wirings(list(batches))), **joined)


def join(states: list[NodeState]) -> NodeState:
    """States of several bodies side by side."""
    return NodeState(**{name: torch.cat([getattr(s, name) for s in states]) for name in vars(states[0])})


def cut(state: NodeState, nodes: slice) -> NodeState:
    """The state of some of the nodes."""
    return NodeState(**{name: getattr(state, name)[nodes] for name in vars(state)})


def split(state: NodeState, parts: int) -> list[NodeState]:
    """A state of `parts` bodies of the same size, one by one."""
    pieces = {name: getattr(state, name).chunk(parts) for name in vars(state)}
    return [NodeState(**{name: piece[k] for name, piece in pieces.items()}) for k in range(parts)]


@dataclass
class Scales:
    """One physical scale per field, as root mean squares over the training set: velocity [m/s], pressure and
    deviator [Pa] (of the orthonormal coordinates), strain [-] and its rate [1/s] along edges, load [N] of a loaded
    node, elastic and dissipated energy [J/m3]; the same of one frame's increments (d_...); node_volume [m3]."""

    velocity: float = 1.0
    pressure: float = 1.0
    deviator: float = 1.0
    strain: float = 1.0
    rate: float = 1.0
    load: float = 1.0
    thermal: float = 1.0
    d_velocity: float = 1.0
    d_pressure: float = 1.0
    d_deviator: float = 1.0
    d_thermal: float = 1.0
    frame_dt: float = 1.0
    node_volume: float = 1.0

    def stress(self) -> list[float]:
        """Scales of the six orthonormal stress coordinates."""
        return [self.pressure] + [self.deviator] * 5

    def d_stress(self) -> list[float]:
        """Scales of the increments of the six orthonormal stress coordinates."""
        return [self.d_pressure] + [self.d_deviator] * 5


def node_feature_count(options: TignnOptions, thermal: int) -> int:
    """Number of node features (see `features`)."""
    return 22 + 3 * options.history + thermal


EDGE_FEATURES = 10


def graph_magnitude(
    batch: GraphBatch, state: NodeState, load: torch.Tensor, scales: Scales, kind: GraphScale
) -> Float[torch.Tensor, "nodes 1"]:
    """Magnitude of each graph, per node, by which its features and increments are divided; 1 for `none`."""
    if kind is GraphScale.none:
        return torch.ones_like(batch.free)
    if kind is GraphScale.motion:
        square = batch.mean(state.velocity.square().mean(1, keepdim=True)) / scales.velocity**2
    else:
        square = batch.mean(load.square().sum(1, keepdim=True)) / scales.load**2
    return (square.sqrt() + SMALLEST_SCALE)[batch.member]


def node_features(
    batch: GraphBatch,
    state: NodeState,
    load: Float[torch.Tensor, "nodes 3"],
    load_next: Float[torch.Tensor, "nodes 3"],
    scales: Scales,
    magnitude: Float[torch.Tensor, "nodes 1"],
    stress_input: bool = True,
) -> Float[torch.Tensor, "nodes features"]:
    """Dimensionless features of nodes."""
    inverse = 1.0 / magnitude
    basis = _BASIS.to(state.stress)
    stress = state.stress @ basis.T / torch.tensor(scales.stress(), dtype=state.stress.dtype)
    if not stress_input:
        stress = torch.zeros_like(stress)
    scaled = torch.cat(
        [
            state.velocity / scales.velocity,
            stress,
            load_next / scales.load,
            (load_next - load) / scales.load * 10.0,
            state.increments / scales.d_velocity,
            state.thermal / scales.thermal,
        ],
        dim=1,
    )
    plain = [batch.free, batch.surface, batch.gravity / 9.81, magnitude.log(), (batch.dt / scales.frame_dt).log()]
    return torch.cat([scaled * inverse, *plain], dim=1)


def features(
    batch: GraphBatch,
    state: NodeState,
    load: Float[torch.Tensor, "nodes 3"],
    load_next: Float[torch.Tensor, "nodes 3"],
    scales: Scales,
    magnitude: Float[torch.Tensor, "nodes 1"],
    stress_input: bool = True,
) -> tuple[Float[torch.Tensor, "nodes features"], Float[torch.Tensor, "directed edge_features"]]:
    """Dimensionless features of nodes and of directed edges (receiver's side)."""
    node = node_features(batch, state, load, load_next, scales, magnitude, stress_input)
    inverse = 1.0 / magnitude
    to, source = batch.to, batch.source
    per_pitch = (inverse / batch.pitch)[to]
    strain = (state.displacement.index_select(0, source) - state.displacement.index_select(0, to)) * (
        per_pitch / scales.strain
    )
    rate = (state.velocity[source] - state.velocity[to]) * (per_pitch / scales.rate)
    bent = batch.arm + strain * (scales.strain * magnitude[to])
    stretch = (bent.norm(dim=1, keepdim=True) - batch.arm.norm(dim=1, keepdim=True)) * (inverse[to] / scales.strain)
    seen = torch.cat([strain, stretch, rate], dim=1)
    return node, torch.cat([batch.arm, seen * torch.rsqrt(1.0 + (seen / LARGEST_FEATURE).square())], dim=1)


def cast(state: NodeState, dtype: torch.dtype) -> NodeState:
    """The state in another precision."""
    return replace(state, **{f.name: getattr(state, f.name).to(dtype) for f in fields(state)})
