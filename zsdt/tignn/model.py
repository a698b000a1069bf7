"""The node form of the Local-TIGNN: one step of a frame, with known kinematics (seed, Section III.A; DESIGN 4).

Only velocity and the thermodynamic variables are learned; `q+ = q + dt (v + v+) / 2` is known. A staggered step has
two halves: the velocity first, then the stress from the new velocity and configuration with a few local passes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from zsdt.errors import OptionError
from zsdt.tignn.augment import section_symmetries, turn_batch, turn_load, turn_state
from zsdt.tignn.bracket import Rates, make_bracket
from zsdt.tignn.features import (
    EDGE_FEATURES,
    STRESS_BASIS,
    GraphBatch,
    NodeState,
    Scales,
    features,
    graph_magnitude,
    join,
    merge,
    node_feature_count,
    split,
)
from zsdt.tignn.message_passing import Perceptron, Processor
from zsdt.tignn.options import Energy, TignnOptions

THERMAL = 2  # elastic and dissipated energy


@dataclass
class Step:
    """Outcome of one step: the new state, and what the brackets gave in each half (for penalty, probes, account),
    and the magnitude of each graph [nodes, 1]."""

    state: NodeState
    rates: list[Rates]
    magnitude: torch.Tensor

    @property
    def penalty(self) -> torch.Tensor | None:
        """Degeneracy penalty of the soft bracket, summed over the halves; None for the others."""
        found = [r.penalty for r in self.rates if r.penalty is not None]
        return torch.stack(found).sum() if found else None


class _Half(nn.Module):
    """Processor and bracket of the components that one half of a step moves."""

    def __init__(self, options: TignnOptions, thermal: int, passes: int, d: int):
        super().__init__()
        inputs = node_feature_count(options, thermal)
        self.processor = Processor(
            inputs,
            EDGE_FEATURES,
            options.width,
            options.hidden_layers,
            passes,
            options.shared_weights,
            options.global_context,
        )
        self.bracket = make_bracket(options, d)

    def forward(self, batch, node, edge, mask, push, given=None) -> Rates:
        return self.bracket(batch, self.processor(batch, node, edge), edge, mask, push, given)


class NodeModel(nn.Module):
    """Network and scales together: advances a `NodeState` by one frame.

    Raises: OptionError where energy=physical meets a staggered step.
    """

    def __init__(self, options: TignnOptions, scales: Scales):
        super().__init__()
        self.options, self.scales = options, scales
        self.look: Any = features
        physical = options.energy is Energy.physical
        if physical and options.staggered:
            raise OptionError("energy=physical of a solid needs staggered=false: one bracket moves the whole state.")
        self.thermal = THERMAL if physical else 0
        new = 1.0 - options.stress_memory
        stress = np.hypot(scales.d_stress(), np.multiply(new, scales.stress()))
        self.register_buffer("from_scaled", torch.tensor(np.linalg.inv(STRESS_BASIS) * stress), persistent=False)
        self.to(torch.get_default_dtype())
        if options.staggered:
            self.first = _Half(options, self.thermal, options.passes, 3)
            self.second: _Half | None = _Half(options, self.thermal, options.local_passes, 6)
        else:
            self.first = _Half(options, self.thermal, options.passes, 9 + self.thermal)
            self.second = None
        self.warmth = Perceptron(1, 16, 1, 1) if physical else None

    def forward(
        self,
        batch: GraphBatch,
        state: NodeState,
        load: Float[torch.Tensor, "nodes 3"],
        load_next: Float[torch.Tensor, "nodes 3"],
    ) -> Step:
        """State one frame later; the load [N] runs from `load` to `load_next`."""
        if self.options.symmetric and not self.training:
            return self._symmetric(batch, state, load, load_next)
        return self._advance(batch, state, load, load_next)

    def _symmetric(self, batch, state, load, load_next) -> Step:
        """Mean over the eight symmetries of the cross-section: all turned copies go through side by side."""
        turns = section_symmetries()
        batches = merge([turn_batch(batch, t) for t in turns])
        states = join([turn_state(state, t) for t in turns])
        loads = [torch.cat([turn_load(x, t) for t in turns]) for x in (load, load_next)]
        step = self._advance(batches, states, *loads)
        back = [turn_state(part, t.T) for part, t in zip(split(step.state, len(turns)), turns, strict=True)]
        mean = {name: torch.stack([getattr(b, name) for b in back]).mean(0) for name in vars(state)}
        return Step(NodeState(**mean), step.rates, step.magnitude)

    def _advance(self, batch, state, load, load_next) -> Step:
        magnitude = graph_magnitude(batch, state, load_next, self.scales, self.options.graph_scale)
        if self.options.staggered:
            return self._staggered(batch, state, load, load_next, magnitude)
        node, edge = self.look(batch, state, load, load_next, self.scales, magnitude, self.options.stress_input)
        held = batch.free.expand(-1, 3)
        mask = torch.cat([held, torch.ones_like(node[:, : 6 + self.thermal])], dim=1)
        given = self._physical(batch, state, load, load_next, magnitude) if self.warmth is not None else None
        rates = self.first(batch, node, edge, mask, self._push(batch, load, load_next, magnitude), given)
        velocity = rates.total[:, :3] * (self.scales.d_velocity * magnitude)
        moved = self._kinematics(batch, state, velocity)
        thermal = state.thermal
        if self.thermal:
            thermal = thermal + rates.total[:, 9:] * (self.scales.d_thermal * magnitude)
            thermal = self._close_budget(batch, thermal, velocity, rates, magnitude)
        stress = self.options.stress_memory * state.stress + (rates.total[:, 3:9] @ self.from_scaled.T) * magnitude
        return Step(NodeState(moved[0], moved[1], stress, moved[2], thermal), [rates], magnitude)

    def _staggered(self, batch, state, load, load_next, magnitude) -> Step:
        push = self._push(batch, load, load_next, magnitude)
        node, edge = self.look(batch, state, load, load_next, self.scales, magnitude, self.options.stress_input)
        first = self.first(batch, node, edge, batch.free.expand(-1, 3), push)
        velocity = first.total * (self.scales.d_velocity * magnitude)
        displacement, new, increments = self._kinematics(batch, state, velocity)
        between = NodeState(displacement, new, state.stress, increments, state.thermal)
        assert self.second is not None
        # The second half sees the moved body as given: no gradient runs back into the velocity.
        seen = between.detach()
        node, edge = self.look(batch, seen, load, load_next, self.scales, magnitude, self.options.stress_input)
        second = self.second(batch, node, edge, torch.ones_like(state.stress), push)
        stress = self.options.stress_memory * state.stress + (second.total @ self.from_scaled.T) * magnitude
        return Step(NodeState(displacement, new, stress, increments, state.thermal), [first, second], magnitude)

    def _kinematics(
        self, batch: GraphBatch, state: NodeState, increment: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Trapezoidal rule: displacement, velocity and recent increments from the velocity increment [m/s]."""
        velocity = state.velocity + increment
        displacement = state.displacement + batch.dt * 0.5 * (state.velocity + velocity) * batch.free
        keep = 3 * self.options.history
        increments = torch.cat([increment, state.increments], dim=1)[:, :keep] if keep else state.increments
        return displacement, velocity, increments

    def _push(self, batch, load, load_next, magnitude) -> Float[torch.Tensor, "nodes 6"]:
        """Load and gravity of each node over their scales: what the ports respond to."""
        mean = 0.5 * (load + load_next) / (self.scales.load * magnitude)
        return torch.cat([mean, batch.gravity / 9.81], dim=1)

    def _physical(self, batch, state, load, load_next, magnitude):
        """e, s and port in scaled coordinates where the total energy is known (energy=physical).

        E = sum m (|v|2/2 - g.q) + V (w_elastic + w_dissipated); s = an increasing learned function of w_dissipated.
        The port is the impulse of load and weight, so its work is that of the forces.
        """
        assert self.warmth is not None
        dv, dw = self.scales.d_velocity * magnitude, self.scales.d_thermal * magnitude
        unit = self.energy_unit(batch)
        zero = torch.zeros_like(state.stress)
        share = batch.volume * dw / unit
        energy = torch.cat([batch.mass * state.velocity * dv / unit, zero, share, share], dim=1)
        warm = state.thermal[:, 1:] / self.scales.thermal
        slope = nn.functional.softplus(self.warmth(warm)) * share
        entropy = torch.cat([torch.zeros_like(state.velocity), zero, torch.zeros_like(slope), slope], dim=1)
        mass = batch.mass.clamp_min(torch.finfo(batch.mass.dtype).tiny)
        impulse = batch.dt * (0.5 * (load + load_next) / mass + batch.gravity) * batch.free / dv
        port = torch.cat([impulse, torch.zeros_like(zero), torch.zeros_like(state.thermal)], dim=1)
        return energy, entropy, port

    def energy_unit(self, batch: GraphBatch) -> float:
        """Joules of one unit of scaled energy: one number for all bodies, so that none depends on its batch."""
        return self.scales.thermal * float(self.scales.node_volume)

    def _close_budget(self, batch, thermal, velocity, rates: Rates, magnitude) -> torch.Tensor:
        """Books what the finite step leaves open: the bracket acts at the old velocity, kinetic energy changes at the
        mean one, so m dv_bracket.dv/2 moves from the elastic energy to the kinetic one."""
        internal = (rates.reversible + rates.irreversible)[:, :3] * (self.scales.d_velocity * magnitude)
        excess = 0.5 * batch.mass * (internal * velocity).sum(1, keepdim=True)
        elastic = thermal[:, :1] - excess / batch.volume.clamp_min(torch.finfo(thermal.dtype).tiny)
        return torch.cat([elastic, thermal[:, 1:]], dim=1)


def start_state(
    batch: GraphBatch,
    points: Float[np.ndarray, "nodes 3"],
    fields: dict[str, Float[np.ndarray, "nodes components"]],
    options: TignnOptions,
) -> NodeState:
    """State of a frame from its fields in SI; recent increments are unknown and start at zero."""
    dtype = batch.arm.dtype

    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(np.asarray(values), dtype=dtype)

    thermal = torch.zeros(len(points), 0, dtype=dtype)
    if options.energy is Energy.physical:
        thermal = torch.cat([tensor(fields["elastic_energy"]), tensor(fields["dissipated_energy"])], dim=1)
    return NodeState(
        displacement=tensor(fields["position"] - points),
        velocity=tensor(fields["velocity"]),
        stress=tensor(fields["stress"]),
        increments=torch.zeros(len(points), 3 * options.history, dtype=dtype),
        thermal=thermal,
    )
