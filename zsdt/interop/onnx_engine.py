"""The node forms out of an ONNX file, as an `Engine`: what a rollout of the file is compared with, and how to use it.

The graph of a body, features of a liquid and the walls of its vessel stay with zsdt; the network is ONNX Runtime's.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from torch import nn

from zsdt.errors import DataError
from zsdt.interop.onnx_files import OnnxFile
from zsdt.interop.onnx_networks import LiquidStepNetwork, StepNetwork, moment_tensors, step_tensors
from zsdt.tignn.bracket import Rates
from zsdt.tignn.engine import Engine, Rollout
from zsdt.tignn.features import GraphBatch, NodeState, Scales
from zsdt.tignn.liquid_engine import LiquidEngine
from zsdt.tignn.liquid_features import LiquidBatch, LiquidScales
from zsdt.tignn.liquid_model import LiquidModel
from zsdt.tignn.model import NodeModel, Step
from zsdt.tignn.node_engine import NodeEngine, options_from
from zsdt.tignn.options import Bracket, Energy


@runtime_checkable
class NamedNetwork(Protocol):
    """What an `OnnxFile` shows: the names of its inputs, what was written about it, and a call on named tensors."""

    inputs: list[str]
    card: dict[str, Any]

    def __call__(self, tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Outputs by name."""


class OnnxStepModel(NodeModel):
    """A `NodeModel` whose forward pass is an ONNX file's; nothing of its brackets comes out."""

    def __init__(self, file: NamedNetwork):
        nn.Module.__init__(self)  # none of the layers of the base class
        self.file = file
        self.options, self.scales = options_from(file.card["options"]), Scales(**file.card["scales"])

    def forward(self, batch: GraphBatch, state: NodeState, load: torch.Tensor, load_next: torch.Tensor) -> Step:
        """See `NodeModel.forward`; without rates."""
        found = self.file(step_tensors(self.file.inputs, batch, state, load, load_next))
        new = {name.removesuffix("_next"): value for name, value in found.items()}
        return Step(replace(state, **new), [], torch.ones_like(batch.free))


class OnnxNodeEngine(NodeEngine):
    """`NodeEngine` on an ONNX file; it has no energy account, for the brackets do not leave the file."""

    def __init__(self, file: NamedNetwork):
        super().__init__(OnnxStepModel(file), "local-tignn (onnx)")

    def _energies(self, before: NodeState, account: dict[str, float], step: Step | None) -> dict[str, float]:
        return {}


class OnnxLiquidModel(LiquidModel):
    """A `LiquidModel` whose forward pass is an ONNX file's; all of the increment is booked as a port."""

    def __init__(self, file: NamedNetwork):
        nn.Module.__init__(self)  # none of the layers of the base class
        self.file = file
        options = options_from(file.card["options"])
        # The account asks what the brackets gave, which does not leave the file.
        self.options = replace(options, bracket=Bracket.none, energy=Energy.learned)
        self.scales = LiquidScales(**file.card["scales"])
        self.precision = nn.Parameter(torch.zeros(1), requires_grad=False)  # from which others read it

    def forward(self, batch: LiquidBatch) -> Rates:
        """See `LiquidModel.forward`."""
        found = self.file(moment_tensors(self.file.inputs, batch))
        velocity = found["velocity_increment"] / self.scales.d_velocity
        total = torch.cat([velocity, found["energy_increment"] / self.scales.d_energy], dim=1)
        zero = torch.zeros_like(total)
        return Rates(zero, zero, total)


def load_onnx_engine(path: str | os.PathLike[str], threads: int = 1) -> Engine:
    """The engine in an ONNX file that `python -m pipelines.export onnx` wrote.

    Raises: DataError where the file is missing, broken or holds another kind of network; OptionError where onnxruntime
    is not installed.
    """
    file = OnnxFile(path, threads)
    kind = file.card["kind"]
    if kind == StepNetwork.kind:
        return OnnxNodeEngine(file)
    if kind == LiquidStepNetwork.kind:
        return LiquidEngine(OnnxLiquidModel(file), "local-tignn (onnx)")
    raise DataError(
        f"The ONNX file {path} holds a network of the kind '{kind}', which predicts no frame after another."
    )


def rollout_difference(ours: Rollout, theirs: Rollout) -> Mapping[str, float]:
    """Largest difference of two rollouts over the largest value of a field; of positions over the largest
    displacement from the first frame. NaN in one of them counts as infinite.

    Raises: DataError where they have no field in common.
    """
    shared = [name for name in ours.fields if name in theirs.fields]
    if not shared:
        raise DataError("The two rollouts have no field in common; compare rollouts of the same body.")
    found = {}
    for name in shared:
        one, other = ours.fields[name], theirs.fields[name]
        size = np.abs(one - one[0] if name == "position" else one).max()
        gap = np.abs(one - other).max() / max(float(size), 1e-300)
        found[name] = float(gap) if np.isfinite(gap) else float("inf")
    return found
