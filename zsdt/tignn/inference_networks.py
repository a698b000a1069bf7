"""The node form's processor and edge decoder without gradients: matrix products into standing buffers, one compiled
loop between two of them (DESIGN 4.4).

Numbers are those of the eager modules to rounding. What depends on the number of nodes or edges alone is allocated
when that number grows (by a fifth more than asked for, so that a liquid's changing graph soon finds room).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import nn
from torch.nn import functional

from zsdt.tignn.bracket import EdgeDecoder
from zsdt.tignn.features import LARGEST_FEATURE, GraphBatch, NodeState, Scales, node_features
from zsdt.tignn.inference_kernels import FEATURES, filled, gather_messages, join_ends, normalise, solid_edges
from zsdt.tignn.message_passing import Pass, Perceptron, Processor
from zsdt.tignn.wiring import Wiring

SPARE = 1.2  # room for rows over the rows asked for


class _Buffers:
    """Arrays by name that only grow."""

    def __init__(self, dtype: torch.dtype):
        self._dtype, self._kept = dtype, dict[str, torch.Tensor]()

    def __call__(self, name: str, rows: int, width: int) -> torch.Tensor:
        """[rows, width], with whatever is in it."""
        kept = self._kept.get(name)
        if kept is None or len(kept) < rows:
            with torch.inference_mode(False):  # what is made in that mode can never be written outside of it
                kept = self._kept[name] = torch.empty(int(SPARE * rows) + 1, width, dtype=self._dtype)
        return kept[:rows]


def _across(layer: nn.Linear) -> torch.Tensor:
    """Weights [inputs, outputs] of a layer."""
    return layer.weight.detach().T.contiguous()


class _FastPass:
    """One `Pass`: sender, receiver and own layer in one product, the virtual node in its bias."""

    def __init__(self, layer: Pass):
        width = layer.own.weight.shape[0]
        parts = [layer.sender.weight, layer.receiver.weight, layer.own.weight]
        self.ends = torch.cat(parts).detach().T.contiguous()
        zero = torch.zeros(width, dtype=self.ends.dtype)
        self.bias = torch.cat([zero, layer.receiver.bias, layer.own.bias]).detach()
        self.edge = filled(layer.edge.detach().numpy())
        self.gathered = (0.4 * layer.gathered.weight).detach().T.contiguous()
        deep: Any = layer.update.hidden
        self.hidden = [(_across(h), h.bias.detach()) for h in deep]
        self.last, self.last_bias = _across(layer.update.last), layer.update.last.bias.detach().numpy()
        self.scale, self.shift = layer.norm.weight.detach().numpy(), layer.norm.bias.detach().numpy()
        self.small, self.context, self.width = layer.norm.eps, layer.context, width

    def __call__(
        self, batch: Wiring, x: torch.Tensor, edge: np.ndarray, bias: np.ndarray, room: _Buffers
    ) -> np.ndarray:
        """Adds the pass to x in place but for its last bias, which it gives back; `bias` is that of the pass before."""
        nodes, width = x.shape
        y, mean = room("normed", nodes, width), room("mean", 1, width)
        normalise(x.numpy(), bias, self.scale, self.shift, x.numpy().dtype.type(self.small), y.numpy(), mean[0].numpy())
        shift = self.bias
        if self.context is not None:
            shift = shift.clone()
            if batch.bodies == 1:
                shift[2 * width :] += self.context(mean)[0]
        ends = torch.addmm(shift, y, self.ends, out=room("ends", nodes, 3 * width))
        found = room("messages", nodes, width)
        gather_messages(batch.graph.offset, batch.graph.neighbour, edge, ends.numpy(), self.edge, found.numpy())
        hidden = torch.addmm(ends[:, 2 * width :], found, self.gathered, out=room("hidden", nodes, width))
        if self.context is not None and batch.bodies > 1:
            hidden += self.context(batch.mean(y))[batch.member]
        functional.silu(hidden, inplace=True)
        for k, (weight, more) in enumerate(self.hidden):
            hidden = torch.addmm(more, hidden, weight, out=room(f"deep{k}", nodes, width))
            functional.silu(hidden, inplace=True)
        x.addmm_(hidden, self.last)
        return self.last_bias


class _Fast(nn.Module):
    """A fast module around the slow one; it follows it to another precision."""

    def __init__(self, slow: nn.Module):
        super().__init__()
        self.slow: Any = slow
        self._read()

    def _read(self) -> None:
        """Takes over the weights of the slow module."""
        raise NotImplementedError

    def _apply(self, fn: Any, recurse: bool = True) -> Any:
        super()._apply(fn, recurse)
        self._read()
        return self


class FastProcessor(_Fast):
    """`Processor` without gradients; what it gives back is overwritten by the next call."""

    def _read(self) -> None:
        norm = self.slow.norm
        self._passes = [_FastPass(layer) for layer in self.slow.passes]
        self._norm = norm.weight.detach().numpy(), norm.bias.detach().numpy(), norm.eps
        self._room = _Buffers(norm.weight.dtype)

    def forward(
        self,
        batch: Wiring,
        node: Float[torch.Tensor, "nodes features"],
        edge: Float[torch.Tensor, "directed edge_features"],
    ) -> Float[torch.Tensor, "nodes width"]:
        """See `Processor.forward`."""
        x = self.slow.encoder(node)
        given = _full(edge, self._room)
        bias = np.zeros(x.shape[1], x.numpy().dtype)
        for k in range(self.slow.depth):
            bias = self._passes[k % len(self._passes)](batch, x, given, bias, self._room)
        out, mean = self._room("latent", *x.shape), self._room("mean", 1, x.shape[1])
        scale, shift, small = self._norm
        normalise(x.numpy(), bias, scale, shift, bias.dtype.type(small), out.numpy(), mean[0].numpy())
        return out


class FastEdgeDecoder(_Fast):
    """`EdgeDecoder` without gradients; what it gives back is overwritten by the next call."""

    def _read(self) -> None:
        slow = self.slow
        self._half = slow.sender.weight.shape[0]
        self._ends = torch.cat([slow.receiver.weight, slow.sender.weight]).detach().T.contiguous()
        self._bias = torch.cat([slow.receiver.bias, torch.zeros(self._half, dtype=self._ends.dtype)]).detach()
        self._edge = filled(_across(slow.edge).numpy())
        self._last, self._last_bias = _across(slow.last), slow.last.bias.detach()
        self._room = _Buffers(self._ends.dtype)

    def forward(self, batch: Wiring, x: torch.Tensor, edge: torch.Tensor) -> torch.Tensor:
        """See `EdgeDecoder.forward`."""
        given = _full(edge, self._room)
        ends = torch.addmm(self._bias, x, self._ends, out=self._room("ends", len(x), 2 * self._half))
        hidden = self._room("hidden", len(edge), self._half)
        join_ends(batch.graph.offset, batch.graph.neighbour, given, ends.numpy(), self._edge, hidden.numpy())
        functional.silu(hidden, inplace=True)
        out = self._room("out", len(edge), self._last.shape[1])
        return torch.addmm(self._last_bias, hidden, self._last, out=out)


def _full(edge: torch.Tensor, room: _Buffers) -> np.ndarray:
    """Edge features with zeros up to FEATURES."""
    count = edge.shape[1]
    if count == FEATURES:
        return np.asarray(edge.contiguous().numpy())
    wide = room("edges", len(edge), FEATURES)
    wide[:, :count] = edge
    wide[:, count:] = 0.0
    return np.asarray(wide.numpy())


class FastFeatures:
    """`zsdt.tignn.features.features` with the edges in one compiled loop, into a buffer."""

    def __init__(self) -> None:
        self._rooms: dict[torch.dtype, _Buffers] = {}

    def __call__(
        self,
        batch: GraphBatch,
        state: NodeState,
        load: torch.Tensor,
        load_next: torch.Tensor,
        scales: Scales,
        magnitude: torch.Tensor,
        stress_input: bool = True,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """See `features`."""
        node = node_features(batch, state, load, load_next, scales, magnitude, stress_input)
        room = self._rooms.setdefault(batch.arm.dtype, _Buffers(batch.arm.dtype))
        edge = room("edge", len(batch.to), FEATURES)
        number = edge.numpy().dtype.type
        solid_edges(
            batch.graph.offset, batch.graph.neighbour, batch.arm.numpy(), state.displacement.numpy(),
            state.velocity.numpy(), magnitude.numpy(), batch.pitch.numpy(), number(scales.strain),
            number(scales.rate), number(LARGEST_FEATURE), edge.numpy(),
        )  # fmt: skip
        return node, edge


def accelerated(module: nn.Module) -> nn.Module:
    """A copy of a network whose processors and edge decoders are the fast ones; it shares the weights of the rest.

    Only for inference: no gradient runs through it, and it must not outlive a change of the weights. `eager_of` gives
    the network that it was made of.
    """
    fast: Any = module.__class__.__new__(module.__class__)
    fast.__dict__.update(module.__dict__)
    fast.__dict__["_modules"] = {name: _replaced(child) for name, child in module.named_children()}
    fast.__dict__["_eager"] = (module,)  # in a tuple, so that it is none of the parts
    return fast


def eager_of(module: nn.Module) -> nn.Module:
    """The network that an accelerated one was made of, or the given one."""
    kept = module.__dict__.get("_eager")
    return module if kept is None else kept[0]


def _replaced(module: nn.Module) -> nn.Module:
    if isinstance(module, Processor):
        return FastProcessor(module)
    if isinstance(module, EdgeDecoder):
        return FastEdgeDecoder(module)
    return module if isinstance(module, Perceptron) or not list(module.children()) else accelerated(module)
