"""What every method that predicts a body looks like from outside, so that a rollout need not know which it is.

The two forms of the graph network, the black box, a coarse solver and the picture in which nothing moves all
implement `Engine`. Arrays at this border are numpy float64 in SI.
"""

from __future__ import annotations

import importlib
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from zsdt.errors import DataError, RunRejected
from zsdt.trajectory import Body, Trajectory

NodeField = Float[np.ndarray, "nodes components"]


@runtime_checkable
class Engine(Protocol):
    """A method that predicts a body frame by frame."""

    name: str

    def prepare(self, body: Body) -> None:
        """Everything that depends on the body alone (graph, tables); not counted as time of a frame."""

    def start(self, fields: dict[str, NodeField], load: Float[np.ndarray, "nodes 3"]) -> Any:
        """State at the first frame from its fields (position m, velocity m/s, stress Pa) and load [N]."""

    def step(self, state: Any, load: Float[np.ndarray, "nodes 3"], load_next: Float[np.ndarray, "nodes 3"]) -> Any:
        """State one frame later; the load [N] runs linearly from `load` to `load_next`."""

    def read(self, state: Any) -> dict[str, NodeField]:
        """Fields of a state: position, velocity, stress, and elastic and dissipated energy where it knows them."""

    def account(self, state: Any) -> dict[str, float]:
        """Energies of a state in joules (kinetic, elastic, dissipated, work_of_ports, ...); empty if it has none."""


@dataclass
class Rollout:
    """What an engine predicted for a trajectory, from its first frame on.

    fields: name -> [frames, nodes, components]; the first frame is the given one. milliseconds [frames - 1]: wall
    time of each step with the read-out. account: name -> [frames] J. diverged_at: first frame with a number that
    is not finite or that the engine refused (RunRejected), None where there is none; from there on frames are NaN.
    graph_milliseconds [frames - 1]: the share of `milliseconds` that went into building graphs (zero where they
    do not change). reason: cause and words of the engine where it refused, empty where it did not.
    """

    name: str
    fields: dict[str, Float[np.ndarray, "frames nodes components"]]
    milliseconds: Float[np.ndarray, " steps"]
    account: dict[str, Float[np.ndarray, " frames"]] = field(default_factory=dict)
    diverged_at: int | None = None
    graph_milliseconds: Float[np.ndarray, " steps"] = field(default_factory=lambda: np.zeros(0))
    reason: str = ""


def roll_out(engine: Engine, trajectory: Trajectory, frames: int | None = None) -> Rollout:
    """Runs `engine` from the first frame of `trajectory` under its loads for `frames` frames (all by default)."""
    count = trajectory.frames if frames is None else frames
    body, load = trajectory.body, trajectory.load
    engine.prepare(body)
    try:
        state = engine.start(trajectory.at(0), load[0])
    except RunRejected as error:  # a method that cannot even begin has predicted nothing but the frame it was given
        nothing = {name: np.full((count, *values.shape[1:]), np.nan) for name, values in trajectory.fields.items()}
        for name, frames_of in nothing.items():
            frames_of[0] = trajectory.fields[name][0]
        unknown = np.full(count - 1, np.nan)
        return Rollout(engine.name, nothing, unknown, {}, min(1, count - 1), unknown, refusal(error))
    first = engine.read(state)
    fields = {name: np.full((count, *values.shape), np.nan) for name, values in first.items()}
    accounts = {name: np.full(count, np.nan) for name in engine.account(state)}
    milliseconds, graph_milliseconds = np.full(count - 1, np.nan), np.full(count - 1, np.nan)
    diverged_at, reason = None, ""

    def keep(frame: int, values: dict[str, NodeField]) -> None:
        for name, value in values.items():
            fields[name][frame] = value
        for name, joules in engine.account(state).items():
            accounts[name][frame] = joules

    keep(0, first)
    for frame in range(1, count):
        began = time.perf_counter()
        try:
            state = engine.step(state, load[frame - 1], load[frame])
        except RunRejected as error:  # a method that watches itself gives up before its numbers do
            diverged_at, reason = frame, refusal(error)
            break
        values = engine.read(state)
        milliseconds[frame - 1] = 1e3 * (time.perf_counter() - began)
        graph_milliseconds[frame - 1] = getattr(engine, "graph_milliseconds", 0.0)  # of the last step, if it knows
        if not all(np.isfinite(v).all() for v in values.values()):
            diverged_at = frame
            break
        keep(frame, values)
    return Rollout(engine.name, fields, milliseconds, accounts, diverged_at, graph_milliseconds, reason)


def refusal(error: RunRejected) -> str:
    """Cause and words of a rejection in one line."""
    return f"{error.cause}: {error}"


# Loaders of trained engines by the `kind` that their artifact names; each room registers its own.
_LOADERS: dict[str, Callable[[Path], Engine]] = {}
_HOMES = {  # kind -> module that registers it
    "cell": "cell_engine",
    "node": "node_engine",
    "particle": "particle_engine",
    "liquid_node": "liquid_engine",
    "seed": "seed_engine",
}


def register_engine(kind: str, loader: Callable[[Path], Engine]) -> None:
    """Says how an artifact folder of this `kind` becomes an engine."""
    _LOADERS[kind] = loader


def load_engine(folder: str | Path) -> Engine:
    """The trained engine in an artifact folder (`engine.json` names its kind; the weights lie beside it).

    Raises: DataError where the folder holds no engine or one of an unknown kind.
    """
    card = Path(folder) / "engine.json"
    if not card.is_file():
        raise DataError(f"{folder} holds no trained engine (engine.json is missing); train one first.")
    kind = json.loads(card.read_text())["kind"]
    if kind not in _LOADERS and kind in _HOMES:
        importlib.import_module(f"zsdt.tignn.{_HOMES[kind]}")  # registers its kind; no other engine is imported

    if kind not in _LOADERS:
        raise DataError(f"{card} names the engine kind '{kind}', known are {', '.join(sorted({*_HOMES, *_LOADERS}))}.")
    engine = _LOADERS[kind](Path(folder))
    vars(engine)["folder"] = Path(folder)  # what lies beside the weights belongs to them (`zsdt.twin.trust_limits`)
    return engine
