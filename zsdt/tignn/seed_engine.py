"""The seed's literal network as an `Engine` for both scenes, and its artifact folder (form=seed).

Nothing of DESIGN 4.2 is in it: kinematics are predicted like everything else, scales are those of every component, a
frame is one explicit step `z+ = z + dt rate`, walls of a vessel are nodes. Clamped nodes are held where they are.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from zsdt.errors import DataError, OptionError, RunRejected
from zsdt.files import atomic_path
from zsdt.graph import graph_of
from zsdt.tignn.engine import NodeField, register_engine
from zsdt.tignn.liquid_body import LiquidBody
from zsdt.tignn.node_engine import card_of, options_from
from zsdt.tignn.options import Bracket, Energy, Form, LiquidOptions, TignnOptions, Walls
from zsdt.tignn.seed_literal import SeedNetwork, SeedRates, SeedSizes
from zsdt.trajectory import Body

KIND = "seed"
SOLID, LIQUID = ("position", "velocity", "stress"), ("position", "velocity", "internal_energy")
SIZES = {SOLID: SeedSizes(12, 3), LIQUID: SeedSizes(7)}


def literal_options(**changes: Any) -> TignnOptions:
    """The seed's own sizes: 7 passes of shared weights, 2 hidden layers of 100, lambda_d 50, walls as nodes."""
    given: dict[str, Any] = {
        "form": Form.seed,
        "bracket": Bracket.soft,
        "energy": Energy.learned,
        "passes": 7,
        "width": 100,
        "hidden_layers": 2,
        "shared_weights": True,
        "lambda_d": 50.0,
        "global_context": False,
        "staggered": False,
        "liquid": LiquidOptions(walls=Walls.nodes),
    }
    return TignnOptions(**(given | changes))


@dataclass
class SeedScales:
    """Mean and standard deviation of every component of the state and of the force over the training set (SI)."""

    mean: list[float]
    spread: list[float]
    force_mean: list[float]
    force_spread: list[float]


@dataclass(frozen=True)
class SeedGraph:
    """Receivers and senders of the directed edges, and what kind a node is [nodes, 1] (1: it moves freely)."""

    to: torch.Tensor
    source: torch.Tensor
    kind: torch.Tensor


class SeedModel(nn.Module):
    """Network and scales together. Works on the scaled state z [nodes, d].

    Raises: OptionError where the options ask for another bracket than the seed's.
    """

    def __init__(self, options: TignnOptions, scales: SeedScales):
        super().__init__()
        if options.bracket is not Bracket.soft or options.energy is not Energy.learned:
            raise OptionError("form=seed is the seed's own network; it takes bracket=soft and energy=learned only.")
        self.options, self.scales = options, scales
        self.fields = SOLID if len(scales.force_mean) else LIQUID
        self.network = SeedNetwork(
            SIZES[self.fields], options.width, options.hidden_layers, options.passes, options.shared_weights
        )

    def scaled(self, fields: dict[str, NodeField]) -> Float[torch.Tensor, "nodes d"]:
        """State in units of the training set from fields in SI."""
        z = np.concatenate([fields[name] for name in self.fields], axis=1)
        return torch.as_tensor((z - self.scales.mean) / self.scales.spread, dtype=self.dtype)

    def scaled_force(self, load: Float[np.ndarray, "nodes 3"]) -> torch.Tensor | None:
        """External force in units of the training set; None for a liquid."""
        if self.fields is LIQUID:
            return None
        return torch.as_tensor((load - self.scales.force_mean) / self.scales.force_spread, dtype=self.dtype)

    @property
    def dtype(self) -> torch.dtype:
        """Precision of the weights."""
        return next(self.parameters()).dtype

    def split(self, z: Float[torch.Tensor, "nodes d"]) -> dict[str, NodeField]:
        """Fields in SI of a scaled state."""
        si = z.detach().double().numpy() * self.scales.spread + self.scales.mean
        cut = (0, 3, 6, si.shape[1])
        return {name: si[:, a:b] for name, a, b in zip(self.fields, cut[:-1], cut[1:], strict=True)}

    def forward(self, z: Float[torch.Tensor, "nodes d"], force: torch.Tensor | None, graph: SeedGraph) -> SeedRates:
        """Rates of the scaled state per second."""
        arm = z[:, :3].index_select(0, graph.source) - z[:, :3].index_select(0, graph.to)
        edge = torch.cat([arm, arm.norm(dim=1, keepdim=True)], dim=1)
        node = torch.cat([z[:, 3:], graph.kind], dim=1)
        return self.network(node, edge, force, graph.to, graph.source)


