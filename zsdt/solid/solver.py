"""The solid solver: a St. Venant-Kirchhoff brick with one Prony term, explicit in time, that keeps its accounts.

Total Lagrangian, lumped mass, central differences (DESIGN 3.1; seed, Eq. 9 to 11). Nothing here knows about load
cases; see `zsdt.solid.loads`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

from zsdt.errors import OptionError, RunRejected
from zsdt.scene import Foam
from zsdt.solid import stepping
from zsdt.solid.element import (
    Constants,
    Element,
    Layout,
    critical_step,
    output_constants,
    relaxed_constants,
    viscous_constants,
    watched,
)
from zsdt.solid.mesh import BrickMesh

NO_FACES = np.zeros((0, 4), np.int64)


@dataclass
class SolverOptions:
    """How a brick is computed.

    element: variant. step_fraction: time step as part of the critical one of the undeformed brick. min_stretch:
    principal stretch below which a run is rejected; St. Venant-Kirchhoff collapses below 1/sqrt(3).
    static_tolerance: force residual of the static start relative to weight and load.
    """

    element: Element = Element.stabilised
    step_fraction: float = 0.6
    min_stretch: float = 0.577
    static_tolerance: float = 1e-5

    def __post_init__(self) -> None:
        if not 0.0 < self.step_fraction < 0.95:
            raise OptionError(f"step_fraction is {self.step_fraction}; choose a value above 0 and below 0.95.")
        if not 0.0 <= self.min_stretch < 1.0:
            raise OptionError(f"min_stretch is {self.min_stretch}; choose a value from 0 to below 1.")


@dataclass
class Load:
    """External force: a pressure into `faces` [faces, 4] of the mesh, and dead forces `nodal` [nodes, 3] N."""

    faces: Int[np.ndarray, "faces 4"] = field(default_factory=lambda: NO_FACES)
    nodal: Float[np.ndarray, "nodes 3"] | None = None


@dataclass
class Frame:
    """State at one time on the solver's own mesh.

    position [nodes, 3] m, velocity m/s, stress [nodes, 6] Pa, elastic and dissipated energy density [nodes, 1] J/m3,
    load [nodes, 3] N; kinetic, elastic, dissipated [J] and the work of load and gravity since the start [J].
    """

    position: Float[np.ndarray, "nodes 3"]
    velocity: Float[np.ndarray, "nodes 3"]
    stress: Float[np.ndarray, "nodes 6"]
    elastic_energy: Float[np.ndarray, "nodes 1"]
    dissipated_energy: Float[np.ndarray, "nodes 1"]
    load: Float[np.ndarray, "nodes 3"]
    kinetic: float
    elastic: float
    dissipated: float
    work_load: float
    work_gravity: float

    @property
    def balance(self) -> float:
        """Energy that is there less the work that was done [J]; constant but for the error of the time step."""
        return self.kinetic + self.elastic + self.dissipated - self.work_load - self.work_gravity


class BrickSolver:
    """A brick of foam that can be loaded, brought to rest, and stepped.

    free [nodes, 3] says which components of which nodes may move; by default all but those of the nodes at x = 0.
    extra_mass [nodes] kg: point masses on nodes, with inertia and weight. `dt` [s] may be changed until a state is
    set. Flat arrays: `u` displacement at the present time, `v` velocity half a step later.
    """

    def __init__(
        self,
        mesh: BrickMesh,
        material: Foam,
        options: SolverOptions | None = None,
        gravity: Float[np.ndarray, "3"] | None = None,
        free: Bool[np.ndarray, "nodes 3"] | None = None,
        extra_mass: Float[np.ndarray, " nodes"] | None = None,
    ):
        self.mesh, self.material, self.options = mesh, material, options or SolverOptions()
        self._layout = lay = Layout(mesh, self.options.element)
        self._memory = lay.memory()
        self.u, self.v, self._f, self._load = (np.zeros(3 * lay.stride) for _ in range(4))
        self._points = lay.flat(mesh.grid.points)
        self.mass = material.density * mesh.volume
        if extra_mass is not None:
            self.mass = self.mass + extra_mass
        pull = np.zeros(3) if gravity is None else np.asarray(gravity, np.float64)
        self._weight_force = lay.flat(self.mass[:, None] * pull)
        self.free = np.repeat(mesh.grid.points[:, :1] > 1e-9, 3, axis=1) if free is None else free
        self._inverse_mass = lay.flat(np.where(self.free, 1.0 / self.mass[:, None], 0.0))
        self._share = mesh.edge**3 / 8.0 / mesh.volume  # one over the number of elements around a node
        self.critical_dt = self._critical(material.shear)
        self.dt = self.options.step_fraction * self.critical_dt
        self._pressure, self._work_load = 0.0, 0.0
        self._u_start = self.u.copy()

    def _critical(self, shear: float) -> float:
        m = self.material
        return self.mesh.edge * critical_step(m.bulk, shear, m.poisson, m.density, self.options.element)

    def _constants(self) -> Constants:
        """Constants of a step, with the stretches beyond which the step is unstable or the material collapses.

        The stiffness of a stretched bar grows with (3 stretch^2 - 1) / 2.
        """
        reserve = 0.95 * self.critical_dt / self.dt
        max_stretch = math.sqrt(max((2.0 * reserve**2 + 1.0) / 3.0, 1.0))
        return watched(viscous_constants(self.material, self.mesh.edge, self.dt), self.options.min_stretch, max_stretch)

    # ---- states -----------------------------------------------------------------------------------------------

    def set_state(
        self,
        displacement: Float[np.ndarray, "nodes 3"],
        velocity: Float[np.ndarray, "nodes 3"] | None = None,
        load: Load | None = None,
        pressure: float = 0.0,
    ) -> None:
        """Starts the accounts at a fully relaxed state with this displacement [m], velocity [m/s] and load."""
        load, lay = load or Load(), self._layout
        self.u = lay.flat(displacement)
        self._memory = lay.memory()
        # Leaves the strains in the memory, with the condensed thicknesses of the relaxed material and no overstress.
        lay.forces(self.u, self._f, self._memory, relaxed_constants(self.material, self.mesh.edge))
        self._load[:] = 0.0 if load.nodal is None else lay.flat(load.nodal)
        stepping.add_pressure(load.faces, pressure, self._points, self.u, lay.stride, self._load)
        start = np.zeros((self.mesh.nodes, 3)) if velocity is None else np.where(self.free, velocity, 0.0)
        self.v = lay.flat(start) + 0.5 * self.dt * self._acceleration()
        self._pressure, self._work_load = pressure, 0.0
        self._u_start = self.u.copy()

    def _acceleration(self) -> Float[np.ndarray, " flat"]:
        return self._inverse_mass * (self._load + self._weight_force - self._f)

    def _advance(self, load: Load, course, dt, damping, constants: Constants, low, high) -> tuple[int, float, int]:
        lay = self._layout
        return stepping.advance(
            lay.full, lay.grid, self.u, self.v, self._f, self._load, self._memory, lay.weight, tuple(constants),
            lay.tile, self._weight_force, self._inverse_mass, dt, damping,
            load.faces, self._points, course, low, high,
        )  # fmt: skip

    def step(
        self,
        load: Load,
        pressure: Float[np.ndarray, " steps"],
        nodal_next: Float[np.ndarray, "nodes 3"] | None = None,
    ) -> None:
        """Runs len(pressure) steps of `dt`; `pressure` [Pa] is its value after each step.

        Dead nodal loads run linearly from `load.nodal` to `nodal_next` over these steps.
        Raises: RunRejected where the run leaves the range in which the material law means anything.
        """
        lay = self._layout
        low = np.zeros(3 * lay.stride) if load.nodal is None else lay.flat(load.nodal)
        high = low if nodal_next is None else lay.flat(nodal_next)
        course = np.concatenate([[self._pressure], pressure])
        status, work, _ = self._advance(load, course, self.dt, 0.0, self._constants(), low, high)
        self._work_load += work
        self._pressure = float(course[-1])
        if status != stepping.DONE:
            raise self._rejection(status)

    def _rejection(self, status: int) -> RunRejected:
        if status == stepping.NOT_FINITE:
            return RunRejected("not_finite", "A velocity stopped being a number; use a smaller step_fraction or load.")
        gradient = self.deformation_gradient()
        jacobian = float(np.linalg.det(gradient).min())
        stretch = np.linalg.svd(gradient, compute_uv=False)
        if jacobian <= 0:
            return RunRejected("inverted", f"An element turned inside out (J = {jacobian:.3f}); use a smaller load.")
        if stretch.min() < self.options.min_stretch:
            return RunRejected(
                "collapse",
                f"An element was compressed to a stretch of {stretch.min():.3f}, where a St. Venant-Kirchhoff "
                "material collapses; use a smaller load or a stouter beam.",
            )
        return RunRejected(
            "step",
            f"An element was stretched to {stretch.max():.3f}, where the time step is no longer stable; "
            "use a smaller step_fraction or load.",
        )

    @property
    def displacement(self) -> Float[np.ndarray, "nodes 3"]:
        """Displacement of the nodes now [m]."""
        return self._layout.nodal(self.u)

    @displacement.setter
    def displacement(self, values: Float[np.ndarray, "nodes 3"]) -> None:
        """Moves the nodes between two steps; the work of doing so is in no account."""
        self.u = self._layout.flat(values)

    def deformation_gradient(self) -> Float[np.ndarray, "points 3 3"]:
        """F at the centre of each element (`full`: at its 8 Gauss points, one block of elements per point)."""
        u = self.displacement[self.mesh.grid.cells]
        signs = np.array([[2 * (n & 1) - 1, (n & 2) - 1, (n >> 1 & 2) - 1] for n in range(8)], np.float64)
        points = signs / math.sqrt(3.0) if self._layout.full else np.zeros((1, 3))
        result = []
        for point in points:
            one = 1.0 + signs * point
            slope = np.stack([signs[:, c] * one[:, (c + 1) % 3] * one[:, (c + 2) % 3] for c in range(3)], axis=1)
            result.append(np.eye(3) + np.einsum("enc,nj->ecj", u, slope / (4.0 * self.mesh.edge)))
        return np.concatenate(result)

    # ---- rest -------------------------------------------------------------------------------------------------

    def relax(self, load: Load | None = None, pressure: float = 0.0, max_steps: int = 400_000) -> int:
        """Brings the brick to rest under gravity and load, fully relaxed, and starts the accounts there; steps taken.

        Dynamic relaxation: the explicit step at the relaxed moduli with mass damping near the critical one of the
        lowest mode, whose frequency the last change of forces and displacements estimates (Rayleigh quotient).
        Raises: RunRejected where the beam collapses on the way or does not come to rest.
        """
        load, lay = load or Load(), self._layout
        dt = 0.9 * self._critical(self.material.shear * (1.0 - self.material.g1))
        constants = watched(relaxed_constants(self.material, self.mesh.edge), self.options.min_stretch, 10.0)
        self._memory[:] = 0.0
        self.v[:] = 0.0
        dead = np.zeros(3 * lay.stride) if load.nodal is None else lay.flat(load.nodal)
        block, omega = 40, 3.0
        movable = self._inverse_mass > 0
        mass = 1.0 / self._inverse_mass[movable]
        old_u, old_f = np.zeros(0), np.zeros(0)
        course = np.full(block + 1, pressure)
        for steps in range(block, max_steps, block):
            status, _, _ = self._advance(load, course, dt, 2.0 * omega, constants, dead, dead)
            if status != stepping.DONE:
                raise self._rejection(status)
            force = (self._load + self._weight_force)[movable]
            u, f = self.u[movable], self._f[movable]
            if np.linalg.norm(force - f) <= self.options.static_tolerance * np.linalg.norm(force):
                self.set_state(self.displacement, None, load, pressure)
                return steps
            if len(old_u):
                du, df = u - old_u, f - old_f
                quotient = float((du * df).sum()) / max(float((du * du * mass).sum()), 1e-300)
                omega = math.sqrt(min(max(quotient, 0.25), 4e4))
            old_u, old_f = u, f
        raise RunRejected("static", "The beam did not come to rest under its first load; use a smaller load.")

    # ---- output -----------------------------------------------------------------------------------------------

    def frame(self) -> Frame:
        """Fields and accounts at the present time. Stress and energies are averages over the elements at a node."""
        lay, m = self._layout, self.material
        nodes, stride = self.mesh.nodes, lay.stride
        stress, energy, norm = np.zeros(6 * stride), np.zeros(stride), np.zeros(stride)
        constants = output_constants(viscous_constants(m, self.mesh.edge, self.dt))
        stepping.nodal_output(
            lay.full, lay.grid, self.u, self._memory, lay.weight, tuple(constants),
            lay.tile, stress, energy, norm,
        )  # fmt: skip
        rate = self.dt / (2.0 * m.shear * m.g1 * m.tau) if m.g1 > 0 else 0.0
        dissipated = rate * norm[:nodes] * self._share
        elastic = energy[:nodes] * self._share
        before = self.v - self.dt * self._acceleration()
        moved = lay.nodal(self.u - self._u_start)
        return Frame(
            position=self.mesh.grid.points + lay.nodal(self.u),
            velocity=lay.nodal(0.5 * (self.v + before)),
            stress=lay.nodal(stress) * self._share[:, None],
            elastic_energy=elastic[:, None],
            dissipated_energy=dissipated[:, None],
            load=lay.nodal(self._load),
            kinetic=0.5 * float((self.mass[:, None] * lay.nodal(self.v) * lay.nodal(before)).sum()),
            elastic=float((elastic * self.mesh.volume).sum()),
            dissipated=float((dissipated * self.mesh.volume).sum()),
            work_load=self._work_load,
            work_gravity=float((lay.nodal(self._weight_force) * moved).sum()),
        )
