"""The GENERIC update of a liquid: equivariant brackets with decoded or with physical energy, and a plain decoder.

All act on y = (velocity, internal energy) of a particle, 4 numbers, each in scales of its increments. Vectors are
combinations, by decoded scalars, of vectors that turn with the liquid (`LiquidBatch.basis`, `arm`, `rate`).
"""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import nn
from torch.nn import functional

from zsdt.tignn.bracket import EdgeDecoder, Rates
from zsdt.tignn.liquid_exchange import Springs, exchange_potentials
from zsdt.tignn.liquid_features import BASIS, EDGE_FEATURES, EVEN_FEATURES, LiquidBatch, LiquidScales
from zsdt.tignn.message_passing import Perceptron
from zsdt.tignn.options import Bracket, Energy, TignnOptions

PER_EDGE = 0.1  # edges add up, a few ten per particle
STATE = 4


def combine(
    coefficients: Float[torch.Tensor, "nodes vectors BASIS"], basis: Float[torch.Tensor, "nodes BASIS 3"]
) -> Float[torch.Tensor, "nodes vectors 3"]:
    """Vectors as combinations of those that a node knows."""
    return torch.bmm(coefficients, basis)


def bounded(vectors: Float[torch.Tensor, "*rows 3"]) -> Float[torch.Tensor, "*rows 3"]:
    """Vectors of the same direction, shorter than 1: brackets are quadratic in them and must not run away."""
    return vectors / (1.0 + vectors.norm(dim=-1, keepdim=True))


class Port(nn.Module):
    """Work from outside: linear in gravity, in the load and in the nearness of a wall; none of them, no work."""

    def __init__(self, width: int, hidden: int):
        super().__init__()
        self.response = Perceptron(width, width, 2 * (BASIS + 1) + 6, hidden, gain=0.3)

    def forward(self, batch: LiquidBatch, x: torch.Tensor) -> Float[torch.Tensor, "nodes 4"]:
        r = self.response(x)
        scale = 0.1  # a frame of gravity is an order above the increment that is left of it
        pushed = r[:, :1] * scale * batch.gravity + (1.0 + r[:, 1:2]) * batch.load
        heat = r[:, 2:3] * scale * batch.gravity.norm(dim=1, keepdim=True) + r[:, 3:4] * batch.load.norm(
            dim=1, keepdim=True
        )
        wall = r[:, 6 : 6 + BASIS][:, None]
        pushed = pushed + batch.near * combine(wall, batch.basis)[:, 0]
        return torch.cat([pushed, heat + r[:, 4:5] * batch.near], dim=1)


class _Vectors(nn.Module):
    """Decodes `count` vectors of the state's kind (3 + 1) for nodes, and for directed edges."""

    def __init__(self, options: TignnOptions, count: int):
        super().__init__()
        self.count = count
        self.edges = EdgeDecoder(options.width, 3 * count, 0.5, EDGE_FEATURES)
        self.nodes = Perceptron(options.width, options.width, (BASIS + 1) * count, options.hidden_layers, gain=0.5)

    def of_edges(self, batch: LiquidBatch, x: torch.Tensor) -> Float[torch.Tensor, "directed count 4"]:
        """Vectors along the arm and along the relative velocity, bounded."""
        g = self.edges(batch, x, batch.edge).view(batch.edge.shape[0], self.count, 3)
        vector = g[..., :1] * batch.arm[:, None] + g[..., 1:2] * bounded(batch.rate)[:, None]
        return torch.cat([vector, g[..., 2:]], dim=-1)

    def of_nodes(self, batch: LiquidBatch, x: torch.Tensor) -> Float[torch.Tensor, "nodes count 4"]:
        """Vectors of the basis, bounded."""
        g = self.nodes(x).view(x.shape[0], self.count, BASIS + 1)
        return torch.cat([combine(g[..., :BASIS], bounded(batch.basis)), g[..., BASIS:]], dim=-1)


