"""The port through which an observer moves the particles of a liquid: what it does is work, and it is booked."""

from __future__ import annotations

from dataclasses import replace
from typing import no_type_check

import numpy as np
from jaxtyping import Float

from zsdt.tignn.particle_engine import ParticleEngine, ParticleState
from zsdt.tignn.particle_kernel import stored
from zsdt.tignn.particle_walls import _fast, side_distance


@_fast
@no_type_check
def keep_inside(walls, x, least):
    """Moves particles that are nearer than `least` [m] to a wall back to there."""
    side = np.empty(4)
    for i in range(x.shape[0]):
        for _ in range(3):  # a corner needs both walls in turn
            side_distance(walls, x[i, 0], x[i, 1], x[i, 2], side)
            if min(side[0], x[i, 2]) >= least:
                break
            if x[i, 2] < side[0]:
                side[0], side[1], side[2], side[3] = x[i, 2], 0.0, 0.0, 1.0
            for k in range(3):
                x[i, k] += (least * (1.0 + 1e-9) - side[0]) * side[1 + k]


def displace(
    engine: ParticleEngine,
    state: ParticleState,
    move: Float[np.ndarray, "n 3"],
    push: Float[np.ndarray, "n 3"],
    pressure: Float[np.ndarray, " n"] | None = None,
) -> tuple[ParticleState, float]:
    """The state with positions changed by `move` [m], velocities by `push` [m/s] and pressures by `pressure` [Pa], and
    the work [J] of it: the change of kinetic, potential and compression energy, heat left alone.

    Nobody is moved through a wall. With the work among the works of the ports, the engine's account stays closed.
    """
    if not (move.any() or push.any() or (pressure is not None and pressure.any())):
        return state, 0.0
    c, new = engine.constants, state.copy()
    new.position += move
    keep_inside(engine.walls, new.position, c.guard)
    new.velocity += push
    if pressure is not None:
        new.strain += pressure / c.stiffness
    before, after = stored(c, engine.walls, state.position), stored(c, engine.walls, new.position)
    # The account measures weight and barrier from the first frame: that moves by what is booked here.
    held = (state.held[0] + after[0] - before[0], state.held[1] + after[1] - before[1])
    kinetic = 0.5 * c.mass * float((new.velocity**2).sum() - (state.velocity**2).sum())
    squeezed = 0.5 * c.stiffness * c.volume * float((new.strain**2).sum() - (state.strain**2).sum())
    return replace(new, held=held), kinetic + squeezed + after[0] - before[0]
