"""The node form of a liquid: several passes over the graph of the moment and one step a frame (seed, III.A).

Only the increments of velocity and internal energy are learned; `q+ = q + dt (v + v+) / 2` is known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from zsdt.errors import RunRejected
from zsdt.tignn.bracket import Rates
from zsdt.tignn.liquid_body import LiquidBody
from zsdt.tignn.liquid_bracket import make_liquid_bracket
from zsdt.tignn.liquid_features import EDGE_FEATURES, NODE_FEATURES, LiquidBatch, LiquidScales, LiquidState, look
from zsdt.tignn.message_passing import Processor
from zsdt.tignn.options import Bracket, Energy, TignnOptions


class LiquidModel(nn.Module):
    """Network and scales together."""

    def __init__(self, options: TignnOptions, scales: LiquidScales):
        super().__init__()
        self.options, self.scales = options, scales
        self.processor = Processor(
            NODE_FEATURES,
            EDGE_FEATURES,
            options.width,
            options.hidden_layers,
            options.passes,
            options.shared_weights,
            options.global_context,
        )
        self.bracket = make_liquid_bracket(options, scales)

    @property
    def conserves(self) -> bool:
        """Whether the total energy in joules is conserved by construction (energy=physical)."""
        return self.options.bracket is Bracket.exact and self.options.energy is Energy.physical

    def forward(self, batch: LiquidBatch) -> Rates:
        """Increments of a frame in scaled coordinates; the last four components are velocity and internal energy."""
        return self.bracket(batch, self.processor(batch, batch.node, batch.edge))


@dataclass(frozen=True)
class Moved:
    """A step: the new state, rates, work [J] of the load, work [J] of what put particles back, how many were."""

    state: LiquidState
    rates: Rates
    work_of_load: float
    work_of_wall: float
    put_back: int


def advance(
    model: LiquidModel,
    body: LiquidBody,
    state: LiquidState,
    load: Float[np.ndarray, "fluids 3"],
    relax: bool = True,
) -> Moved:
    """One frame on without gradients; `load` [N] is the mean over the frame.

    Where the total energy is conserved, what the clamp at the wall takes from the motion becomes heat, and what it
    lifts is booked as its work.

    Raises: RunRejected("not_finite" or "supersonic") where the motion blew up.
    """
    parameter = next(model.parameters())
    with torch.no_grad():
        batch = look(body, state, load, model.scales, model.options.global_context, parameter.dtype)
        rates = model(batch)
        increment = rates.total[: body.fluids, -4:].double().numpy()
    dv, de = increment[:, :3] * model.scales.d_velocity, increment[:, 3:] * model.scales.d_energy
    velocity, energy = state.velocity + dv, state.energy + de
    if not np.abs(velocity).max() < body.liquid.sound_speed:
        raise RunRejected("supersonic", "A particle became faster than sound: the motion blew up.")
    mean = 0.5 * (state.velocity + velocity)
    position = state.position + body.frame_dt * mean
    moved = body.relax(position) if relax and body.relaxation else position
    placed, slowed, count = body.keep_inside(moved, velocity)
    if model.conserves:
        energy = energy + 0.5 * (np.square(velocity).sum(1) - np.square(slowed).sum(1))[:, None]
    lifted = float(-(body.mass * (placed - position) @ body.gravity).sum())
    work = float((load * mean).sum() * body.frame_dt)
    return Moved(LiquidState(placed, slowed, energy), rates, work, lifted, count)
