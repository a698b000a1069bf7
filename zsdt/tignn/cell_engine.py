"""The sub-step form of the graph network as an `Engine`: many cheap local steps inside a frame (DESIGN 4.2).

Position and velocity move by the canonical bracket (velocity Verlet, forces = minus the gradient of the stored
energy), the memory of each cell relaxes by the friction bracket (heat), gravity and the load are ports. Energy is
physical by construction, so `account` can be held against a solver's ledger.
"""

from __future__ import annotations

import json
import math
import pickle
from collections.abc import Collection
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from zsdt.errors import DataError, OptionError, RunRejected
from zsdt.files import atomic_path
from zsdt.tignn.cell_energy import (
    FLAGS,
    GROUPS,
    CellConstants,
    CellOptions,
    CellStart,
    EnergyCorrection,
    Moduli,
    card_of,
    cell_flags,
    inertial_mass,
    moduli_of,
    stored_energy,
)
from zsdt.tignn.cell_kernel import (
    CellMemory,
    CellTables,
    internal_force,
    new_memory,
    node_slots,
    pad_cells,
)
from zsdt.tignn.cell_stepping import advance, edge_stretch, relax, settle, stability_limit
from zsdt.tignn.cell_stress import FEATURES, corner_stress, node_average, node_gradient, pull_back, push_forward
from zsdt.tignn.engine import NodeField, register_engine
from zsdt.tignn.stress_readout import StressReadout, corner_kinds
from zsdt.trajectory import Body

KIND = "cell"
STRETCH = (0.35, 2.0)  # of an edge: beyond, the cells have collapsed or were torn apart, and nothing brings them back
EDGES = [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]]  # of a cell
READABLE = ("position", "velocity", "stress", "elastic_energy", "dissipated_energy")


@dataclass
class CellState:
    """State of a body: displacement u [nodes + 1, 3] m of the model, velocity [nodes, 3] m/s, internal force N, memory.

    offset [nodes, 3] m: what is added to the model's positions when they are read; steady [nodes, 3] N: gravity and
    the mismatch at rest; anchor [nodes, 6] Pa: second Piola-Kirchhoff stress by which the given first frame differs
    from the model; anchor_of_load: its part that belongs to the first load, of which load_share is left; gained [J]:
    work of the load since the start.
    """

    u: Float[np.ndarray, "padded 3"]
    velocity: Float[np.ndarray, "nodes 3"]
    force: Float[np.ndarray, "nodes 3"]
    memory: CellMemory
    offset: Float[np.ndarray, "nodes 3"]
    steady: Float[np.ndarray, "nodes 3"]
    origin: Float[np.ndarray, "nodes 3"]
    anchor: Float[np.ndarray, "nodes 6"]
    anchor_of_load: Float[np.ndarray, "nodes 6"]
    first_load: Float[np.ndarray, "nodes 3"]
    load_share: float = 1.0
    gained: float = 0.0

    def copy(self) -> CellState:
        """A state that shares nothing that changes."""
        memory = CellMemory(*(a.copy() for a in self.memory))
        return replace(self, u=self.u.copy(), velocity=self.velocity.copy(), force=self.force.copy(), memory=memory)


