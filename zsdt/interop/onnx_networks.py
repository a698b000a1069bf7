"""The networks as functions of named tensors alone, which is what an ONNX graph is.

Every class says its inputs (name -> shape of dimension names and numbers) and outputs. Index inputs (`to`, `source`,
`pairs`, `rows`) are int64, all others float32; dimensions with a name may have any length at run time.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import torch
from torch import nn

from zsdt.errors import OptionError
from zsdt.perception.segmentation import folded
from zsdt.perception.unet import UNet
from zsdt.tignn.augment import section_symmetries, turn_batch, turn_load, turn_state
from zsdt.tignn.features import GraphBatch, NodeState
from zsdt.tignn.liquid_features import BASIS, LiquidBatch
from zsdt.tignn.liquid_features import EDGE_FEATURES as LIQUID_EDGE
from zsdt.tignn.liquid_features import NODE_FEATURES as LIQUID_NODE
from zsdt.tignn.liquid_model import LiquidModel
from zsdt.tignn.model import NodeModel
from zsdt.tignn.node_engine import card_of as options_card
from zsdt.tignn.options import Bracket, Energy
from zsdt.tignn.plain_wiring import PlainBatch, PlainLiquid, PlainWiring, wiring_fields
from zsdt.tignn.psi_ini import EDGE_FEATURES as SOLID_EDGE
from zsdt.tignn.psi_ini import NODE_FEATURES as SOLID_NODE
from zsdt.tignn.psi_ini import Inputs, PsiIniNetwork
from zsdt.tignn.psi_ini_liquid import LiquidPsiIniNetwork
from zsdt.tignn.psi_ini_liquid_features import BASIS as PUSHES
from zsdt.tignn.psi_ini_liquid_features import EDGE_FEATURES as PUSHED_EDGE
from zsdt.tignn.psi_ini_liquid_features import NODE_FEATURES as PUSHED_NODE
from zsdt.tignn.psi_ini_liquid_features import LiquidInputs
from zsdt.tignn.wiring import Wiring

Shape = tuple[str | int, ...]
INDICES = ("to", "source", "pairs", "rows")
WIRING: dict[str, Shape] = {"to": ("directed",), "source": ("directed",)}
PAIRED: dict[str, Shape] = {"pairs": ("pairs", 2), "rows": ("pairs", 2)}


class Exportable(Protocol):
    """A network of named tensors; kind: what it is, for a reader of the file."""

    kind: str
    inputs: dict[str, Shape]
    outputs: tuple[str, ...]

    def __call__(self, *tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Outputs from the inputs in their order."""


def step_tensors(
    names: Sequence[str], batch: GraphBatch, state: NodeState, load: torch.Tensor, load_next: torch.Tensor
) -> dict[str, torch.Tensor]:
    """Those inputs of a `StepNetwork` that are named, for one moment of a body."""
    every = _attributes(batch, names) | vars(state) | {"load": load, "load_next": load_next} | wiring_tensors(batch)
    return {name: every[name].contiguous() for name in names}


def moment_tensors(names: Sequence[str], moment: LiquidBatch | Inputs | LiquidInputs) -> dict[str, torch.Tensor]:
    """Those inputs of the network of a liquid's step, or of Psi_ini, that are named, for one moment."""
    wiring = (
        moment if isinstance(moment, LiquidBatch) else moment.batch if isinstance(moment, Inputs) else moment.wiring
    )
    every = _attributes(moment, names) | wiring_tensors(wiring)
    return {name: every[name].contiguous() for name in names}


def _attributes(thing: Any, names: Sequence[str]) -> dict[str, torch.Tensor]:
    return {name: getattr(thing, name) for name in names if isinstance(getattr(thing, name, None), torch.Tensor)}


def wiring_tensors(batch: Wiring) -> dict[str, torch.Tensor]:
    """The index inputs of a body."""
    pairs, rows = torch.from_numpy(batch.graph.pairs), torch.from_numpy(batch.halves)
    return {"to": batch.to, "source": batch.source, "pairs": pairs, "rows": rows}


class _Named(nn.Module):
    """Inputs by name."""

    kind = ""

    def __init__(self, inputs: Mapping[str, Shape], outputs: Sequence[str]):
        super().__init__()
        self.inputs, self.outputs = dict(inputs), tuple(outputs)

    def named(self, tensors: Sequence[torch.Tensor]) -> dict[str, torch.Tensor]:
        """Tensors by their names."""
        return dict(zip(self.inputs, tensors, strict=True))