class _Gradients(nn.Module):
    """Decoded dE/dy and dS/dy (energy=learned); energy and entropy grow with heat unless the network says otherwise."""

    def __init__(self, options: TignnOptions):
        super().__init__()
        self.both = Perceptron(options.width, options.width, 2 * (BASIS + 1), options.hidden_layers, gain=0.5)

    def forward(self, batch: LiquidBatch, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        g = self.both(x).view(x.shape[0], 2, BASIS + 1)
        both = torch.cat([combine(g[..., :BASIS], batch.basis), 1.0 + g[..., BASIS:]], dim=-1) * batch.fluid[:, None]
        return both[:, 0], both[:, 1]


class LearnedExact(nn.Module):
    """Sum of projected two-node brackets and the one-node bulk with decoded gradients (DESIGN 4.1)."""

    def __init__(self, options: TignnOptions, scales: LiquidScales):
        super().__init__()
        self.rank = options.rank
        self.vectors = _Vectors(options, 3 * options.rank)
        self.gradients = _Gradients(options)
        self.port = Port(options.width, options.hidden_layers)

    def forward(self, batch: LiquidBatch, x: torch.Tensor) -> Rates:
        """Rates of all nodes; a wall point has no gradients, so what it would take is left out at no cost."""
        energy, entropy = self.gradients(batch, x)
        shape = (-1, 3, self.rank, STATE)
        pairs = (self.vectors.of_edges(batch, x) * math.sqrt(PER_EDGE)).view(shape)
        own = self.vectors.of_nodes(batch, x).view(shape)
        reversible, irreversible = batch.brackets(pairs, own, energy, entropy)
        port = self.port(batch, x) * batch.fluid
        return Rates(reversible * batch.fluid, irreversible * batch.fluid, port, energy, entropy)


class Soft(nn.Module):
    """The seed's Eq. 3 with decoded L = sum a b' - b a' and M = sum c c' of every edge and node, nothing projected.

    Low-rank factors are vectors that turn with the liquid; a decoded triangle would not. The bulk terms' L dS and
    M dE are the penalty.
    """

    def __init__(self, options: TignnOptions, scales: LiquidScales):
        super().__init__()
        self.rank = options.rank
        self.vectors = _Vectors(options, 3 * options.rank)
        self.gradients = _Gradients(options)
        self.port = Port(options.width, options.hidden_layers)

    @staticmethod
    def _act(a: torch.Tensor, b: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        """(a b' - b a') x summed over the ranks; of a = None, (b b') x."""
        along = (b * x[:, None]).sum(-1, keepdim=True)
        return (a * along - b * (a * x[:, None]).sum(-1, keepdim=True)).sum(1)

    def forward(self, batch: LiquidBatch, x: torch.Tensor) -> Rates:
        """As `LearnedExact.forward`, with the degeneracy penalty."""
        energy, entropy = self.gradients(batch, x)
        a, b, c = self.vectors.of_nodes(batch, x).view(-1, 3, self.rank, STATE).unbind(1)
        ldS, bulk = self._act(a, b, entropy), self._act(a, b, energy)
        mdE, heat = ((c * (c * g[:, None]).sum(-1, keepdim=True)).sum(1) for g in (energy, entropy))
        a, b, c = self.vectors.of_edges(batch, x).view(-1, 3, self.rank, STATE).unbind(1)
        flux = self._act(a, b, energy.index_select(0, batch.source)) * PER_EDGE
        warm = entropy.index_select(0, batch.source)[:, None]
        heat_flux = (c * (c * warm).sum(-1, keepdim=True)).sum(1) * PER_EDGE
        reversible = bulk.index_add(0, batch.to, -flux) * batch.fluid
        irreversible = heat.index_add(0, batch.to, -heat_flux) * batch.fluid
        penalty = mdE.square().mean() + ldS.square().mean()
        port = self.port(batch, x) * batch.fluid
        return Rates(reversible, irreversible, port, energy, entropy, ldS, mdE, penalty)


class Plain(nn.Module):
    """No bracket: the black box. All of the increment is booked as a port, since nothing is known about it."""

    def __init__(self, options: TignnOptions, scales: LiquidScales):
        super().__init__()
        self.edges = EdgeDecoder(options.width, 2, 0.5, EDGE_FEATURES)
        self.nodes = Perceptron(options.width, options.width, BASIS + 1, options.hidden_layers, gain=0.3)

    def forward(self, batch: LiquidBatch, x: torch.Tensor) -> Rates:
        """As `LearnedExact.forward`; no gradients."""
        g = self.edges(batch, x, batch.edge) * PER_EDGE
        vector = g[:, :1] * batch.arm + g[:, 1:] * batch.rate
        r = self.nodes(x)
        moved = combine(r[:, None, :BASIS], batch.basis)[:, 0].index_add(0, batch.to, vector) + batch.load
        total = torch.cat([moved, r[:, BASIS:]], dim=1) * batch.fluid
        zero = torch.zeros_like(total)
        return Rates(zero, zero, total)


class PhysicalExact(nn.Module):
    """Metriplectic pair exchange of the energy `E = sum m (|v|2/2 - g.q + e)` (energy=physical, DESIGN 4.1).

    A decoder as that of the black box says what every particle should do. What comes true is the nearest exchange:
    every pair rubs against its relative velocity (decoded coefficients >= 0: irreversible, into heat), the wall rubs
    as well, and the rest are impulses along the arms and the wall's normal (reversible, from and to compression), half
    of the energy on either side. So momentum between particles is conserved, the wall at rest does no work, gravity is
    in the energy and the load is the only port.

    L is canonical in (q, v) and couples v to e through these impulses; entropy grows with e alone (learned slope
    1/T > 0), and its slope along q is the one that L dS = 0 demands, as a pressure times volume over temperature is.
    Gradients and rates have 7 components: q [m], v, e.
    """

    def __init__(self, options: TignnOptions, scales: LiquidScales):
        super().__init__()
        self.scales = scales
        width, half = options.width, max(options.width // 2, 1)
        self.wanted = Plain(options, scales)
        self.ends = nn.Linear(width, half)
        self.even = nn.Linear(EVEN_FEATURES, half, bias=False)
        self.pair = Perceptron(half, half, 2, 0, gain=0.5)
        self.wall = Perceptron(width, width, 2, options.hidden_layers, gain=0.5)
        self.warmth = Perceptron(1, 16, 1, 1)

    def _friction(self, batch: LiquidBatch, x: torch.Tensor, first, second, rows) -> torch.Tensor:
        """Two frictions >= 0 of every pair, along and across its arm."""
        ends = self.ends(x)
        hidden = ends.index_select(0, first) + ends.index_select(0, second)
        hidden = hidden + self.even(batch.edge.index_select(0, rows)[:, :EVEN_FEATURES])
        return functional.softplus(self.pair(functional.silu(hidden)) - 1.0) * (0.5 * PER_EDGE)

    def forward(self, batch: LiquidBatch, x: torch.Tensor) -> Rates:
        """Rates in (q, v, e); `port` carries the load, and what closes the budget of the finite step."""
        pairs = batch.graph.pairs
        first, second = (torch.from_numpy(np.ascontiguousarray(pairs[:, k])) for k in (0, 1))
        rows = torch.from_numpy(np.ascontiguousarray(batch.halves[:, 0]))
        arm = batch.arm.index_select(0, rows)
        length = arm.norm(dim=1, keepdim=True)
        fade, unit = (1.0 - length).clamp_min(0.0), arm / (length + 1e-12)
        v, mass, outside = batch.velocity, batch.weight, batch.gravity + batch.load

        def gather(values: torch.Tensor) -> torch.Tensor:
            empty = torch.zeros(len(x), values.shape[1], dtype=values.dtype)
            return empty.index_add(0, first, values).index_add(0, second, -values)

        friction = self._friction(batch, x, first, second, rows) * fade
        slip = v.index_select(0, first) - v.index_select(0, second)
        rubbed = -friction[:, :1] * (slip * unit).sum(1, keepdim=True) * unit - friction[:, 1:] * slip
        wall_rub = self._wall_rub(batch, self.wall(x))
        by_friction = gather(rubbed) + wall_rub
        # What the arms and the wall's normal must give so that the wanted increments come true.
        wanted = (self.wanted(batch, x).port[:, :3] - outside) * mass - by_friction
        walls = batch.wall * batch.missing.sqrt()
        springs = Springs(pairs, unit, fade, walls, mass * batch.fluid, batch.graph.member)
        y = exchange_potentials(wanted * batch.fluid, springs) * batch.fluid
        push = fade * (unit * (y.index_select(0, first) - y.index_select(0, second))).sum(1, keepdim=True)
        pressed, wall_push = push * unit, (walls * y).sum(1, keepdim=True) * walls
        forces = (pressed, rubbed, wall_push, wall_rub)
        by_pressure = gather(pressed) + wall_push
        dv = ((by_pressure + by_friction) / mass + outside) * batch.fluid
        shares = _Shares(batch, first, second, self.scales.d_velocity**2 / self.scales.d_energy)
        at_start = shares.heat(v, *forces)
        compressed, heated = shares.heat(v + 0.5 * dv, *forces)
        thermal = functional.softplus(self.warmth(torch.asinh(batch.energy / self.scales.energy))) * batch.fluid
        slope = shares.slope(thermal, gather, forces)
        return self._rates(batch, (by_pressure, by_friction), at_start, compressed + heated, thermal, slope)

    @staticmethod
    def _wall_rub(batch: LiquidBatch, decoded: torch.Tensor) -> torch.Tensor:
        """Impulse against sliding along and moving towards the wall, both coefficients >= 0."""
        into = (batch.velocity * batch.wall).sum(1, keepdim=True) * batch.wall
        rub = functional.softplus(decoded - 2.0) * batch.near
        return -rub[:, :1] * (batch.velocity - into) - rub[:, 1:] * into

    def _rates(self, batch, by, at_start, exact, thermal, slope) -> Rates:
        """Packs the rates; energies per mean mass in squares of the velocity's scale."""
        mass, fluid = batch.weight, batch.fluid
        scale = self.scales.d_velocity**2 / self.scales.d_energy
        step = batch.dt * self.scales.d_velocity
        zero = torch.zeros_like(batch.velocity)
        reversible = torch.cat([batch.velocity * step, (by[0] / mass + batch.gravity) * fluid, at_start[0]], dim=1)
        irreversible = torch.cat([zero, by[1] / mass * fluid, at_start[1]], dim=1)
        closing = exact - at_start[0] - at_start[1]
        port = torch.cat([zero, batch.load * fluid, closing], dim=1)
        energy = torch.cat([-mass * batch.gravity / step, mass * batch.velocity, mass / scale], dim=1) * fluid
        entropy = torch.cat([slope / step, zero, thermal * mass / scale], dim=1) * fluid
        return Rates(reversible, irreversible, port, energy, entropy)


class _Shares:
    """Who gets the heat of an exchange: both sides half, a particle at a wall all of it."""

    def __init__(self, batch: LiquidBatch, first: torch.Tensor, second: torch.Tensor, scale: float):
        self.batch, self.first, self.second, self.scale = batch, first, second, scale
        fluid = batch.fluid
        a, b = fluid.index_select(0, first), fluid.index_select(0, second)
        self.to_first, self.to_second = a / (a + b), b / (a + b)

    def heat(self, velocity, pressed, rubbed, wall_push, wall_rub) -> tuple[torch.Tensor, torch.Tensor]:
        """Increments of e by the reversible and by the irreversible impulses, if they act at `velocity`."""
        slip = velocity.index_select(0, self.first) - velocity.index_select(0, self.second)
        found = []
        for pair, wall in ((pressed, wall_push), (rubbed, wall_rub)):
            lost = -(pair * slip).sum(1, keepdim=True)
            gained = -(wall * velocity).sum(1, keepdim=True)
            gained = gained.index_add(0, self.first, self.to_first * lost)
            gained = gained.index_add(0, self.second, self.to_second * lost)
            found.append(gained * self.scale / self.batch.weight * self.batch.fluid)
        return found[0], found[1]

    def slope(self, thermal: torch.Tensor, gather, forces) -> torch.Tensor:
        """dS/dq times the length of a frame's way, from L dS = 0."""
        pressed, _, wall_push, _ = forces
        mean = self.to_first * thermal.index_select(0, self.first)
        mean = mean + self.to_second * thermal.index_select(0, self.second)
        return gather(mean * pressed) + thermal * wall_push


def make_liquid_bracket(options: TignnOptions, scales: LiquidScales) -> nn.Module:
    """The update head that `options.bracket` and `options.energy` name."""
    if options.bracket is Bracket.exact and options.energy is Energy.physical:
        return PhysicalExact(options, scales)
    kinds = {Bracket.exact: LearnedExact, Bracket.soft: Soft, Bracket.none: Plain}
    return kinds[options.bracket](options, scales)