class CellEngine:
    """Cell energy, fused kernel, any body made of equal cubes. See `Engine` for the meaning of the methods."""

    def __init__(
        self,
        constants: CellConstants,
        options: CellOptions | None = None,
        correction: EnergyCorrection | None = None,
        readout: StressReadout | None = None,
        name: str = "cell",
    ):
        self.constants, self.options = constants, options or CellOptions()
        self.correction, self.readout = correction, readout or StressReadout.plain()
        self.name = name

    def applies_to(self, body: Body) -> bool:
        """Whether the body has masses and cells that are cubes of its pitch."""
        try:
            _check(body)
        except OptionError:
            return False
        return True

    def prepare(self, body: Body) -> None:
        """Gather lists, moduli and the sub-step of `body`.

        Raises: OptionError where the body has no cells, no mass, or cells that are not cubes of the pitch.
        """
        _check(body)
        self.body = body
        self.extra_mass = np.zeros(body.nodes)
        self.edges = np.unique(np.sort(body.cells[:, EDGES].reshape(-1, 2), axis=1), axis=0)
        self.flags = cell_flags(body.cells, body.clamped)
        self.moduli = moduli_of(self.constants, self.flags, card_of(body), self.options.memory)
        self.tables = tables_of(body, self.moduli, self.correction, self.flags)
        self.refresh_inertia()
        self.weight = body.mass[:, None] * body.gravity
        self.corner = np.zeros((len(self.tables.cells) * 8, 3))
        self.limit = self.options.safety * self._critical_step()
        steps = self.options.substeps or math.ceil(body.frame_dt / self.limit)
        self.steps, self.dt = steps, body.frame_dt / steps
        self.refresh_memory_factors()
        self.kinds = np.zeros(len(self.tables.cells) * 8, np.int64)
        self.kinds[: 8 * len(body.cells)] = corner_kinds(body.cells, body.clamped)

    def refresh_inertia(self) -> None:
        """Masses that resist acceleration, from the present constants."""
        share = self.constants.named()["inertia"] if self.options.inertia else 0.0
        self.inertia = inertial_mass(self.body, share) + self.extra_mass
        self.inverse_mass = np.where(self.body.clamped, 0.0, 1.0 / self.inertia)

    def attach_mass(self, extra: Float[np.ndarray, " nodes"]) -> None:
        """Hangs point masses `extra` [kg] on the nodes of the prepared body, with inertia and weight; zeros take them
        off. The sub-step stays: more mass is more stable. `prepare` forgets them."""
        self.extra_mass = np.asarray(extra, np.float64)
        self.refresh_inertia()
        self.weight = (self.body.mass + self.extra_mass)[:, None] * self.body.gravity

    def refresh_memory_factors(self) -> None:
        """Factors of the exponential memory for the present sub-step and relaxation time."""
        self.keep = math.exp(-self.dt / self.tables.tau)
        self.gain = (1 - self.keep) * self.tables.tau / self.dt

    def refresh_correction(self) -> None:
        """Weights of the correction as they are now."""
        new = tables_of(self.body, self.moduli, self.correction, self.flags)
        self.tables = new._replace(
            relaxed=self.tables.relaxed, viscous=self.tables.viscous, tau=self.tables.tau,
            cells=self.tables.cells, offset=self.tables.offset, slot=self.tables.slot,
        )  # fmt: skip

    def _critical_step(self) -> float:
        """Stability limit [s] of the stiffest cell, multipliers of the correction included by their upper bound."""
        body, top = self.body, self.moduli.relaxed.max(axis=1) + self.moduli.viscous.max(axis=1)
        ones, zero = torch.as_tensor(top)[:, None], torch.zeros(8, 1, dtype=torch.float64)

        def energy(u: torch.Tensor) -> torch.Tensor:
            return stored_energy(u.reshape(1, 8, 3), body.pitch, ones, zero).sum()

        stiffness = torch.autograd.functional.hessian(energy, torch.zeros(24, dtype=torch.float64)).numpy()
        # A cell at an edge has lighter corners; its neighbours share their stiffness with heavier ones.
        lightest = float((self.inertia / body.mass).min())
        return stability_limit(stiffness, lightest * float(body.mass.sum()) / (8 * len(body.cells)))

    def start(self, fields: dict[str, NodeField], load: Float[np.ndarray, "nodes 3"]) -> CellState:
        """State at the first frame; how the model's own rest and the given frame are reconciled: `CellStart`.

        Raises: RunRejected where the frame is not finite, or the model finds no rest near it.
        """
        body = self.body
        if not all(np.isfinite(fields[name]).all() for name in ("position", "velocity", "stress") if name in fields):
            raise RunRejected("not_finite", "The first frame holds a value that is no number; begin with another one.")
        u = np.zeros((body.nodes + 1, 3))
        u[:-1] = fields["position"] - body.points
        given = u[:-1].copy()
        state = CellState(
            u=u,
            velocity=np.where(body.clamped[:, None], 0.0, fields["velocity"]),
            force=np.zeros((body.nodes, 3)),
            memory=new_memory(len(self.tables.cells)),
            offset=np.zeros((body.nodes, 3)),
            steady=self.weight.copy(),
            origin=given,
            anchor=np.zeros((body.nodes, 6)),
            anchor_of_load=np.zeros((body.nodes, 6)),
            first_load=np.zeros((body.nodes, 3)),
        )
        if self.options.start is CellStart.shift:
            self.equilibrate(state, self.weight + load)
            state.offset = given - state.u[:-1]
            state.origin = state.u[:-1].copy()
        settle(self.tables, state.memory, state.u, self.gain, self.corner, state.force)
        if self.options.start is CellStart.residual:
            state.steady = np.where(body.clamped[:, None], self.weight, -state.force - load)
        if self.options.anchor_stress and "stress" in fields:
            self._anchor(state, fields["stress"], load)
        return state

    def _anchor(self, state: CellState, given: NodeField, load: Float[np.ndarray, "nodes 3"]) -> None:
        """Notes by how much the given stress differs from the model's.

        A mismatch that belongs to the first load must go when that load goes: it is shared between weight and load as
        the model's own stress is, which takes a second equilibrium, without the load.
        """
        stress, gradient = self._stress(state)
        mismatch = pull_back(given - stress, gradient)
        held = np.zeros((self.body.nodes, 1))
        square = float((load**2).sum())
        if square > 0 and self.options.start is CellStart.shift:
            alone = state.copy()
            self.equilibrate(alone, self.weight)
            settle(self.tables, alone.memory, alone.u, self.gain, self.corner, alone.force)
            by_weight = pull_back(*self._stress(alone))
            by_load = pull_back(stress, gradient) - by_weight
            sizes = [np.linalg.norm(s, axis=1, keepdims=True) for s in (by_weight, by_load)]
            held = sizes[1] / np.maximum(sizes[0] + sizes[1], 1e-12)
        state.anchor, state.anchor_of_load = mismatch * (1 - held), mismatch * held
        state.first_load = load / max(square, 1e-300)

    def equilibrate(self, state: CellState, external: Float[np.ndarray, "nodes 3"], tolerance: float = 1e-6) -> None:
        """Moves `state.u` to the relaxed equilibrium under `external` [N].

        Raises: RunRejected where dynamic relaxation does not get there (a body that collapses under its weight).
        """
        args = (self.tables, state.memory, state.u, state.force, self.inverse_mass, external, 0.95 * self.limit)
        residual, _ = relax(*args, 60_000, tolerance, self.corner)
        if not residual < 100 * tolerance:
            raise RunRejected(
                "static",
                f"The cell model found no equilibrium (residual {residual:.1e} of the load); "
                "the body is too heavy for its material or the learned constants are wrong.",
            )

    def step(
        self, state: CellState, load: Float[np.ndarray, "nodes 3"], load_next: Float[np.ndarray, "nodes 3"]
    ) -> CellState:
        """State one frame later (the given one stays as it is).

        Raises: RunRejected where a node is no longer finite, or cells have collapsed or were torn apart.
        """
        new = state.copy()
        new.gained += advance(
            self.tables, new.memory, new.u, new.velocity, new.force, self.inverse_mass, new.steady,
            np.ascontiguousarray(load, float), np.ascontiguousarray(load_next, float), self.steps, self.dt, self.corner,
        )  # fmt: skip
        new.load_share = float(np.clip((new.first_load * load_next).sum(), 0.0, 1.0))
        self.check(new)
        return new

    def check(self, state: CellState) -> None:
        """Raises RunRejected where a state is none of a body: St. Venant-Kirchhoff cells collapse without a NaN and
        without an error of energy (DESIGN 3.1), so nothing else would tell."""
        low, high = edge_stretch(self.body.points, state.u, self.edges, self.body.pitch)
        if low < 0:
            raise RunRejected("not_finite", "A position is not a number any more; state or load was none before.")
        if low < STRETCH[0] or high > STRETCH[1]:
            raise RunRejected(
                "collapse",
                f"An edge of a cell is {low if low < STRETCH[0] else high:.2f} times as long as at rest (range "
                f"{STRETCH[0]:g} to {STRETCH[1]:g}): the cells have collapsed or were torn apart; use a smaller load.",
            )

    def _stress(self, state: CellState) -> tuple[Float[np.ndarray, "nodes 6"], Float[np.ndarray, "nodes 3 3"]]:
        """The read-out's Cauchy stress [Pa] and the mean F at the nodes."""
        tables, nodes = self.tables, self.body.nodes
        cells = len(tables.cells)
        corner, gradients = np.empty((cells * 8, 6)), np.empty((cells, 3, 3))
        args = (tables, state.memory, state.u, self.keep, self.gain, self.kinds, self.readout.matrices)
        corner_stress(*args, corner, np.empty((0, FEATURES)), gradients)
        stress, gradient = np.empty((nodes, 6)), np.empty((nodes, 3, 3))
        node_average(tables.offset, tables.slot, corner, stress)
        node_gradient(tables.offset, tables.slot, gradients, gradient)
        return stress, gradient

    def read(self, state: CellState, names: Collection[str] | None = None) -> dict[str, NodeField]:
        """Position, velocity, stress, elastic and dissipated energy density at the nodes; only `names` if given."""
        wanted = READABLE if names is None else names
        out: dict[str, NodeField] = {}
        if "position" in wanted:
            out["position"] = self.body.points + state.u[:-1] + state.offset
        if "velocity" in wanted:
            out["velocity"] = state.velocity.copy()
        if "stress" in wanted:
            out["stress"], gradient = self._stress(state)
            push_forward(state.anchor + state.load_share * state.anchor_of_load, gradient, out["stress"])
        if "elastic_energy" in wanted or "dissipated_energy" in wanted:
            memory = state.memory
            energies = np.repeat(np.stack([memory.elastic + memory.overstress, memory.heat], axis=1), 8, axis=0)
            density = np.empty((self.body.nodes, 2))
            node_average(self.tables.offset, self.tables.slot, energies, density)
            both = {"elastic_energy": density[:, :1], "dissipated_energy": density[:, 1:]}
            out.update((name, both[name]) for name in both if name in wanted)
        return out

    def stress_features(self, state: CellState) -> tuple[np.ndarray, np.ndarray]:
        """What the read-out learns from: corner features [8 cells, FEATURES] Pa and F [cells, 3, 3]."""
        corners = len(self.tables.cells) * 8
        out, features, gradients = np.empty((corners, 6)), np.empty((corners, FEATURES)), np.empty((corners // 8, 3, 3))
        args = (self.tables, state.memory, state.u, self.keep, self.gain, self.kinds, self.readout.matrices)
        corner_stress(*args, out, features, gradients)
        real = len(self.body.cells)
        return features[: 8 * real], gradients[:real]

    def account(self, state: CellState) -> dict[str, float]:
        """Energies [J]: kinetic, elastic, dissipated; works of the ports since the start, one by one and together.

        `kinetic + elastic + dissipated - work_of_ports` stays constant to the error of the time step. work_mismatch:
        of the constant force that balances frame 0 with `CellStart.residual`, else zero.
        """
        volume = self.body.pitch**3
        moved = state.u[:-1] - state.origin
        gravity = float((self.weight * moved).sum())
        mismatch = float(((state.steady - self.weight) * moved).sum())
        return {
            "kinetic": float(0.5 * (self.inertia[:, None] * state.velocity**2).sum()),
            "elastic": float((state.memory.elastic + state.memory.overstress).sum() * volume),
            "dissipated": float(state.memory.heat.sum() * volume),
            "work_load": state.gained,
            "work_gravity": gravity,
            "work_mismatch": mismatch,
            "work_of_ports": state.gained + gravity + mismatch,
        }

    def internal_force(self, position: Float[np.ndarray, "nodes 3"]) -> Float[np.ndarray, "nodes 3"]:
        """Relaxed internal forces [N] at node positions [m]."""
        u = np.zeros((self.body.nodes + 1, 3))
        u[:-1] = position - self.body.points
        force = np.empty((self.body.nodes, 3))
        internal_force(self.tables, new_memory(len(self.tables.cells)), u, 0.0, 0.0, self.corner, force)
        return force


def _check(body: Body) -> None:
    """Raises OptionError where a body has no masses or no cells that are cubes of its pitch."""
    if len(body.cells) == 0 or not (body.mass > 0).all():
        raise OptionError("The sub-step engine needs a body with cells and masses; choose form=node for this one.")
    edges = body.points[body.cells[:, [1, 2, 4, 7]]] - body.points[body.cells[:, :1]]
    cube = body.pitch * np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])
    if not np.allclose(edges, cube, atol=1e-6 * body.pitch):
        raise OptionError("The sub-step engine needs cells that are cubes along x, y, z with edges of one pitch.")


