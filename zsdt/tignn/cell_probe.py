"""How well the brackets of the sub-step form keep their promises in a state, in double precision (Done-when 4)."""

from __future__ import annotations

import numpy as np
import torch

from zsdt.tignn.cell_energy import cell_strain, generic_rates
from zsdt.tignn.cell_engine import CellEngine, CellState


def probe(engine: CellEngine, state: CellState) -> dict[str, float]:
    """Residuals of the degeneracy conditions in `state`, relative to the terms that they are sums of.

    The state is z = (position, momentum, viscous strain, heat). `energy_residual`: |e.z'| without ports;
    `entropy_leak`: |s.(L dE)|; `energy_leak`: |e.(M dS)|; `bulk_mdE`: max |M dE|; `entropy_production`: s.z', which
    must not be negative. Names as in `zsdt.tignn.node_engine.probe`.
    """
    body = engine.body
    real = len(body.cells)
    u = torch.as_tensor(state.u[:-1][body.cells])
    strain = cell_strain(u, body.pitch)
    history = torch.as_tensor(np.ascontiguousarray(state.memory.history[:, :real].T))
    held = (history + engine.gain * strain) / engine.keep
    flags = torch.as_tensor(engine.flags)
    rates = generic_rates(u, strain - held, body.pitch, engine.moduli, engine.correction, flags)
    force = np.zeros((body.nodes, 3))
    np.add.at(force, body.cells.ravel(), rates["strain_force"].numpy().reshape(-1, 3))
    # Canonical part: q' = v, p' = f, with dE/dq = -f and dE/dp = v. Clamped nodes do not move.
    power = (force * state.velocity).ravel()
    friction, slope, entropy = rates["friction"], rates["energy_gradient"], rates["entropy_gradient"]
    flow = torch.einsum("cij,cj->ci", friction, entropy)
    drain = (slope * flow).numpy().ravel()
    produced = (entropy * flow).numpy().ravel()
    vanishing = torch.einsum("cij,cj->ci", friction, slope).abs().max()
    terms = torch.einsum("cij,cj->ci", friction.abs(), slope.abs()).max().clamp_min(1e-300)
    tiny = 1e-300
    whole = np.concatenate([-power, power, drain])
    return {
        "energy_residual": float(abs(whole.sum()) / (np.abs(whole).sum() + tiny)),
        "entropy_leak": 0.0,  # the entropy depends on heat alone, on which L does not act
        "energy_leak": float(abs(drain.sum()) / (np.abs(drain).sum() + tiny)),
        "bulk_mdE": float(vanishing / terms),
        "entropy_production": float(produced.sum() / (np.abs(produced).sum() + tiny)),
    }
