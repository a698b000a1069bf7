"""Predictions that know no physics: what every method has to beat."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from zsdt.tignn.engine import NodeField
from zsdt.trajectory import Body


@dataclass(frozen=True)
class _Held:
    """Fields of the present frame."""

    fields: dict[str, NodeField]

    def but(self, **changed: Float[np.ndarray, "nodes _"]) -> _Held:
        """The same with some fields changed."""
        return _Held({**self.fields, **changed})


class StaticBaseline:
    """A picture in which nothing moves: the first frame for ever, with zero velocity.

    Its displacement and velocity RRMSE are 1 by construction, which is what gives the other figures their meaning.
    """

    name = "static"

    def prepare(self, body: Body) -> None:
        """Needs nothing of the body."""

    def start(self, fields: dict[str, NodeField], load: Float[np.ndarray, "nodes 3"]) -> _Held:
        """The first frame as it is given, whatever its fields are."""
        return _Held(dict(fields))

    def step(self, state: _Held, load: Float[np.ndarray, "nodes 3"], load_next: Float[np.ndarray, "nodes 3"]) -> _Held:
        """The same frame again, at rest."""
        return state.but(velocity=np.zeros_like(state.fields["velocity"]))

    def read(self, state: _Held) -> dict[str, NodeField]:
        """The fields that it was given."""
        return state.fields

    def account(self, state: _Held) -> dict[str, float]:
        """No energies."""
        return {}


class InertiaBaseline(StaticBaseline):
    """Every free node keeps its first velocity; all else stays. Good for a frame, wrong soon after."""

    name = "inertia"

    def prepare(self, body: Body) -> None:
        """Takes the frame time [s] and the clamp from the body."""
        self._dt, self._free = body.frame_dt, ~body.clamped[:, None]

    def step(self, state: _Held, load: Float[np.ndarray, "nodes 3"], load_next: Float[np.ndarray, "nodes 3"]) -> _Held:
        """One frame of straight flight."""
        velocity = np.where(self._free, state.fields["velocity"], 0.0)
        return state.but(position=state.fields["position"] + self._dt * velocity, velocity=velocity)


class FromPsiIni:
    """Wraps an engine so that what no camera sees of the first frame comes from a network (Psi_ini), not from the data.

    `initial` is anything with `infer_fields(body, positions [nodes, 3] m) -> {field: values}`: the stress of a solid,
    velocity and internal energy of a liquid. `graph_milliseconds` are the engine's.
    """

    def __init__(self, engine: Any, initial: Any):
        self.engine, self.initial = engine, initial
        self.name = f"{engine.name}+psi_ini"

    @property
    def graph_milliseconds(self) -> float:
        """Time that the engine's last step spent on its graph [ms]."""
        return float(getattr(self.engine, "graph_milliseconds", 0.0))

    def prepare(self, body: Body) -> None:
        """Prepares the engine and keeps the body for the network."""
        self._body = body
        self.engine.prepare(body)

    def start(self, fields: dict[str, NodeField], load: Float[np.ndarray, "nodes 3"]) -> Any:
        """Starts the engine with the positions of the data and the fields that are inferred from them.

        Density and pressure of the data are withheld: no camera sees them either.
        """
        inferred = self.initial.infer_fields(self._body, fields["position"])
        seen = {name: values for name, values in fields.items() if name not in ("density", "pressure")}
        return self.engine.start({**seen, **inferred}, load)

    def step(self, state: Any, load: Float[np.ndarray, "nodes 3"], load_next: Float[np.ndarray, "nodes 3"]) -> Any:
        """One frame of the engine."""
        return self.engine.step(state, load, load_next)

    def read(self, state: Any) -> dict[str, NodeField]:
        """Fields of the engine."""
        return self.engine.read(state)

    def account(self, state: Any) -> dict[str, float]:
        """Energies of the engine."""
        return self.engine.account(state)
