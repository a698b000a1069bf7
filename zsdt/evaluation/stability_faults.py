"""Spoils the state of a running method at one frame: an engine that is otherwise the given one."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
from jaxtyping import Float

from zsdt.errors import OptionError
from zsdt.tignn.cell_engine import CellState
from zsdt.tignn.engine import Engine
from zsdt.tignn.liquid_engine import LiquidRun
from zsdt.tignn.node_engine import NodeRun
from zsdt.tignn.particle_engine import ParticleState


def spoiling(engine: Engine, frame: int, value: Float[np.ndarray, "3"]) -> Any:
    """A copy of `engine` that before its step to `frame` adds `value` [m] (or NaN) to the place of its middle node.

    It is of the engine's own class, so that a twin takes it for one.
    """
    changed: Any = copy.copy(engine)
    kind: Any = type(engine)
    left = [frame]

    def step(self: Any, state: Any, load: np.ndarray, load_next: np.ndarray) -> Any:
        left[0] -= 1
        if left[0] == 0:
            state = copy.deepcopy(state)
            _add(state, value)
        return kind.step(self, state, load, load_next)

    changed.__class__ = type(f"Spoilt{kind.__name__}", (kind,), {"step": step})
    return changed


def _add(state: Any, value: Float[np.ndarray, "3"]) -> None:
    """Adds `value` to the place of the middle node of a state, in place. Raises: OptionError for unknown states."""
    if isinstance(state, CellState):
        state.u[len(state.u) // 2] += value
    elif isinstance(state, ParticleState):
        state.position[len(state.position) // 2] += value
    elif isinstance(state, NodeRun):
        displacement = state.state.displacement
        displacement[len(displacement) // 2] += displacement.new_tensor(value)
    elif isinstance(state, LiquidRun):
        state.state.position[len(state.state.position) // 2] += value
    else:
        raise OptionError(f"Nobody knows how to spoil a state of the kind {type(state).__name__}.")
