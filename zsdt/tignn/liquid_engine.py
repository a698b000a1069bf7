"""The trained node form of a liquid as an `Engine`, and its artifact folder."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from zsdt.errors import DataError, RunRejected
from zsdt.files import atomic_path
from zsdt.tignn.engine import NodeField, register_engine
from zsdt.tignn.liquid_body import LiquidBody
from zsdt.tignn.liquid_features import LiquidScales, LiquidState, look
from zsdt.tignn.liquid_model import LiquidModel, Moved, advance
from zsdt.tignn.node_engine import card_of, learned_budget, options_from, probe_rates
from zsdt.tignn.options import Bracket
from zsdt.trajectory import Body

KIND = "liquid_node"


@dataclass
class LiquidRun:
    """State of a rollout and its account so far."""

    state: LiquidState
    account: dict[str, float]


class LiquidEngine:
    """Predicts a liquid with a `LiquidModel`, one step a frame.

    graph_milliseconds: wall time of the last step's graph. put_back: particles that the clamp at the wall moved so far.
    """

    def __init__(self, model: LiquidModel, name: str = "local-tignn", dtype: torch.dtype = torch.float32):
        self.model, self.name = model.to(dtype).eval(), name
        self.graph_milliseconds, self.put_back = 0.0, 0
        self._body: LiquidBody | None = None

    def prepare(self, body: Body) -> None:
        """Distances and wall nodes of the vessel. Raises: DataError where the body is no liquid in a vessel."""
        self._body, self.put_back = LiquidBody(body, self.model.options), 0
        self._points = body.points
        self._diagonal = float(np.linalg.norm(np.ptp(np.stack(self._body.vessel.bounds()), axis=0)))

    @property
    def body(self) -> LiquidBody:
        """The prepared liquid."""
        if self._body is None:
            raise DataError("The engine was not prepared for a body; call prepare(body) first.")
        return self._body

    def start(self, fields: dict[str, NodeField], load: Float[np.ndarray, "nodes 3"]) -> LiquidRun:
        """State at the first frame from position, velocity and internal_energy."""
        names = ("position", "velocity", "internal_energy")
        state = LiquidState(*(np.array(fields[name], dtype=np.float64) for name in names))
        return LiquidRun(state, self._account(state, {}, None))

    def step(
        self, state: LiquidRun, load: Float[np.ndarray, "nodes 3"], load_next: Float[np.ndarray, "nodes 3"]
    ) -> LiquidRun:
        """State one frame later.

        Raises: RunRejected where the motion blew up, or a particle went further than its vessel is long.
        """
        moved = advance(self.model, self.body, state.state, 0.5 * (load + load_next))
        furthest = float(np.sqrt(np.square(moved.state.position - self._points).sum(axis=1).max()))
        if not furthest <= self._diagonal:
            raise RunRejected(
                "left_range",
                f"A particle is {furthest:.3g} m from its beginning, the vessel only {self._diagonal:.3g} m across.",
            )
        self.graph_milliseconds = self.body.graph_milliseconds
        self.put_back += moved.put_back
        return LiquidRun(moved.state, self._account(moved.state, state.account, moved))

    def read(self, state: LiquidRun) -> dict[str, NodeField]:
        """Position m, velocity m/s, internal energy J/kg."""
        now = state.state
        return {"position": now.position, "velocity": now.velocity, "internal_energy": now.energy}

    def account(self, state: LiquidRun) -> dict[str, float]:
        """Physical energy: kinetic, potential, internal and work_of_ports (load and clamp) in J, as the solver's.
        Learned: kinetic, potential and internal in J, and the network's own budget in its own units; a plain decoder
        has the joules alone."""
        return dict(state.account)

    def energies(self, now: LiquidState) -> dict[str, float]:
        """Kinetic, potential and internal energy [J] of a state."""
        body = self.body
        return {
            "kinetic": float((0.5 * body.mass * np.square(now.velocity)).sum()),
            "potential": float(-(body.mass * (now.position @ body.gravity)[:, None]).sum()),
            "internal": float((body.mass * now.energy).sum()),
        }

    def _account(self, now: LiquidState, before: dict[str, float], moved: Moved | None) -> dict[str, float]:
        model, found = self.model, self.energies(now)
        if model.conserves:
            work = moved.work_of_load + moved.work_of_wall if moved is not None else 0.0
            return found | {"work_of_ports": before.get("work_of_ports", 0.0) + work}
        if model.options.bracket is Bracket.none:
            return found
        names = ("learned_energy_change", "learned_port_work", "learned_entropy_produced")
        gains = learned_budget(moved.rates) if moved is not None else (0.0, 0.0, 0.0)
        return found | {name: before.get(name, 0.0) + gain for name, gain in zip(names, gains, strict=True)}


def probe_liquid(
    model: LiquidModel, body: LiquidBody, state: LiquidState, load: Float[np.ndarray, "fluids 3"]
) -> dict[str, float]:
    """How well the bracket keeps its promises on one state; see `zsdt.tignn.node_engine.probe`. Use a double model."""
    with torch.inference_mode():
        dtype = next(model.parameters()).dtype
        return probe_rates(model(look(body, state, load, model.scales, model.options.global_context, dtype)))


def save_engine(model: LiquidModel, folder: str | Path) -> None:
    """Writes `engine.json` and `weights.pt` of a model."""
    folder = Path(folder)
    card = {"kind": KIND, "options": card_of(model.options, "liquid"), "scales": asdict(model.scales)}
    with atomic_path(folder / "weights.pt") as beside:
        torch.save(model.state_dict(), beside)
    with atomic_path(folder / "engine.json") as beside:
        beside.write_text(json.dumps(card, indent=1))


def load_model(folder: str | Path) -> LiquidModel:
    """The model of an artifact folder. Raises: DataError where files are missing or do not fit together."""
    folder = Path(folder)
    try:
        card = json.loads((folder / "engine.json").read_text())
        model = LiquidModel(options_from(card["options"]), LiquidScales(**card["scales"]))
        model.load_state_dict(torch.load(folder / "weights.pt", weights_only=True))
    except (OSError, KeyError, ValueError, RuntimeError, TypeError) as error:
        raise DataError(f"The trained engine in {folder} cannot be read ({error}); train it again.") from error
    return model


def _load(folder: Path) -> LiquidEngine:
    model = load_model(folder)
    black_box = model.options.bracket is Bracket.none
    return LiquidEngine(model, "black box" if black_box else f"local-tignn ({model.options.bracket.value})")


register_engine(KIND, _load)
