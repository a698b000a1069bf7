"""The solver on a coarse mesh as one of the methods that predict a beam: the competitor in every table.

It has the structure of `zsdt.tignn.engine.Engine` (that room is above this one, so nothing is imported from it).
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from jaxtyping import Float

from zsdt.errors import OptionError, RunRejected
from zsdt.scene import BeamShape
from zsdt.solid.mesh import mesh_of
from zsdt.solid.solver import BrickSolver, Frame, Load, SolverOptions
from zsdt.trajectory import Body

log = logging.getLogger(__name__)

OUTPUT = ("position", "velocity", "stress", "elastic_energy", "dissipated_energy")
NodeField = Float[np.ndarray, "nodes components"]


class Start(Enum):
    """Where the coarse solver begins.

    equilibrium: at its own rest under the first load, so that it does not ring from the difference between its
    sag and that of the finer mesh. given: at the positions of the first frame.
    """

    equilibrium = "equilibrium"
    given = "given"


@dataclass
class FemState:
    """The running solver; stepping changes it in place. `failed` says why it stopped predicting, if it did."""

    solver: BrickSolver
    frame: Frame
    failed: str = ""


class CoarseFem:
    """The finite-element solver with elements of `mesh` [m] behind the interface of an engine.

    Loads at the body's nodes are spread to the mesh (total force and moment stay); results are interpolated at
    the body's nodes. `anchored` adds the difference between the given first frame and the solver's own to all
    positions and stresses, so that, like every other method, it is right at the first frame. A run that is
    rejected goes on as NaN, with a warning.
    """

    def __init__(
        self,
        mesh: float = 0.05,
        options: SolverOptions | None = None,
        start: Start = Start.equilibrium,
        anchored: bool = True,
    ):
        self.mesh_edge, self.options, self.start_from, self.anchored = mesh, options, start, anchored
        self.name = f"fem_{100 * mesh:g}cm"

    def applies_to(self, body: Body) -> bool:
        """Whether the body has a material and its sizes are multiples of the mesh."""
        sizes = np.ptp(body.points, axis=0) / self.mesh_edge
        return body.material is not None and bool(np.all(np.abs(sizes - np.round(sizes)) < 1e-6) and sizes.min() > 0.5)

    def prepare(self, body: Body) -> None:
        """Meshes the body.

        Raises: OptionError where the body has no material or is no multiple of the mesh (see `applies_to`).
        """
        if body.material is None:
            raise OptionError("The finite-element engine needs the body's material; this data set does not say it.")
        length, width, depth = (float(x) for x in np.ptp(body.points, axis=0))
        mesh = mesh_of(BeamShape(length, width, depth), self.mesh_edge)
        self._body, self._origin = body, body.points.min(axis=0)
        self._solver = BrickSolver(mesh, body.material, self.options, body.gravity)
        self._substeps = math.ceil(body.frame_dt / self._solver.dt - 1e-9)
        self._solver.dt = body.frame_dt / self._substeps
        self._read = mesh.interpolation(body.points - self._origin)
        self._spread = self._read.T.tocsr()
        self._offset = {name: np.zeros(1) for name in OUTPUT}

    def start(self, fields: dict[str, NodeField], load: Float[np.ndarray, "nodes 3"]) -> FemState:
        """State at the first frame: its own rest under `load` or the given positions (see `Start`)."""
        solver, body = self._solver, self._body
        first_load = Load(nodal=self._spread @ load)
        moving = bool(np.abs(fields["velocity"]).max() > 0)
        if self.start_from is Start.equilibrium:
            solver.relax(first_load)
            displacement = solver.displacement
        else:
            displacement = self._to_mesh(fields["position"] - body.points)
        solver.set_state(displacement, self._to_mesh(fields["velocity"]) if moving else None, first_load)
        self._offset = {name: np.zeros(1) for name in OUTPUT}
        state = FemState(solver, solver.frame())
        if self.anchored:
            own = self.read(state)
            self._offset.update({name: fields[name] - own[name] for name in ("position", "stress") if name in fields})
        return state

    def _to_mesh(self, values: NodeField) -> NodeField:
        """Nodal values of the body at the nodes of the mesh: the mean weighted with the interpolation."""
        total = self._spread @ np.ones((len(values), 1))
        if (total < 1e-9).any():
            raise OptionError(
                f"A mesh of {100 * self.mesh_edge:g} cm is finer than the body's grid, so the first frame does not "
                "say where all of its nodes are; use start=equilibrium without velocity or a coarser mesh."
            )
        return (self._spread @ values) / total

    def step(
        self, state: FemState, load: Float[np.ndarray, "nodes 3"], load_next: Float[np.ndarray, "nodes 3"]
    ) -> FemState:
        """The state one frame later."""
        if state.failed:
            return state
        try:
            state.solver.step(
                Load(nodal=self._spread @ load), np.zeros(self._substeps), nodal_next=self._spread @ load_next
            )
        except RunRejected as error:
            log.warning("%s stops predicting: %s", self.name, error)
            state.failed = error.cause
            return state
        state.frame = state.solver.frame()
        return state

    def read(self, state: FemState) -> dict[str, NodeField]:
        """Fields at the body's nodes; NaN once the run was rejected."""
        if state.failed:
            nodes = self._body.nodes
            return {name: np.full((nodes, getattr(state.frame, name).shape[1]), np.nan) for name in OUTPUT}
        fields = {name: self._read @ getattr(state.frame, name) + self._offset[name] for name in OUTPUT}
        fields["position"] = fields["position"] + self._origin
        return fields

    def account(self, state: FemState) -> dict[str, float]:
        """Energies and work since the start in J."""
        frame = state.frame
        names = ("kinetic", "elastic", "dissipated", "work_load", "work_gravity")
        return {name: float(getattr(frame, name)) for name in names}