class SeedBody:
    """The graph of a body: its own pairs, or those within a radius of the moment, walls as nodes."""

    def __init__(self, body: Body, model: SeedModel):
        self.body, self.dtype, self.graph_milliseconds = body, model.dtype, 0.0
        self.liquid = LiquidBody(body, model.options) if body.liquid is not None else None
        if self.liquid is None:
            self._fixed = _directed(graph_of(body.nodes, body.pairs), ~body.clamped, model.dtype)

    def graph(self, position: Float[np.ndarray, "nodes 3"]) -> tuple[SeedGraph, Float[np.ndarray, "walls 3"]]:
        """Edges of the moment, and the wall points that take part (after the body's own nodes)."""
        if self.liquid is None:
            return self._fixed, np.zeros((0, 3))
        links = self.liquid.connect(position)
        self.graph_milliseconds = self.liquid.graph_milliseconds
        fluids = self.liquid.fluids
        moving = np.arange(len(links.nodes)) < fluids
        to = torch.from_numpy(np.repeat(np.arange(len(links.nodes)), np.diff(links.offset)))
        kind = torch.as_tensor(moving[:, None], dtype=self.dtype)
        graph = SeedGraph(to, torch.from_numpy(links.neighbour), kind)
        return graph, self.liquid.wall_points[links.nodes[fluids:] - fluids]


def _directed(graph: Any, free: np.ndarray, dtype: torch.dtype) -> SeedGraph:
    to = torch.from_numpy(np.repeat(np.arange(graph.nodes), np.diff(graph.offset)))
    return SeedGraph(to, torch.from_numpy(graph.neighbour), torch.as_tensor(free[:, None], dtype=dtype))


def with_walls(model: SeedModel, z: torch.Tensor, walls: Float[np.ndarray, "walls 3"]) -> torch.Tensor:
    """The state with rows for the points of the wall: at rest, without energy."""
    if not len(walls):
        return z
    still = np.zeros((len(walls), 3)), np.zeros((len(walls), z.shape[1] - 6))
    rows = model.scaled(dict(zip(model.fields, (walls, *still), strict=True)))
    return torch.cat([z, rows])


class SeedEngine:
    """Predicts a body with a `SeedModel`, one explicit step a frame. See `Engine` for the methods."""

    def __init__(self, model: SeedModel, name: str = "seed literal"):
        self.model, self.name = model.eval(), name
        self._body: SeedBody | None = None

    @property
    def graph_milliseconds(self) -> float:
        """Wall time of the last step's graph [ms]; zero for a solid."""
        return self._body.graph_milliseconds if self._body is not None else 0.0

    def prepare(self, body: Body) -> None:
        """The graph, or what it is made of. Raises: OptionError where the body is of the other kind."""
        if (body.liquid is not None) != (self.model.fields is LIQUID):
            raise OptionError("This network of the seed was trained on the other kind of body; train one for this.")
        self._body = SeedBody(body, self.model)

    def start(self, fields: dict[str, NodeField], load: Float[np.ndarray, "nodes 3"]) -> torch.Tensor:
        """The scaled state of the first frame."""
        return self.model.scaled(fields)

    def step(
        self, state: torch.Tensor, load: Float[np.ndarray, "nodes 3"], load_next: Float[np.ndarray, "nodes 3"]
    ) -> torch.Tensor:
        """One explicit step of a frame. Raises: RunRejected where a position is not a number."""
        if self._body is None:
            raise DataError("The engine was not prepared for a body; call prepare(body) first.")
        with torch.inference_mode():
            graph, walls = self._body.graph(self.model.split(state)["position"])
            z = with_walls(self.model, state, walls)
            rates = self.model(z, self.model.scaled_force(load_next), graph).total[: len(state)]
            new = state + self._body.body.frame_dt * rates
            held = torch.from_numpy(self._body.body.clamped)
            new[held, :6] = state[held, :6]
        if not torch.isfinite(new).all():
            raise RunRejected("not_finite", "The seed's network blew up: a component of the state is not a number.")
        return new

    def read(self, state: torch.Tensor) -> dict[str, NodeField]:
        """Position m, velocity m/s, stress Pa or internal energy J/kg."""
        return self.model.split(state)

    def account(self, state: torch.Tensor) -> dict[str, float]:
        """No energies: the seed's are in units of their own, and its penalty does not close them."""
        return {}


def save_engine(model: SeedModel, folder: str | Path) -> None:
    """Writes `engine.json` and `weights.pt` of a model."""
    folder = Path(folder)
    card = {"kind": KIND, "options": card_of(model.options, "liquid"), "scales": asdict(model.scales)}
    with atomic_path(folder / "weights.pt") as beside:
        torch.save(model.state_dict(), beside)
    with atomic_path(folder / "engine.json") as beside:
        beside.write_text(json.dumps(card, indent=1))


def load_model(folder: str | Path) -> SeedModel:
    """The model of an artifact folder. Raises: DataError where files are missing or do not fit together."""
    folder = Path(folder)
    try:
        card = json.loads((folder / "engine.json").read_text())
        model = SeedModel(replace(options_from(card["options"]), form=Form.seed), SeedScales(**card["scales"]))
        model.load_state_dict(torch.load(folder / "weights.pt", weights_only=True))
    except (OSError, KeyError, ValueError, RuntimeError, TypeError) as error:
        raise DataError(f"The trained engine in {folder} cannot be read ({error}); train it again.") from error
    return model


register_engine(KIND, lambda folder: SeedEngine(load_model(folder)))