def tables_of(
    body: Body, moduli: Moduli, correction: EnergyCorrection | None, flags: Float[np.ndarray, "cells flags"]
) -> CellTables:
    """Kernel tables of a body (see `CellTables`)."""
    cells = pad_cells(body.cells.astype(np.int64), body.nodes)
    extra = len(cells) - len(body.cells)
    offset, slot = node_slots(body.cells.astype(np.int64), body.nodes)

    def padded(values: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(np.pad(values, ((0, 0), (0, extra)), mode="edge"))

    inner, bias = np.zeros((0, len(GROUPS))), np.zeros((0, len(cells)))
    outer, outer_bias, reach = np.zeros((len(GROUPS), 0)), np.zeros(len(GROUPS)), 0.0
    if correction is not None:
        weights = correction.inner.detach().numpy()
        inner = np.ascontiguousarray(weights[:, : len(GROUPS)])
        bias = padded(weights[:, len(GROUPS) :] @ flags.T + correction.inner_bias.detach().numpy()[:, None])
        outer = np.ascontiguousarray(correction.outer.detach().numpy())
        outer_bias, reach = correction.outer_bias.detach().numpy().copy(), float(correction.reach)
    return CellTables(
        cells, offset, slot, padded(moduli.relaxed), padded(moduli.viscous), inner, bias, outer, outer_bias,
        float(body.pitch), float(moduli.tau), reach,
    )  # fmt: skip


def plain_options(options: CellOptions) -> dict[str, Any]:
    """Options as a dictionary that fits JSON."""
    return {k: v.value if isinstance(v, Enum) else v for k, v in vars(options).items()}


def save_cell_engine(folder: str | Path, engine: CellEngine) -> None:
    """Writes `engine.json` (kind, options, constants, card) and `weights.pt` (networks) into `folder`."""
    folder = Path(folder)
    c = engine.constants
    card = {
        "kind": KIND,
        "name": engine.name,
        "options": plain_options(engine.options),
        "constants": c.theta.tolist(),
        "boundary": c.boundary.tolist(),
        "material_card": c.card,
        "named_constants": c.named(),
    }
    weights = {
        "correction": None if engine.correction is None else engine.correction.state_dict(),
        "readout": torch.as_tensor(engine.readout.matrices),
    }
    with atomic_path(folder / "weights.pt") as beside:
        torch.save(weights, beside)
    with atomic_path(folder / "engine.json") as beside:
        beside.write_text(json.dumps(card, indent=1))


def load_cell_engine(folder: Path) -> CellEngine:
    """The engine that `save_cell_engine` wrote.

    Raises: DataError where a file is missing or does not fit.
    """
    try:
        card = json.loads((folder / "engine.json").read_text())
        weights = torch.load(folder / "weights.pt", weights_only=True)
        options = CellOptions(**{**card["options"], "start": CellStart(card["options"]["start"])})
        given = card["material_card"]
        constants = CellConstants(
            theta=np.array(card["constants"]),
            boundary=np.array(card["boundary"]).reshape(len(GROUPS), len(FLAGS)),
            card=None if given is None else tuple(given),
        )
        correction = None
        if weights["correction"] is not None:
            correction = EnergyCorrection(options.hidden, options.correction_range)
            correction.load_state_dict(weights["correction"])
        readout = StressReadout(weights["readout"].numpy())
    except (OSError, KeyError, ValueError, TypeError, RuntimeError, IndexError, pickle.UnpicklingError) as error:
        raise DataError(f"The cell engine in {folder} is broken ({error}); train it again.") from error
    return CellEngine(constants, options, correction, readout, card["name"])


register_engine(KIND, load_cell_engine)
