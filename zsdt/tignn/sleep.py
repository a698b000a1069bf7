"""Bodies at rest sleep: a whole body that has not moved for a while is left as it is until something changes.

A body sleeps as a whole or not at all: pieces asleep beside pieces awake would exchange momentum across a border that
answers no more, which opens the account of energy and momentum. What kinetic energy is left when it falls asleep turns
into heat, so that the account closes to rounding. It wakes in the very frame in which its load changes (an engine) or
in which it is seen elsewhere (a twin).
"""

from __future__ import annotations

import copy
from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from zsdt.errors import OptionError
from zsdt.tignn.engine import Engine, NodeField
from zsdt.trajectory import Body


@dataclass
class SleepOptions:
    """still [m]: a body none of whose nodes went further than that within `calm` [s] falls asleep; 0: never. wake [m]:
    a sleeping twin wakes when what is seen of it is by so much further off than when it fell asleep (root mean square
    over the points), which also bounds what its sleep can hide."""

    still: float = 0.0
    calm: float = 0.5
    wake: float = 1e-3

    def __post_init__(self) -> None:
        if self.still < 0 or self.calm <= 0 or self.wake <= 0:
            raise OptionError("still of a sleep must not be negative, calm and wake must be positive.")


class Sleeper:
    """Watches how far a body goes, and says whether it is at rest.

    asleep: until `wake`.
    """

    def __init__(self, options: SleepOptions, frame_dt: float):
        self.options = options
        self.patience = max(2, int(np.ceil(options.calm / frame_dt)))
        self.wake()

    def wake(self) -> None:
        """It moves, or is about to."""
        self.asleep, self._frames, self._usual = False, 0, float("nan")
        self._low: Float[np.ndarray, "nodes 3"] | None = None
        self._high: Float[np.ndarray, "nodes 3"] | None = None

    def copy(self) -> Sleeper:
        """One that shares nothing that changes."""
        own = copy.copy(self)
        own._low = None if self._low is None else self._low.copy()
        own._high = None if self._high is None else self._high.copy()
        return own

    def is_disturbed(self, distance: Float[np.ndarray, " points"]) -> bool:
        """Whether a sleeping body is seen elsewhere. distance [points] m: of what is seen from where it sleeps, NaN
        where nothing is seen; the first one says how far off it usually is."""
        known = distance[np.isfinite(distance)]
        if not len(known):
            return False
        off = float(np.sqrt(np.mean(known**2)))
        if np.isnan(self._usual):
            self._usual = off
        return off > self._usual + self.options.wake

    def note(
        self, position: Float[np.ndarray, "nodes 3"], distance: Float[np.ndarray, " points"] | None = None
    ) -> bool:
        """Where the nodes are [m] in this frame, and how far from there they are seen; gives back whether the body
        falls asleep by it."""
        if self.options.still == 0.0 or self.asleep:
            return False
        if self._low is None or self._high is None:
            self._low, self._high = position.copy(), position.copy()
        np.minimum(self._low, position, out=self._low)
        np.maximum(self._high, position, out=self._high)
        if not float((self._high - self._low).max()) <= self.options.still:
            self.wake()
            return False
        self._frames += 1
        self.asleep = self._frames >= self.patience
        if self.asleep and distance is not None:
            self.is_disturbed(distance)
        return self.asleep


def come_to_rest(engine: Any, state: Any) -> Any:
    """The state without velocity, its kinetic energy turned into heat: of a solid evenly over its cells, of a liquid
    particle by particle.

    Raises: OptionError for an engine whose energies are not its own.
    """
    if not hasattr(state, "velocity") or not (hasattr(state, "memory") or hasattr(state, "heat")):
        raise OptionError(f"The engine '{engine.name}' has no account of heat, so its bodies cannot be put to sleep.")
    new = state.copy()
    if hasattr(state, "memory"):
        kinetic = float(0.5 * (engine.inertia[:, None] * state.velocity**2).sum())
        cells = len(engine.body.cells)
        new.memory.heat[:cells] += kinetic / (cells * engine.body.pitch**3)
    else:
        new.heat += 0.5 * engine.constants.mass * (state.velocity**2).sum(axis=1)
    new.velocity[:] = 0.0
    return new


@dataclass
class Dozing:
    """State of a `SleepingEngine`: the engine's own, who watches it, and the load under which it rests."""

    inner: Any
    sleeper: Sleeper
    load: NodeField
    skipped: int = 0  # frames


class SleepingEngine:
    """An engine whose bodies sleep while they rest under a load that does not change; see `Engine` for the methods."""

    def __init__(self, engine: Engine, options: SleepOptions):
        self.engine, self.options, self.name = engine, options, f"{engine.name}+sleep"

    def prepare(self, body: Body) -> None:
        """Prepares the engine."""
        self.body = body
        self.engine.prepare(body)

    def start(self, fields: dict[str, NodeField], load: Float[np.ndarray, "nodes 3"]) -> Dozing:
        """The engine's state, awake."""
        return Dozing(self.engine.start(fields, load), Sleeper(self.options, self.body.frame_dt), load.copy())

    def step(
        self, state: Dozing, load: Float[np.ndarray, "nodes 3"], load_next: Float[np.ndarray, "nodes 3"]
    ) -> Dozing:
        """One frame of the engine, or none: a sleeping body stays as it is; a load that changes wakes it in this
        frame."""
        same = np.array_equal(load, state.load) and np.array_equal(load_next, state.load)
        if state.sleeper.asleep and same:
            return replace(state, skipped=state.skipped + 1)
        sleeper = state.sleeper.copy()
        if not same:
            sleeper.wake()
        inner = self.engine.step(state.inner, load, load_next)
        if sleeper.note(_places(inner)):
            inner = come_to_rest(self.engine, inner)
        return replace(state, inner=inner, sleeper=sleeper, load=load_next.copy())

    def read(self, state: Dozing, names: Collection[str] | None = None) -> dict[str, NodeField]:
        """Fields of the engine."""
        read: Any = self.engine.read
        return read(state.inner) if names is None else read(state.inner, names)

    def account(self, state: Dozing) -> dict[str, float]:
        """Energies of the engine."""
        return self.engine.account(state.inner)


def _places(state: Any) -> Float[np.ndarray, "nodes 3"]:
    """What moves of a state [m]: displacements of a solid, positions of a liquid."""
    return state.u[:-1] if hasattr(state, "u") else state.position
