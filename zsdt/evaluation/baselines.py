"""Predictions that know no physics: what every method has to beat."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from zsdt.tignn.engine import NodeField
from zsdt.trajectory import Body


@dataclass(frozen=True)
class _Held:
    """Fields of the present frame."""

    position: np.ndarray
    velocity: np.ndarray
    stress: np.ndarray


class StaticBaseline:
    """A picture in which nothing moves: the first frame for ever, with zero velocity.

    Its displacement and velocity RRMSE are 1 by construction, which is what gives the other figures their meaning.
    """

    name = "static"

    def prepare(self, body: Body) -> None:
        """Needs nothing of the body."""

    def start(self, fields: dict[str, NodeField], load: Float[np.ndarray, "nodes 3"]) -> _Held:
        """The first frame as it is given."""
        return _Held(fields["position"], fields["velocity"], fields["stress"])

    def step(self, state: _Held, load: Float[np.ndarray, "nodes 3"], load_next: Float[np.ndarray, "nodes 3"]) -> _Held:
        """The same frame again, at rest."""
        return replace(state, velocity=np.zeros_like(state.velocity))

    def read(self, state: _Held) -> dict[str, NodeField]:
        """Position [m], velocity [m/s] and stress [Pa]."""
        return {"position": state.position, "velocity": state.velocity, "stress": state.stress}

    def account(self, state: _Held) -> dict[str, float]:
        """No energies."""
        return {}


class InertiaBaseline(StaticBaseline):
    """Every free node keeps its first velocity; the stress stays. Good for a frame, wrong soon after."""

    name = "inertia"

    def prepare(self, body: Body) -> None:
        """Takes the frame time [s] and the clamp from the body."""
        self._dt, self._free = body.frame_dt, ~body.clamped[:, None]

    def step(self, state: _Held, load: Float[np.ndarray, "nodes 3"], load_next: Float[np.ndarray, "nodes 3"]) -> _Held:
        """One frame of straight flight."""
        velocity = np.where(self._free, state.velocity, 0.0)
        return replace(state, position=state.position + self._dt * velocity, velocity=velocity)


class FromInitialStress:
    """Wraps an engine so that its first stress comes from a network (Psi_ini) instead of from the data.

    `initial` is anything with `infer(body, positions [nodes, 3] m) -> stress [nodes, 6] Pa`.
    """

    def __init__(self, engine: Any, initial: Any):
        self.engine, self.initial = engine, initial
        self.name = f"{engine.name}+psi_ini"

    def prepare(self, body: Body) -> None:
        """Prepares the engine and keeps the body for the network."""
        self._body = body
        self.engine.prepare(body)

    def start(self, fields: dict[str, NodeField], load: Float[np.ndarray, "nodes 3"]) -> Any:
        """Starts the engine with positions and velocities of the data and the inferred stress."""
        stress = self.initial.infer(self._body, fields["position"])
        return self.engine.start({**fields, "stress": np.asarray(stress, np.float64)}, load)

    def step(self, state: Any, load: Float[np.ndarray, "nodes 3"], load_next: Float[np.ndarray, "nodes 3"]) -> Any:
        """One frame of the engine."""
        return self.engine.step(state, load, load_next)

    def read(self, state: Any) -> dict[str, NodeField]:
        """Fields of the engine."""
        return self.engine.read(state)

    def account(self, state: Any) -> dict[str, float]:
        """Energies of the engine."""
        return self.engine.account(state)
