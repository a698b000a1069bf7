"""Ground truth of liquids: delta-SPH in a moving vessel with walls from its signed distance (DESIGN 3.2).

Coordinates are the vessel's. Time stepping is kick-drift-kick with the forces at predicted velocities and densities.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from zsdt.errors import OptionError
from zsdt.fluid import sph_kernels as kernels
from zsdt.fluid.distance_grid import DistanceGrid
from zsdt.fluid.ledger import Account, Ledger
from zsdt.fluid.vessel import Vessel
from zsdt.fluid.wall_tables import WallTables
from zsdt.fluid.watch import WatchOptions, check_balance, check_layers, check_state
from zsdt.radius_graph import RadiusGraph
from zsdt.scene import Liquid

GRAVITY = (0.0, 0.0, -9.81)
SETTLING_VISCOSITY = 0.2  # Pa s: particles find their places soonest


@runtime_checkable
class Motion(Protocol):
    """How the vessel moves, all in its own axes at time t [s]: acceleration of its origin [m/s2] and gravity [m/s2].

    A motion that turns also has `angular_velocity(t)` [rad/s] and `angular_acceleration(t)` [rad/s2], [3] each.
    """

    def acceleration(self, t: float) -> Float[np.ndarray, "3"]: ...

    def gravity(self, t: float) -> Float[np.ndarray, "3"]: ...


class Still:
    """A vessel that stands still and upright."""

    def acceleration(self, t: float) -> Float[np.ndarray, "3"]:
        """Zero at every time."""
        return np.zeros(3)

    def gravity(self, t: float) -> Float[np.ndarray, "3"]:
        """Straight down at every time [m/s2]."""
        return np.array(GRAVITY)


@dataclass
class SphOptions:
    """Numerical choices; lengths are in particle spacings.

    smoothing: smoothing length; delta: density diffusion; courant: time step over h / c0; skin: of the neighbour
    list, over 2 h; approach, wall_approach: impulse of closing pairs and of particles closing on a wall (Riemann-like,
    over their speed over c0); barrier, barrier_depth: speed [m/s] and range of the weak energy barrier of the wall;
    guard: distance below which a particle is put back and counted; friction_depth: least distance in the no-slip term;
    lift: whether the weight that the truncated pressure gradient at walls does not carry is made up for;
    lowest_density, highest_density: clipping, relative; fineness: cells of the wall tables per h.
    """

    smoothing: float = 1.5
    delta: float = 0.1
    courant: float = 0.3
    skin: float = 0.1
    approach: float = 3.0
    wall_approach: float = 1.0
    barrier: float = 0.5
    barrier_depth: float = 0.2
    guard: float = 0.05
    friction_depth: float = 0.25
    lift: bool = True
    lowest_density: float = 0.93
    highest_density: float = 1.4
    fineness: float = 5.0
    watch: WatchOptions = field(default_factory=WatchOptions)

    def __post_init__(self) -> None:
        if not (self.smoothing >= 1.0 and self.courant > 0 and self.fineness >= 2 and self.skin > 0):
            raise OptionError("An SPH solver needs smoothing >= 1, courant > 0, skin > 0 and fineness >= 2.")
        if min(self.delta, self.approach, self.wall_approach, self.barrier) < 0 or self.friction_depth <= 0:
            raise OptionError("Delta, impulses and barrier must not be negative and friction_depth must be positive.")
        if not 0 < self.guard < self.barrier_depth:
            raise OptionError("The guard of the wall must lie between the wall and its barrier.")
        if not 0 < self.lowest_density < 1 < self.highest_density:
            raise OptionError("Densities must be clipped below and above that at rest.")


@dataclass
class LiquidFrame:
    """State of all particles in the order in which they were given, spilled ones where they left.

    position [m], velocity [m/s], density [kg/m3], pressure [Pa], internal_energy [J/kg], inside: not spilled.
    """

    time: float
    position: Float[np.ndarray, "particles 3"]
    velocity: Float[np.ndarray, "particles 3"]
    density: Float[np.ndarray, "particles 1"]
    pressure: Float[np.ndarray, "particles 1"]
    internal_energy: Float[np.ndarray, "particles 1"]
    inside: Bool[np.ndarray, " particles"]
    account: Account


class SphSolver:
    """Particles of one mass, `density * spacing^3`, of `liquid` in `vessel`, at rest at `positions` [m] to begin with.

    motion: of the vessel (stands still if None). tables: wall tables made before for the same vessel and smoothing
    length, to save the second it takes. `time` [s]; `guards`: contacts with the guard of the wall so far; `clips`:
    densities clipped; `spilled`: particles gone over the rim.

    Raises: OptionError, RunRejected("layers").
    """

    def __init__(
        self,
        vessel: Vessel,
        liquid: Liquid,
        positions: Float[np.ndarray, "particles 3"],
        spacing: float,
        options: SphOptions | None = None,
        motion: Motion | None = None,
        tables: WallTables | None = None,
    ):
        self.options, self.vessel, self.liquid = options or SphOptions(), vessel, liquid
        self.motion: Motion = motion or Still()
        if not spacing > 0 or len(positions) == 0:
            raise OptionError("A liquid needs at least one particle and a positive spacing.")
        self.spacing, self.h = spacing, self.options.smoothing * spacing
        self.particles, self.time, self.steps = len(positions), 0.0, 0
        self.level = vessel.level(len(positions) * spacing**3)
        check_layers(self.level, spacing, self.options.watch)
        if tables is not None and not math.isclose(tables.h, self.h, rel_tol=1e-9):
            raise OptionError(f"Wall tables for h = {tables.h:g} m do not fit a smoothing length of {self.h:g} m.")
        self.tables = tables or WallTables(vessel, self.h, self.options.fineness)
        self.distances = DistanceGrid(vessel, self.h / self.options.fineness)
        self._frozen = self._nothing(positions)
        self._take(np.arange(self.particles), positions)
        self.start()

    def _nothing(self, positions: Float[np.ndarray, "particles 3"]) -> dict[str, np.ndarray]:
        """What frames show of particles that are not in the simulation any more."""
        n = len(positions)
        rest = np.full(n, self.liquid.density)
        return {"x": np.array(positions, np.float64), "v": np.zeros((n, 3)), "density": rest, "energy": np.zeros(n)}

    def _take(self, index: np.ndarray, positions: np.ndarray) -> None:
        """Sets up the arrays for the particles `index`, at rest, with the densities of the liquid at rest."""
        n = len(index)
        self._index, self.mass = index, np.full(n, self.liquid.density * self.spacing**3)
        self.x, self.v = np.array(positions, np.float64), np.zeros((n, 3))
        self.density = self._density_at_rest()
        self.energy = np.zeros(n)
        self._allocate()

    def _density_at_rest(self) -> Float[np.ndarray, " particles"]:
        """Density [kg/m3] at the present positions under the weight of the liquid above, the vessel upright."""
        depth = np.maximum(self.level - self.x[:, 2], 0.0)
        return self.liquid.density / (1.0 + GRAVITY[2] * depth / self.liquid.sound_speed**2)

    def _allocate(self) -> None:
        n = len(self.x)
        self._record, self._sums = np.zeros((kernels.RECORD, n)), np.zeros((n, kernels.SUMS))
        self._wall = np.zeros((n, kernels.WALL))
        self._acceleration, self._inner = np.zeros((n, 3)), np.zeros((n, 3))
        self._ahead_v, self._rate, self._warming = np.zeros((n, 3)), np.zeros(n), np.zeros(n)
        self._graph = RadiusGraph(2.0 * self.h, 2.0 * self.h * self.options.skin)
        self._ready = False

    # ---- states -----------------------------------------------------------------------------------------------

    def start(self, velocity: Float[np.ndarray, "particles 3"] | None = None) -> None:
        """Opens the accounts at the present positions and densities: time and internal energy zero, `velocity` [m/s]
        of all particles (at rest if None)."""
        self.time, self.guards, self.clips = 0.0, 0, 0
        self.v[:] = 0.0 if velocity is None else np.asarray(velocity)[self._index]
        self.energy[:] = 0.0
        self._counts, self._rates, self._moment = np.zeros(4), np.zeros(kernels.RATES), np.zeros(3)
        self.ledger = Ledger()
        self._evaluate_now()
        energies = self._energies()
        self.ledger.open(energies[0], energies[1] + energies[2])

    def settle(self, duration: float, damping: float = 40.0, viscosity: float = SETTLING_VISCOSITY) -> float:
        """Brings the particles to rest in a vessel at rest during `duration` [s], then starts anew.

        Densities are held at those of the liquid at rest while the particles find the places in which these pressures
        balance their weight; left to themselves, both would creep towards each other for seconds. Velocities are
        damped at the rate `damping` [1/s] and by `viscosity` [Pa s].

        Returns the largest speed left at the end of it [m/s].
        """
        liquid, motion = self.liquid, self.motion
        self.motion = Still()
        self.liquid = Liquid(liquid.name, liquid.density, viscosity, liquid.sound_speed)
        steps = max(1, math.ceil(duration / self.critical_dt))
        fade = math.exp(-damping * duration / steps)
        self._ready = False
        for _ in range(steps):
            self._step(duration / steps)
            self.v *= fade
            self.density = self._density_at_rest()
        left = float(np.sqrt((self.v**2).sum(axis=1).max()))
        self.liquid, self.motion = liquid, motion
        self._check()
        self.start()
        return left

    @property
    def critical_dt(self) -> float:
        """Time step [s]: sound, or friction, crosses a fraction of the smoothing length."""
        sound = self.options.courant * self.h / self.liquid.sound_speed
        if self.liquid.viscosity == 0.0:
            return sound
        return min(sound, 0.125 * self.h**2 * self.liquid.density / self.liquid.viscosity)

    @property
    def spilled(self) -> int:
        """Particles that have gone over the rim."""
        return self.particles - len(self._index)

    @property
    def graph_seconds(self) -> float:
        """Wall time that neighbour lists have taken [s] since a particle was spilled last, or from the beginning."""
        return self._graph.seconds

    # ---- stepping ---------------------------------------------------------------------------------------------

    def advance(self, duration: float) -> None:
        """Runs `duration` [s] in equal steps, then looks whether the state is still in range.

        Raises: RunRejected.
        """
        steps = max(1, math.ceil(duration / self.critical_dt - 1e-9))
        for _ in range(steps):
            self._step(duration / steps)
        self._check()

    def _step(self, dt: float) -> None:
        o, n = self.options, len(self.x)
        if not self._ready:
            self._evaluate_now()
        ahead_density, grid = np.empty(n), self.distances
        before, pushed = self.mass @ self.v, self._frame[:3]
        kernels.kick_drift(
            dt, self.x, self.v, self.density, self.energy, self._acceleration, self._inner, self._rate, self._warming,
            self._ahead_v, ahead_density, self._wall, self.mass, self.spacing, o.guard * self.spacing, self.vessel.rim,
            grid.table, grid.low, grid.inverse_spacing, self._counts,
        )  # fmt: skip
        middle = self.mass @ self.v
        self._evaluate(self._ahead_v, ahead_density, self.time + dt)
        kernels.kick(
            dt, self.v, self.density, self.energy, self._acceleration, self._inner, self._rate, self._warming,
            self._ahead_v, self._sums, self.mass, self._constants, o.lowest_density, o.highest_density, self._counts,
        )  # fmt: skip
        after = self.mass @ self.v
        # Each half kick does its work along the mean of the velocities before and after it.
        self.ledger.work_inertial -= 0.25 * dt * float(pushed @ (before + middle) + self._frame[:3] @ (middle + after))
        self.time += dt
        self.steps += 1
        self.ledger.step(dt, self._rates, self._moment, self._gravity)
        self._drop_spilled()

    def _evaluate_now(self) -> None:
        """Forces of the present state; the accounts go on from there."""
        self._ahead_v[:] = self.v
        self._evaluate(self.v, self.density, self.time)
        self.ledger.forget_rates()
        self.ledger.step(0.0, self._rates, self._moment, self._gravity)

    @property
    def _constants(self) -> tuple[float, float, float]:
        return self.liquid.density, self.liquid.sound_speed, self.liquid.viscosity

    def _frame_motion(self, t: float) -> Float[np.ndarray, "9"]:
        frame = np.zeros(9)
        frame[:3] = self.motion.acceleration(t)
        if hasattr(self.motion, "angular_velocity"):
            frame[3:6] = self.motion.angular_velocity(t)
            frame[6:] = self.motion.angular_acceleration(t)  # type: ignore[attr-defined]
        return frame

    def _evaluate(self, velocity: np.ndarray, density: np.ndarray, t: float) -> None:
        """Accelerations and rates of the present positions at these velocities and densities."""
        o, tables, grid, liquid = self.options, self.tables, self.distances, self._constants
        self._gravity = np.asarray(self.motion.gravity(t), np.float64)
        self._frame = frame = self._frame_motion(t)
        self._graph.update(self.x)
        kernels.fill_records(
            self.x, velocity, density, self.mass, liquid, self.h, grid.table, grid.low, grid.inverse_spacing,
            tables.table, tables.low, tables.inverse_spacing, self._record, self._wall,
        )  # fmt: skip
        effective = self._gravity - frame[:3]
        self._rates[kernels.APPROACH] = kernels.sum_pairs(
            self._graph.offset, self._graph.neighbour, self._record, self.h, liquid,
            liquid[0] / liquid[1] ** 2 * effective, o.approach, self._sums,
        )  # fmt: skip
        kernels.finish(
            self._record, self._wall, self._sums, self.mass, self.h, liquid, 2.0 * o.delta * self.h * liquid[1],
            self._wall_options, self._gravity, frame, self._acceleration, self._inner, self._rate, self._warming,
            self._rates, self._moment,
        )  # fmt: skip
        self._ready = True

    @property
    def _wall_options(self) -> tuple[float, ...]:
        o = self.options
        depth, barrier = o.friction_depth * self.spacing, o.barrier_depth * self.spacing
        return o.wall_approach, depth, o.barrier, barrier, float(o.lift)

    def _energies(self) -> tuple[float, float, float, float]:
        """Kinetic, potential, internal and elastic energy [J] now."""
        o = self.options
        kinetic = 0.5 * float((self.mass * (self.v**2).sum(axis=1)).sum())
        close = np.maximum(1.0 - self._wall[:, 0] / (o.barrier_depth * self.spacing), 0.0)
        potential = -float(self._moment @ self._gravity) + 0.5 * o.barrier**2 * float((self.mass * close**2).sum())
        squeeze = 1.0 - self.liquid.density / self.density
        elastic = 0.5 * self.liquid.sound_speed**2 * float((self.mass * squeeze**2).sum())
        return kinetic, potential, float((self.mass * self.energy).sum()), elastic

    def account(self) -> Account:
        """The energy account now."""
        return self.ledger.account(*self._energies(), guard=float(self._counts[1]), clipped=float(self._counts[3]))

    # ---- watching ---------------------------------------------------------------------------------------------

    def _drop_spilled(self) -> None:
        """Takes particles out of the simulation that are above the rim and outside the footprint of the vessel."""
        gone = (self.x[:, 2] > self.vessel.rim) & (self._wall[:, 0] < 0.0)
        if not gone.any():
            return
        before = sum(self._energies()[:3])
        for name, values in self._frozen.items():
            values[self._index[gone]] = getattr(self, name)[gone]
        keep = ~gone
        for name in ("x", "v", "density", "energy", "mass", "_index"):
            setattr(self, name, np.ascontiguousarray(getattr(self, name)[keep]))
        self._allocate()
        self._evaluate_now()
        self.ledger.spilled += before - sum(self._energies()[:3])

    def _check(self) -> None:
        """Raises RunRejected where the state left the range."""
        self.guards, self.clips = int(self._counts[0]), int(self._counts[2])
        speed = float(np.sqrt((self.v**2).sum(axis=1).max()))
        distance = self.distances.lookup(self.x)[0] if np.isfinite(self.x).all() else self._wall[:, 0]
        limits = self.options.watch
        check_state(self.x, speed, self.density, distance, self.vessel.rim, self.spacing, self.liquid, limits)

    def frame(self) -> LiquidFrame:
        """The state now. Raises: RunRejected("ledger") where the energies do not add up."""
        account = self.account()
        check_balance(account, self.ledger.peak_kinetic, float(self.mass.sum()), self.options.watch)
        shown = {name: values.copy() for name, values in self._frozen.items()}
        for name, values in shown.items():
            values[self._index] = getattr(self, name)
        inside = np.zeros(self.particles, bool)
        inside[self._index] = True
        return LiquidFrame(
            time=self.time,
            position=shown["x"],
            velocity=shown["v"],
            density=shown["density"][:, None],
            pressure=self.liquid.pressure(shown["density"])[:, None],
            internal_energy=shown["energy"][:, None],
            inside=inside,
            account=account,
        )
