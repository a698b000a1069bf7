"""A port between two frames of the cell engine: an observation moves the body, and the body answers as a material.

A correction is a deformation. The memory feels it as strain that ran within the last sub-step, so overstress, force
and stored energy follow and nothing is left behind from before. Its work is booked by whoever asks for it.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from zsdt.tignn.cell_engine import CellEngine, CellState
from zsdt.tignn.cell_kernel import CellMemory, internal_force


def displace(
    engine: CellEngine, state: CellState, move: Float[np.ndarray, "nodes 3"], push: Float[np.ndarray, "nodes 3"]
) -> tuple[CellState, float]:
    """The state after every node moved by `move` [m] and sped up by `push` [m/s], and the work [J] which that took.

    Clamped nodes stay. The work is the change of kinetic and stored energy less what gravity (and the constant force
    of `CellStart.residual`) did on the way, so `CellEngine.account` closes when it is added to the work of the ports.
    """
    free = ~engine.body.clamped[:, None]
    new = state.copy()
    new.u[:-1] += np.where(free, move, 0.0)
    new.velocity += np.where(free, push, 0.0)
    memory = new.memory
    # The kernel moves a memory on by one step; a scaled copy makes that step one of no time.
    scratch = CellMemory(memory.history / engine.keep, memory.overstress, memory.heat, memory.elastic)
    internal_force(engine.tables, scratch, new.u, engine.keep, engine.gain / engine.keep, engine.corner, new.force)
    by_steady = float((new.steady * (new.u - state.u)[:-1]).sum())
    return new, mechanical_energy(engine, new) - mechanical_energy(engine, state) - by_steady


def mechanical_energy(engine: CellEngine, state: CellState) -> float:
    """Kinetic and stored energy [J], heat left out."""
    kinetic = 0.5 * float((engine.inertia[:, None] * state.velocity**2).sum())
    return kinetic + float((state.memory.elastic + state.memory.overstress).sum()) * engine.body.pitch**3
