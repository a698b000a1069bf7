"""A clamped beam of an experiment: its mesh, a mass that hangs at its tip, and what markers on it would see."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property

import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float

from zsdt.errors import OptionError
from zsdt.scene import BeamShape, Foam
from zsdt.solid.bending import Cantilever
from zsdt.solid.mesh import BrickMesh, mesh_of
from zsdt.solid.solver import BrickSolver, Load, SolverOptions
from zsdt.trajectory import Body

FARTHEST = 1.0  # cross-section sizes by which a marker may be off the body


class HungAt(Enum):
    """Nodes of the tip face that share the hung mass."""

    face = "face"
    top = "top"
    bottom = "bottom"


@dataclass(frozen=True)
class Specimen:
    """A brick clamped at x = 0 (axes of `zsdt.trajectory.Body`), meshed with cubes of edge `mesh` [m].

    density [kg/m3]; gravity [3] m/s2 in beam axes; tip_mass [kg], a point mass on nodes of the tip face that may
    turn freely.
    """

    shape: BeamShape
    density: float
    mesh: float
    gravity: Float[np.ndarray, "3"] = field(default_factory=lambda: np.array([0.0, 0.0, -9.81]))
    tip_mass: float = 0.0
    hung_at: HungAt = HungAt.face

    def __post_init__(self) -> None:
        if self.density <= 0 or self.tip_mass < 0:
            raise OptionError("A specimen needs a positive density and a tip mass that is not negative.")

    @cached_property
    def grid(self) -> BrickMesh:
        """Its mesh."""
        return mesh_of(self.shape, self.mesh)

    @property
    def tip(self) -> Bool[np.ndarray, " nodes"]:
        """Nodes that the mass hangs on."""
        points = self.grid.grid.points
        chosen = points[:, 0] > self.shape.length - 1e-6 * self.mesh
        if self.hung_at is HungAt.top:
            chosen &= points[:, 2] > self.shape.depth - 1e-6 * self.mesh
        if self.hung_at is HungAt.bottom:
            chosen &= points[:, 2] < 1e-6 * self.mesh
        return chosen

    @property
    def extra_mass(self) -> Float[np.ndarray, " nodes"]:
        """Hung mass of each node [kg]; an inner node of the face or edge carries more than one at its end."""
        share = np.where(self.tip, self.grid.volume, 0.0)
        return self.tip_mass * share / share.sum()

    def beam_theory(self, poisson: float = 0.45) -> Cantilever:
        """The same beam for closed forms."""
        return Cantilever(self.shape, self.density, self.tip_mass, self.gravity, poisson)

    def body(self, material: Foam, frame_dt: float) -> Body:
        """The specimen as engines see it; its masses are those of the beam alone (see `extra_mass`)."""
        grid = self.grid.grid
        return Body(
            points=grid.points,
            pairs=grid.pairs,
            clamped=grid.points[:, 0] < 1e-9,
            mass=self.density * self.grid.volume,
            frame_dt=frame_dt,
            pitch=self.mesh,
            gravity=np.asarray(self.gravity, np.float64),
            cells=grid.cells,
            material=material,
        )

    def observe(self, places: Float[np.ndarray, "points 3"]) -> scipy.sparse.csr_matrix:
        """Matrix [points, nodes] from nodal displacements to those of points at `places` [m] of the straight beam.

        Inside the brick trilinear; outside the point rides on the best affine movement of the two node layers around
        its x, so that it turns with the cross-section. Rows sum to one.
        Raises: OptionError where a place is farther off than a cross-section.
        """
        size = np.array(self.grid.size)
        off = np.maximum(np.maximum(-places, places - size), 0.0).max(axis=1)
        if off.max() > FARTHEST * max(size[1:]):
            raise OptionError(
                f"A marker lies {1e3 * off.max():.0f} mm off the beam; check that places are in beam axes and metres."
            )
        inside = off < 1e-9
        rows = np.zeros((len(places), self.grid.nodes))
        if inside.any():
            rows[inside] = self.grid.interpolation(places[inside]).toarray()
        points = self.grid.grid.points
        for p in np.flatnonzero(~inside):
            cell = int(np.clip(places[p, 0] / self.mesh, 0, self.grid.counts[0] - 1))
            layers = np.flatnonzero(np.abs(points[:, 0] / self.mesh - cell - 0.5) < 0.51)
            basis = np.column_stack([np.ones(len(layers)), points[layers]])
            rows[p, layers] = np.concatenate([[1.0], places[p]]) @ np.linalg.pinv(basis)
        return scipy.sparse.csr_matrix(rows)


class SpecimenFem:
    """The finite-element solver of a specimen behind the eyes of its markers; `observe` is fixed once."""

    def __init__(self, specimen: Specimen, places: Float[np.ndarray, "points 3"], options: SolverOptions | None = None):
        self.specimen, self.options = specimen, options
        self.places = places
        self.operator = specimen.observe(places)

    def solver(self, material: Foam) -> BrickSolver:
        """A solver at the straight, unloaded state."""
        s = self.specimen
        return BrickSolver(s.grid, material, self.options, s.gravity, extra_mass=s.extra_mass)

    def rest(self, material: Foam) -> Float[np.ndarray, "points 3"]:
        """Displacement [m] of the markers in the relaxed equilibrium (large displacement)."""
        solver = self.solver(material)
        solver.relax()
        return self.operator @ solver.displacement

    def swing(
        self, material: Foam, frames: int, frame_dt: float, push: Float[np.ndarray, "3"] | None = None
    ) -> Float[np.ndarray, "frames points 3"]:
        """Displacement [m] of the markers over frames after a release, the first frame included.

        push [3] N: force on the tip face, held until everything is relaxed and then gone; None: the beam is held
        straight and let go.
        """
        solver = self.solver(material)
        substeps = math.ceil(frame_dt / solver.dt - 1e-9)
        solver.dt = frame_dt / substeps
        if push is None:
            solver.set_state(np.zeros((self.specimen.grid.nodes, 3)))
        else:
            share = self.specimen.grid.volume * (
                self.specimen.grid.grid.points[:, 0] > self.specimen.shape.length - 1e-6 * self.specimen.mesh
            )
            solver.relax(Load(nodal=share[:, None] / share.sum() * push))
            solver.set_state(solver.displacement)
        seen = [self.operator @ solver.displacement]
        still = np.zeros(substeps)
        for _ in range(frames - 1):
            solver.step(Load(), still)
            seen.append(self.operator @ solver.displacement)
        return np.stack(seen)