class StepNetwork(_Named):
    """One frame step of the node form of a solid: state, load [N] at both ends of the frame, graph -> new state, SI."""

    kind = "node"

    def __init__(self, model: NodeModel):
        options = model.options
        state: dict[str, Shape] = {
            "displacement": ("nodes", 3),
            "velocity": ("nodes", 3),
            "stress": ("nodes", 6),
            "increments": ("nodes", 3 * options.history),
            "thermal": ("nodes", model.thermal),
        }
        state = {name: shape for name, shape in state.items() if shape[1]}
        graph: dict[str, Shape] = {
            "arm": ("directed", 3),
            "gravity": ("nodes", 3),
            **{name: ("nodes", 1) for name in ("free", "surface", "dt", "pitch", "mass", "volume")},
            **WIRING,
            **(PAIRED if options.bracket is Bracket.exact else {}),
        }
        if options.energy is not Energy.physical:
            del graph["mass"], graph["volume"]
        loads: dict[str, Shape] = {"load": ("nodes", 3), "load_next": ("nodes", 3)}
        super().__init__(state | loads | graph, [f"{name}_next" for name in state])
        self.state_names = tuple(state)
        self.turns = section_symmetries() if options.symmetric else None
        self.network = NodeModel(dataclasses.replace(options, symmetric=False), model.scales)
        self.network.load_state_dict(model.state_dict())
        self.network.float().eval()

    def forward(self, *tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """See the class; inputs as in `inputs`."""
        given = self.named(tensors)
        free = given["free"]
        none, zero = free[:, :0], torch.zeros_like(free)
        state = NodeState(**{f.name: given.get(f.name, none) for f in dataclasses.fields(NodeState)})
        names = ("arm", "free", "surface", "dt", "pitch", "mass", "volume", "gravity")
        own: dict[str, Any] = {name: given.get(name, zero) for name in names}
        wiring = wiring_fields(free, given["to"], given["source"], given.get("pairs"), given.get("rows"))
        batch = PlainBatch(**wiring, **own)
        loads = given["load"], given["load_next"]
        new = self._mean(batch, state, loads) if self.turns is not None else self.network(batch, state, *loads).state
        return tuple(getattr(new, name) for name in self.state_names)

    def _mean(self, batch: PlainBatch, state: NodeState, loads: tuple[torch.Tensor, torch.Tensor]) -> NodeState:
        """Mean over the eight symmetries of the cross-section (`symmetric`)."""
        assert self.turns is not None
        found = []
        for turn in self.turns:
            turned = [turn_load(load, turn) for load in loads]
            step = self.network(turn_batch(batch, turn), turn_state(state, turn), *turned)
            found.append(turn_state(step.state, turn.T))
        return NodeState(**{n: torch.stack([getattr(f, n) for f in found]).mean(0) for n in vars(state)})


class LiquidStepNetwork(_Named):
    """The network of one frame step of the node form of a liquid: features of a moment (those that
    `zsdt.tignn.liquid_features.look` makes) -> increments of velocity [m/s] and internal energy [J/kg] of the nodes.

    Raises: OptionError where the bracket solves a system of equations at every step.
    """

    kind = "liquid_node"

    def __init__(self, model: LiquidModel):
        options = model.options
        if model.conserves:
            raise OptionError(
                "A liquid's network with energy=physical solves for the impulses between all particles at every step "
                "by compiled conjugate gradients, which is no ONNX graph; export one with energy=learned, or run it "
                "with zsdt."
            )
        inputs: dict[str, Shape] = {
            "node": ("nodes", LIQUID_NODE),
            "edge": ("directed", LIQUID_EDGE),
            "basis": ("nodes", BASIS, 3),
            "arm": ("directed", 3),
            "rate": ("directed", 3),
            "fluid": ("nodes", 1),
            "near": ("nodes", 1),
            "gravity": ("nodes", 3),
            "load": ("nodes", 3),
            **WIRING,
            **(PAIRED if options.bracket is Bracket.exact else {}),
        }
        if options.bracket is Bracket.none:
            del inputs["near"], inputs["gravity"]
        super().__init__(inputs, ("velocity_increment", "energy_increment"))
        self.network = model.float().eval()

    def forward(self, *tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """See the class; inputs as in `inputs`."""
        given = self.named(tensors)
        fluid = given["fluid"]
        wiring = wiring_fields(fluid, given["to"], given["source"], given.get("pairs"), given.get("rows"))
        names = {f.name for f in dataclasses.fields(LiquidBatch)} - {f.name for f in dataclasses.fields(Wiring)}
        own: dict[str, Any] = {name: given.get(name, fluid) for name in names}
        batch = PlainLiquid(**wiring, **own)
        total = self.network(batch).total[:, -4:]
        scales = self.network.scales
        return total[:, :3] * scales.d_velocity, total[:, 3:] * scales.d_energy


class SolidPsiIniNetwork(_Named):
    """Psi_ini of a solid: features of a body at rest (`zsdt.tignn.psi_ini.inputs_of`) -> Cauchy stress [Pa], order
    11 22 33 12 13 23."""

    kind = "psi_ini_solid"

    def __init__(self, network: PsiIniNetwork):
        inputs: dict[str, Shape] = {
            "node": ("nodes", SOLID_NODE),
            "edge": ("directed", SOLID_EDGE),
            "strain": ("nodes", 6),
            "deformation": ("nodes", 3, 3),
            "unit": ("nodes", 1),
            **WIRING,
        }
        super().__init__(inputs, ("stress",))
        self.network = network.eval()

    def forward(self, *tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """See the class; inputs as in `inputs`."""
        given = self.named(tensors)
        unit = given["unit"]
        wiring = wiring_fields(unit, given.pop("to"), given.pop("source"))
        # What else a body has is not read.
        rest: dict[str, Any] = {f.name: unit for f in dataclasses.fields(GraphBatch) if f.name not in wiring}
        batch = PlainBatch(**wiring, **rest)
        return (self.network(Inputs(batch=batch, **given)) * unit,)


class LiquidPsiIniOnnx(_Named):
    """Psi_ini of a liquid: features of its first frame (`zsdt.tignn.psi_ini_liquid_features.inputs_of`) -> velocity
    [m/s] and specific internal energy [J/kg]."""

    kind = "psi_ini_liquid"

    def __init__(self, network: LiquidPsiIniNetwork):
        inputs: dict[str, Shape] = {
            "node": ("nodes", PUSHED_NODE),
            "edge": ("directed", PUSHED_EDGE),
            "basis": ("nodes", PUSHES, 3),
            "speed": ("nodes", 1),
            "heat": ("nodes", 1),
            **WIRING,
        }
        super().__init__(inputs, ("velocity", "internal_energy"))
        self.network = network.eval()

    def forward(self, *tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """See the class; inputs as in `inputs`."""
        given = self.named(tensors)
        wiring = PlainWiring(**wiring_fields(given["speed"], given.pop("to"), given.pop("source")))
        velocity, energy = self.network(LiquidInputs(wiring=wiring, **given))
        return velocity * given["speed"], energy * given["heat"]


class MaskNetwork(_Named):
    """A segmentation U-Net: picture of values -0.5 ... 0.5, sides multiples of `multiple` -> probability by class."""

    kind = "unet"

    def __init__(self, network: UNet):
        super().__init__({"picture": ("batch", 3, "height", "width")}, ("probability",))
        self.multiple, self.classes = network.multiple, network.outputs
        self.network = folded(network)

    def forward(self, *tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """See the class."""
        return (torch.sigmoid(self.network(tensors[0])),)


def card_of(network: Any) -> dict[str, Any]:
    """What is written into the file beside the graph: kind, and options and scales where there are."""
    card: dict[str, Any] = {"kind": network.kind}
    inner = network.network
    if isinstance(inner, NodeModel | LiquidModel):
        nested = ("liquid",) if isinstance(inner, LiquidModel) else ()
        card |= {"options": options_card(inner.options, *nested), "scales": dataclasses.asdict(inner.scales)}
    if isinstance(network, StepNetwork):
        card["options"]["symmetric"] = network.turns is not None
    if isinstance(network, MaskNetwork):
        card |= {"multiple": network.multiple, "classes": network.classes}
    return card
