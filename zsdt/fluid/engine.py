"""The solver with fewer particles as one of the methods that predict a liquid: the competitor in every table.

It has the structure of `zsdt.tignn.engine.Engine` (that room is above this one, so nothing is imported from it).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from zsdt.errors import OptionError
from zsdt.fluid.coarsening import coarsen, interpolate
from zsdt.fluid.solver import SphOptions, SphSolver
from zsdt.fluid.vessel import Vessel
from zsdt.fluid.wall_tables import WallTables
from zsdt.trajectory import Body

NodeField = Float[np.ndarray, "nodes components"]
CLEAR = 0.1  # fine spacings that tracers stay away from the wall


class _Push:
    """Motion of a vessel during one frame: gravity as it is, and the acceleration that the load stands for."""

    def __init__(self, gravity: Float[np.ndarray, "3"]):
        self._gravity, self._start, self._frame = gravity, 0.0, 1.0
        self._first, self._last = np.zeros(3), np.zeros(3)

    def set(self, start: float, frame: float, first: Float[np.ndarray, "3"], last: Float[np.ndarray, "3"]) -> None:
        """Acceleration of the vessel [m/s2] runs from `first` to `last` in `frame` [s] from `start` [s] on."""
        self._start, self._frame, self._first, self._last = start, frame, first, last

    def acceleration(self, t: float) -> Float[np.ndarray, "3"]:
        """Of the vessel [m/s2]."""
        share = min(max((t - self._start) / self._frame, 0.0), 1.0)
        return (1.0 - share) * self._first + share * self._last

    def gravity(self, t: float) -> Float[np.ndarray, "3"]:
        """Gravity [m/s2]."""
        return self._gravity


@dataclass
class SphState:
    """The running solver, and the fine particles that it carries: position [m], velocity [m/s], energy [J/kg]."""

    solver: SphSolver
    push: _Push
    position: Float[np.ndarray, "nodes 3"]
    velocity: Float[np.ndarray, "nodes 3"]
    energy: Float[np.ndarray, "nodes 1"]
    start_energy: float


class CoarseSph:
    """SPH with particles of `ratio` times the body's spacing behind the interface of an engine.

    The coarse particles fill the shape that the given ones fill (see `coarsen`) and move as they do, with the same
    total momentum; they take over the density where it is given and begin hydrostatically where it is not. The given
    particles are carried along as tracers: velocity by a linear fit to the coarse particles around them, position by
    the trapezoidal rule, internal energy by the coarse particles' increments.
    A load is taken as the acceleration of the vessel that it stands for (its sum over the mass).
    """

    def __init__(self, ratio: float = 1.5, options: SphOptions | None = None):
        if not ratio >= 1.0:
            raise OptionError(
                f"Coarse particles of {ratio} spacings would be finer than the given ones; use 1 or more."
            )
        self.ratio = ratio
        given = options or SphOptions()
        # A coarse run is not a source of truth: few layers and an open balance are its own error, not a reason to stop.
        self.options = replace(given, watch=replace(given.watch, layers=1.0, residual=1e9, nearest=0.0))
        self.name = f"sph_{ratio:g}dx"
        self.graph_milliseconds = 0.0

    def applies_to(self, body: Body) -> bool:
        """Whether the body is a liquid in a known vessel with enough particles to be made coarser."""
        return body.liquid is not None and body.vessel is not None and body.nodes / self.ratio**3 >= 20

    def prepare(self, body: Body) -> None:
        """Wall tables of the vessel for the coarse particles.

        Raises: OptionError where the body is no liquid in a vessel or has too few particles (see `applies_to`).
        """
        if body.liquid is None or body.vessel is None or not self.applies_to(body):
            raise OptionError("Coarse SPH needs a liquid in a known vessel, and 20 coarse particles at least.")
        self._body, self._vessel, self._liquid = body, Vessel(body.vessel), body.liquid
        self._count = max(20, round(body.nodes / self.ratio**3))
        volume = float(body.mass.sum()) / body.liquid.density
        self._spacing = (volume / self._count) ** (1.0 / 3.0)
        self._tables = WallTables(self._vessel, self.options.smoothing * self._spacing, self.options.fineness)

    def start(self, fields: dict[str, NodeField], load: Float[np.ndarray, "nodes 3"]) -> SphState:
        """State at the first frame: coarse particles in the given shape, moving as the given ones do."""
        position, velocity = (np.array(fields[name], np.float64) for name in ("position", "velocity"))
        energy = np.array(fields.get("internal_energy", np.zeros((len(position), 1))), np.float64)
        h = self.options.smoothing * self._spacing
        centres = coarsen(position, self._count, self._vessel, self._spacing, h)
        push = _Push(np.asarray(self._body.gravity, np.float64))
        solver = SphSolver(
            self._vessel, self._liquid, centres, self._spacing, self.options, motion=push, tables=self._tables
        )
        given = [velocity] + ([np.asarray(fields["density"], np.float64)] if "density" in fields else [])
        sampled, _ = interpolate(centres, position, np.concatenate(given, axis=1), self._body.pitch)
        if "density" in fields:
            solver.density[:] = sampled[:, 3]
        mean = sampled[:, :3]
        mean += velocity.mean(axis=0) - mean.mean(axis=0)  # the same total momentum
        solver.start(mean)
        total = float((self._body.mass[:, None] * energy).sum())
        return SphState(solver, push, position, velocity, energy, total)

    def step(
        self, state: SphState, load: Float[np.ndarray, "nodes 3"], load_next: Float[np.ndarray, "nodes 3"]
    ) -> SphState:
        """The state one frame later. Raises: RunRejected where the coarse run leaves its range."""
        solver, dt, mass = state.solver, self._body.frame_dt, float(self._body.mass.sum())
        state.push.set(solver.time, dt, -load.sum(axis=0) / mass, -load_next.sum(axis=0) / mass)
        before, seconds = solver.frame(), solver.graph_seconds
        solver.advance(dt)
        after = solver.frame()
        searching = max(solver.graph_seconds - seconds, 0.0)
        here = after.inside
        moving = np.concatenate([after.velocity, after.internal_energy - before.internal_energy], axis=1)[here]
        guess = state.position + dt * state.velocity
        carried, took = interpolate(guess, after.position[here], moving, self._spacing)
        position = state.position + 0.5 * dt * (state.velocity + carried[:, :3])
        self._keep_inside(position)
        self.graph_milliseconds = 1e3 * (searching + took)
        return SphState(
            solver, state.push, position, carried[:, :3].copy(), state.energy + carried[:, 3:], state.start_energy
        )

    def _keep_inside(self, position: Float[np.ndarray, "nodes 3"]) -> None:
        """Puts tracers back that came nearer to the wall than particles do, in place."""
        distance, normal = self._vessel.distance_and_normal(position)
        position += np.maximum(CLEAR * self._body.pitch - distance, 0.0)[:, None] * normal

    def read(self, state: SphState) -> dict[str, NodeField]:
        """Fields of the given particles."""
        return {"position": state.position, "velocity": state.velocity, "internal_energy": state.energy}

    def account(self, state: SphState) -> dict[str, float]:
        """Energies of the coarse particles in J; internal is the total of m e, work that of the vessel's motion."""
        account = state.solver.account()
        return {
            "kinetic": account.kinetic,
            "potential": account.potential,
            "internal": state.start_energy + account.internal,
            "work_of_ports": account.work_inertial,
        }
