"""Any engine on another resolution of the same body, judged at the given nodes: what pitch and spacing cost."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from zsdt.errors import OptionError
from zsdt.fluid.coarsening import coarsen, interpolate
from zsdt.fluid.sampling import CLEAR
from zsdt.fluid.vessel import Vessel
from zsdt.graph import brick_grid
from zsdt.scene import BeamShape
from zsdt.solid.mesh import BrickMesh, mesh_of
from zsdt.tignn.engine import Engine, NodeField
from zsdt.trajectory import Body

SMOOTHING = 1.4  # kernel length of the packing, in spacings


class OtherPitch:
    """An engine for beams on a grid of `pitch` [m], finer or coarser than the given one.

    Its first frame is interpolated from the given one; nodal loads are spread (total force and moment stay), results
    are interpolated at the given nodes. The difference of the first frames is added to all positions and stresses, so
    that, like every other method, it is right at the first frame.
    """

    def __init__(self, engine: Engine, pitch: float):
        self.engine, self.pitch = engine, pitch
        self.name = f"{engine.name}, {100 * pitch:g} cm"

    def applies_to(self, body: Body) -> bool:
        """Whether the sizes of the body are multiples of the pitch."""
        sizes = np.ptp(body.points, axis=0) / self.pitch
        whole = bool(np.all(np.abs(sizes - np.round(sizes)) < 1e-6) and sizes.min() > 0.5)
        return body.liquid is None and body.material is not None and whole

    def prepare(self, body: Body) -> None:
        """Grid of the pitch, and the ways between both. Raises: OptionError where the pitch does not fit the body."""
        if not self.applies_to(body) or body.material is None:
            raise OptionError(f"A grid of {100 * self.pitch:g} cm does not fit this body; choose one that divides it.")
        self._body, self._origin = body, body.points.min(axis=0)
        shape = BeamShape(*(float(x) for x in np.ptp(body.points, axis=0)))
        own, given = mesh_of(shape, self.pitch), mesh_of(shape, body.pitch)
        grid = brick_grid(own.counts, own.edge)
        self._read = own.interpolation(body.points - self._origin)
        self._spread = self._read.T.tocsr()
        self._fetch = given.interpolation(grid.points)
        self._order = _order_of(given, body.points - self._origin)
        self.body = replace(
            body,
            points=grid.points + self._origin,
            pairs=grid.pairs,
            cells=grid.cells,
            clamped=grid.points[:, 0] < 1e-9,
            mass=body.material.density * own.volume,
            pitch=own.edge,
        )
        self.engine.prepare(self.body)

    def start(self, fields: dict[str, NodeField], load: Float[np.ndarray, "nodes 3"]) -> Any:
        """State at the first frame."""
        moved = fields | {"position": fields["position"] - self._body.points}
        own = {name: self._fetch @ values[self._order] for name, values in moved.items()}
        own["position"] = own["position"] + self.body.points
        state = self.engine.start(own, self._spread @ load)
        self._offset: dict[str, NodeField] = {}
        first = self.read(state)
        self._offset = {name: fields[name] - first[name] for name in ("position", "stress") if name in first}
        return state

    def step(self, state: Any, load: Float[np.ndarray, "nodes 3"], load_next: Float[np.ndarray, "nodes 3"]) -> Any:
        """One frame of the engine."""
        return self.engine.step(state, self._spread @ load, self._spread @ load_next)

    def read(self, state: Any) -> dict[str, NodeField]:
        """Fields at the given nodes."""
        fields = dict(self.engine.read(state))
        fields["position"] = fields["position"] - self.body.points
        found = {name: self._read @ values for name, values in fields.items()}
        found["position"] = found["position"] + self._body.points
        return {name: values + self._offset.get(name, 0.0) for name, values in found.items()}

    def account(self, state: Any) -> dict[str, float]:
        """Energies of the engine."""
        return self.engine.account(state)


def _order_of(mesh: BrickMesh, points: Float[np.ndarray, "nodes 3"]) -> np.ndarray:
    """Where the nodes of a mesh are among `points` [m]."""
    index = np.round(points / mesh.edge).astype(np.int64)
    nx, ny = mesh.counts[0] + 1, mesh.counts[1] + 1
    order = np.empty(len(points), np.int64)
    order[index[:, 0] + nx * (index[:, 1] + ny * index[:, 2])] = np.arange(len(points))
    return order


@dataclass
class CarriedState:
    """State of the engine's own particles with their internal energy [J/kg], and the given ones that they carry (m,
    m/s, J/kg)."""

    own: Any
    own_energy: Float[np.ndarray, "own 1"]
    position: Float[np.ndarray, "nodes 3"]
    velocity: Float[np.ndarray, "nodes 3"]
    energy: Float[np.ndarray, "nodes 1"]


class OtherSpacing:
    """An engine for liquids on particles of `ratio` times the given spacing (1 or more).

    Its particles fill the shape that the given ones fill and move as they do, with the same total momentum. The given
    ones are carried along: velocity by a linear fit to the particles around them, position by the trapezoidal rule,
    internal energy by the increments. The search for the carrying is in `graph_milliseconds`, and in the time.
    """

    def __init__(self, engine: Engine, ratio: float):
        if not ratio >= 1.0:
            raise OptionError(f"Particles of {ratio} spacings would be finer than the given ones; use 1 or more.")
        self.engine, self.ratio = engine, ratio
        self.name, self.graph_milliseconds = f"{engine.name}, {ratio:g} spacings", 0.0

    def prepare(self, body: Body) -> None:
        """Keeps the body: where the particles are is known at the first frame. Raises: OptionError for no liquid."""
        if body.liquid is None or body.vessel is None:
            raise OptionError("Another spacing needs a liquid in a known vessel.")
        self._body, self._vessel = body, Vessel(body.vessel)
        self._count = max(20, round(body.nodes / self.ratio**3))
        self._volume = float(body.mass.sum()) / body.liquid.density
        self._spacing = (self._volume / self._count) ** (1.0 / 3.0)

    def start(self, fields: dict[str, NodeField], load: Float[np.ndarray, "nodes 3"]) -> CarriedState:
        """State at the first frame: own particles in the given shape, moving as the given ones do."""
        body = self._body
        position, velocity = (np.array(fields[name], np.float64) for name in ("position", "velocity"))
        energy = np.array(fields.get("internal_energy", np.zeros((len(position), 1))), np.float64)
        centres = coarsen(position, self._count, self._vessel, self._spacing, SMOOTHING * self._spacing)
        moving, _ = interpolate(centres, position, np.concatenate([velocity, energy], axis=1), body.pitch)
        moving[:, :3] += velocity.mean(axis=0) - moving[:, :3].mean(axis=0)  # the same total momentum
        self.body = replace(
            body,
            points=centres,
            clamped=np.zeros(self._count, bool),
            mass=np.full(self._count, float(body.mass.sum()) / self._count),
            pitch=self._spacing,
        )
        self.engine.prepare(self.body)
        first = {"position": centres, "velocity": moving[:, :3].copy(), "internal_energy": moving[:, 3:].copy()}
        own = self.engine.start(first, self._own_load(load))
        return CarriedState(own, self.engine.read(own)["internal_energy"], position, velocity, energy)

    def _own_load(self, load: Float[np.ndarray, "nodes 3"]) -> Float[np.ndarray, "own 3"]:
        """The load as the acceleration of the vessel that it stands for, on own particles [N]."""
        return np.tile(load.sum(axis=0) / self._count, (self._count, 1))

    def step(
        self, state: CarriedState, load: Float[np.ndarray, "nodes 3"], load_next: Float[np.ndarray, "nodes 3"]
    ) -> CarriedState:
        """One frame of the engine, then of what it carries."""
        own = self.engine.step(state.own, self._own_load(load), self._own_load(load_next))
        after = self.engine.read(own)
        gained = after["internal_energy"] - state.own_energy
        dt = self._body.frame_dt
        began = time.perf_counter()
        moving = np.concatenate([after["velocity"], gained], axis=1)
        carried, _ = interpolate(state.position + dt * state.velocity, after["position"], moving, self._spacing)
        position = state.position + 0.5 * dt * (state.velocity + carried[:, :3])
        distance, normal = self._vessel.distance_and_normal(position)
        position += np.maximum(CLEAR * self._body.pitch - distance, 0.0)[:, None] * normal
        took = 1e3 * (time.perf_counter() - began)
        self.graph_milliseconds = took + float(getattr(self.engine, "graph_milliseconds", 0.0))
        return CarriedState(
            own, after["internal_energy"], position, carried[:, :3].copy(), state.energy + carried[:, 3:]
        )

    def read(self, state: CarriedState) -> dict[str, NodeField]:
        """Fields of the given particles."""
        return {"position": state.position, "velocity": state.velocity, "internal_energy": state.energy}

    def account(self, state: CarriedState) -> dict[str, float]:
        """Energies of the engine's own particles."""
        return self.engine.account(state.own)
