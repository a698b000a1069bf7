"""Encoder and processor: node features in, node latents out (seed, "Implementation via Graph Neural Networks")."""

from __future__ import annotations

import itertools
import math

import torch
from jaxtyping import Float
from torch import nn
from torch.nn import functional

from zsdt.tignn.wiring import Wiring


class Perceptron(nn.Module):
    """Multi-layer perceptron with `hidden` hidden layers of `width`; the last layer is shrunk by `gain`."""

    def __init__(self, inputs: int, width: int, outputs: int, hidden: int = 1, gain: float = 1.0):
        super().__init__()
        sizes = [inputs] + [width] * hidden
        self.hidden = nn.ModuleList(nn.Linear(a, b) for a, b in itertools.pairwise(sizes))
        self.last = nn.Linear(sizes[-1], outputs)
        with torch.no_grad():
            self.last.weight.mul_(gain)
            self.last.bias.mul_(gain)

    def forward(self, x: Float[torch.Tensor, "rows inputs"]) -> Float[torch.Tensor, "rows outputs"]:
        for layer in self.hidden:
            x = functional.silu(layer(x))
        return self.last(x)


class Pass(nn.Module):
    """One message pass: fused sum over neighbours, virtual node if asked for, residual update of the node.

    LayerNorm acts on each node alone; nothing is normalised by a statistic of the batch.
    """

    def __init__(self, width: int, edge_features: int, hidden: int, context: bool):
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.sender = nn.Linear(width, width, bias=False)
        self.receiver = nn.Linear(width, width)
        self.edge = nn.Parameter(torch.randn(edge_features, width) / (2.0 * math.sqrt(edge_features)))
        self.own = nn.Linear(width, width)
        self.gathered = nn.Linear(width, width, bias=False)
        self.update = Perceptron(width, width, width, hidden - 1, gain=0.5)
        self.context = Perceptron(width, width, width, 1) if context else None

    def forward(
        self, batch: Wiring, x: Float[torch.Tensor, "nodes width"], edge: Float[torch.Tensor, "directed features"]
    ) -> Float[torch.Tensor, "nodes width"]:
        y = self.norm(x)
        gathered = batch.messages(self.sender(y), self.receiver(y), self.edge, edge)
        hidden = self.own(y) + self.gathered(gathered * 0.4)
        if self.context is not None:
            hidden = hidden + self.context(batch.mean(y))[batch.member]
        return x + self.update(functional.silu(hidden))


class Processor(nn.Module):
    """Encoder and `passes` message passes, with own weights per pass or the same for all."""

    def __init__(
        self,
        node_features: int,
        edge_features: int,
        width: int,
        hidden: int,
        passes: int,
        shared: bool,
        context: bool,
    ):
        super().__init__()
        self.encoder = Perceptron(node_features, width, width, hidden)
        count = 1 if shared else passes
        self.passes = nn.ModuleList(Pass(width, edge_features, hidden, context) for _ in range(count))
        self.depth = passes
        self.norm = nn.LayerNorm(width)

    def forward(
        self,
        batch: Wiring,
        node: Float[torch.Tensor, "nodes features"],
        edge: Float[torch.Tensor, "directed edge_features"],
    ) -> Float[torch.Tensor, "nodes width"]:
        x = self.encoder(node)
        for k in range(self.depth):
            x = self.passes[k % len(self.passes)](batch, x, edge)
        return self.norm(x)


def receptive_field(passes: int, pitch: float, frame_dt: float, length: float, wave_speed: float | None) -> str:
    """One line that holds the depth against what the physics asks for (DESIGN 4.2).

    Waves need passes > sqrt(2) c dt / dx, statics about length / pitch. `wave_speed` [m/s] is None where the
    material is unknown; lengths in m, `frame_dt` in s.
    """
    statics = f"statics ask for about {length / pitch:.0f}"
    waves = "waves: material unknown"
    if wave_speed is not None:
        waves = f"waves ask for more than {math.sqrt(2.0) * wave_speed * frame_dt / pitch:.1f}"
    return f"{passes} passes; {waves}, {statics} (frame {1e3 * frame_dt:.1f} ms, pitch {1e3 * pitch:.0f} mm)"
