"""The sub-step form of the graph network for liquids as an `Engine` (DESIGN 4.2, "many cheap local steps").

A particle carries position, velocity, a hidden strain (its pressure) and heat. The reversible bracket L is an exact
adjoint pair of learned sums over neighbours and walls, the friction bracket M has learned non-negative coefficients
and turns the kinetic energy that it takes into heat. Energy is physical by construction: `account` is in joules.
"""

from __future__ import annotations

import json
import math
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from zsdt.errors import DataError, OptionError, RunRejected
from zsdt.files import atomic_path
from zsdt.tignn.engine import NodeField, register_engine
from zsdt.tignn.particle_kernel import ACCOUNT, advance, stored
from zsdt.tignn.particle_options import ParticleOptions
from zsdt.tignn.particle_pairs import BROKEN_LIST, Constants, new_scratch, refresh_list
from zsdt.tignn.particle_profiles import DEGREE, PROFILES, ParticleProfiles, start_profiles
from zsdt.tignn.particle_start import balance
from zsdt.tignn.particle_walls import walls_of
from zsdt.trajectory import Body

KIND = "particle"
BALANCE_STEPS, BALANCE_RESIDUAL = 300, 0.01


@dataclass
class ParticleState:
    """State of a liquid: position m, velocity m/s [n, 3], strain (pressure over rho0 c^2) and heat [J] [n].

    energy [n] J/kg: what internal energy the first frame had beyond its compression; sums [len(ACCOUNT)]: see the
    kernel; held: weight + barrier [J] of the first frame.
    """

    position: Float[np.ndarray, "n 3"]
    velocity: Float[np.ndarray, "n 3"]
    strain: Float[np.ndarray, " n"]
    heat: Float[np.ndarray, " n"]
    energy: Float[np.ndarray, " n"]
    sums: Float[np.ndarray, " sums"]
    held: tuple[float, float]

    def copy(self) -> ParticleState:
        """A state that shares nothing that changes."""
        return replace(
            self, position=self.position.copy(), velocity=self.velocity.copy(), strain=self.strain.copy(),
            heat=self.heat.copy(), sums=self.sums.copy(),
        )  # fmt: skip


class ParticleEngine:
    """Learned profiles, fused kernel, any vessel. See `Engine` for the meaning of the methods.

    graph_milliseconds: time in which the last step built neighbour lists. single: sums over neighbours in single
    precision, nearly twice as fast (set it before `prepare`; see `zsdt.tignn.inference`).
    """

    def __init__(
        self, profiles: ParticleProfiles | None = None, options: ParticleOptions | None = None, name: str = "particle"
    ):
        self.options = options or ParticleOptions()
        self.profiles = profiles or start_profiles(self.options.cutoff, self.options.degree)
        self.name = name
        self.single = False
        self.graph_milliseconds = 0.0

    def applies_to(self, body: Body) -> bool:
        """Whether the body is a liquid in a vessel."""
        return body.liquid is not None and body.vessel is not None and body.nodes > 0

    def prepare(self, body: Body) -> None:
        """Constants, wall table and the sub-step of `body`.

        Raises: OptionError where the body is no liquid in a vessel or its particles differ in mass.
        """
        if not self.applies_to(body):
            raise OptionError("form=particle needs a liquid in a vessel; choose form=cell or form=node for a solid.")
        liquid, dx, o = body.liquid, body.pitch, self.options
        assert liquid is not None and body.vessel is not None
        mass = float(body.mass.mean())
        if mass <= 0 or np.ptp(body.mass) > 1e-3 * mass:
            raise OptionError("form=particle needs particles of one mass; sample the liquid with equal volumes.")
        self.body = body
        self.speed = min(o.sound_speed, liquid.sound_speed)
        cutoff = self.profiles.cutoff
        self.constants = Constants(
            dx, mass, mass / liquid.density, liquid.density * self.speed**2, liquid.viscosity, liquid.density, cutoff,
            o.skin * dx, o.guard * dx, body.gravity.astype(float), o.barrier * dx, o.climb, 1.0,
        )  # fmt: skip
        self.walls = walls_of(body.vessel, dx, cutoff * dx)
        # What is slower than sound rises no higher over the rim.
        self.ceiling = body.vessel.rim + 0.5 * self.speed**2 / max(float(np.linalg.norm(body.gravity)), 1e-9)
        self.scratch = new_scratch(body.nodes, cutoff, self.single)
        self.use(self.profiles)
        self.steps = o.substeps or max(1, math.ceil(body.frame_dt / self.critical_step() - 1e-9))
        self.dt = body.frame_dt / self.steps

    def use(self, profiles: ParticleProfiles) -> None:
        """Sets other profiles without choosing another sub-step."""
        self.profiles = profiles
        self.pair_table, self.wall_table = profiles.tables()

    def critical_step(self) -> float:
        """Longest stable sub-step [s]: `courant` of a sound crossing, and half of what pair friction bears."""
        c = self.constants
        t = np.linspace(0.0, 1.0, 101)
        profiles = (1 - t) ** 3 * (self.pair_table @ t ** np.arange(DEGREE + 1)[:, None])
        friction = 10 * (profiles[1] + 3 * profiles[2]) * 4 * np.pi * (t * c.cutoff) ** 2  # of neighbours over q
        rate = float(np.trapezoid(friction, t * c.cutoff)) * c.viscosity * c.spacing / c.mass
        return min(self.options.courant * c.spacing / self.speed, 1.0 / max(rate, 1e-12))

    def start(self, fields: dict[str, NodeField], load: Float[np.ndarray, "nodes 3"]) -> ParticleState:
        """State at the first frame. The pressure, which nobody sees, is the one that keeps the liquid together."""
        n = self.body.nodes
        x = np.ascontiguousarray(fields["position"], float).copy()
        v = np.ascontiguousarray(fields["velocity"], float).copy()
        self.scratch.since[:] = (
            np.inf
        )  # a list of its own, so that a rollout is the same to the last bit whatever ran before
        pressure = np.zeros(n)
        residual = balance(
            self.constants, self.walls, self.pair_table, self.wall_table, x, v,
            np.ascontiguousarray(load, float), self.scratch, pressure, BALANCE_STEPS, BALANCE_RESIDUAL,
        )  # fmt: skip
        if not residual >= 0:
            raise RunRejected("start", "The first frame's particles are not finite or lie on top of each other.")
        strain = pressure / self.constants.stiffness
        given = fields["internal_energy"][:, 0] if "internal_energy" in fields else np.zeros(n)
        energy = given - 0.5 * self.speed**2 * strain**2
        held = stored(self.constants, self.walls, x)
        return ParticleState(x, v, strain, np.zeros(n), energy, np.zeros(len(ACCOUNT)), held)

    def step(
        self, state: ParticleState, load: Float[np.ndarray, "nodes 3"], load_next: Float[np.ndarray, "nodes 3"]
    ) -> ParticleState:
        """State one frame later (the given one stays as it is).

        Raises: RunRejected where the particles fly apart, collapse or leave their vessel.
        """
        new = state.copy()
        self.run(new, np.ascontiguousarray(load, float), np.ascontiguousarray(load_next, float))
        self._check(state, new)
        return new

    def run(self, state: ParticleState, load: np.ndarray, load_next: np.ndarray) -> None:
        """Advances `state` itself by one frame (see `step`)."""
        before = state.sums[ACCOUNT.index("builds")]
        code = advance(
            self.constants, self.walls, self.pair_table, self.wall_table, state.position, state.velocity,
            state.strain, state.heat, load, load_next, self.steps, self.dt, self.scratch, state.sums,
        )  # fmt: skip
        if code == BROKEN_LIST:
            raise RunRejected("not_finite", "The liquid of the particle engine flew apart or collapsed onto itself.")
        builds = state.sums[ACCOUNT.index("builds")] - before
        self.graph_milliseconds = builds * self._build_milliseconds() if builds else 0.0

    def _check(self, before: ParticleState, state: ParticleState) -> None:
        """Raises RunRejected where a particle outran sound within the frame, is behind a wall (which goes on above the
        rim) or far above the vessel: one that was lost falls for ever, and neither energy nor neighbours tell of it."""
        way = float(np.abs(state.position - before.position).max())
        if not way < self.speed * self.body.frame_dt:
            raise RunRejected(
                "mach", f"A particle went {1e3 * way:.3g} mm within a frame, faster than sound; use a gentler motion."
            )
        nearest, highest = float(self.scratch.wall[:, 0].min()), float(state.position[:, 2].max())
        if not nearest > -self.constants.spacing:
            raise RunRejected(
                "leak", f"A particle is {-1e3 * nearest:.3g} mm behind the wall of its vessel; use a gentler motion."
            )
        if not highest < self.ceiling:
            raise RunRejected(
                "left_range", f"A particle is {highest:.3g} m high, far above its vessel; use a gentler motion."
            )

    def _build_milliseconds(self) -> float:
        """Time of one neighbour list of the present body, measured once."""
        if getattr(self, "_timed", None) is not self.body:
            self._timed, x = self.body, np.ascontiguousarray(self.body.points, float)
            spare = new_scratch(self.body.nodes, self.constants.cutoff, self.single)
            began = time.perf_counter()
            refresh_list(self.constants, x, spare)
            self._built = 1e3 * (time.perf_counter() - began)
        return self._built

    def read(self, state: ParticleState) -> dict[str, NodeField]:
        """Position, velocity, internal energy, and what the truth knows too: density and pressure."""
        liquid = self.body.liquid
        assert liquid is not None
        pressure = self.constants.stiffness * state.strain[:, None]
        return {
            "position": state.position.copy(),
            "velocity": state.velocity.copy(),
            "internal_energy": self.internal(state)[:, None],
            "density": liquid.density / (1.0 - pressure / (liquid.density * liquid.sound_speed**2)),
            "pressure": pressure,
        }

    def internal(self, state: ParticleState) -> Float[np.ndarray, " n"]:
        """Specific internal energy [J/kg]: what was there at first, heat since then, and compression."""
        return state.energy + state.heat / self.constants.mass + 0.5 * self.speed**2 * state.strain**2

    def account(self, state: ParticleState) -> dict[str, float]:
        """Energies [J]; `kinetic + potential + internal - work_of_ports - integrator` stays constant to rounding.

        internal = m e of all particles, of which heat (since the start) and compression; work_of_ports: of the load
        (inertial force of a moving vessel), of the soft barrier before the wall, and of gravity on the volume that
        diffuses between heights; integrator: what the finite sub-step adds to the reversible part; guarded: times a
        particle was put back.
        """
        c = self.constants
        weight, barrier = stored(c, self.walls, state.position)
        gained, load, guarded, _, diffused = state.sums
        wall = state.held[1] - barrier
        return {
            "kinetic": float(0.5 * c.mass * (state.velocity**2).sum()),
            "potential": weight,
            "internal": float(c.mass * self.internal(state).sum()),
            "heat": float(state.heat.sum()),
            "compression": float(0.5 * c.stiffness * c.volume * (state.strain**2).sum()),
            "work_load": float(load),
            "work_wall": wall,
            "work_diffusion": float(diffused),
            "work_of_ports": float(load) + wall + float(diffused),
            "integrator": float(gained) + weight + barrier - sum(state.held),
            "guarded": float(guarded),
        }


def save_particle_engine(folder: str | Path, engine: ParticleEngine) -> None:
    """Writes `engine.json` (kind, options, learned coefficients) into `folder`."""
    card = {
        "kind": KIND,
        "name": engine.name,
        "options": vars(engine.options),
        "cutoff": engine.profiles.cutoff,
        "coefficients": dict(zip(PROFILES, engine.profiles.coefficients.tolist(), strict=True)),
    }
    with atomic_path(Path(folder) / "engine.json") as beside:
        beside.write_text(json.dumps(card, indent=1))


def load_particle_engine(folder: Path) -> ParticleEngine:
    """The engine that `save_particle_engine` wrote.

    Raises: DataError where the file is missing or does not fit.
    """
    try:
        card = json.loads((folder / "engine.json").read_text())
        coefficients = np.array([card["coefficients"][name] for name in PROFILES])
        profiles = ParticleProfiles(float(card["cutoff"]), coefficients)
        engine = ParticleEngine(profiles, ParticleOptions(**card["options"]), card["name"])
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise DataError(f"The particle engine in {folder} is broken ({error}); train it again.") from error
    engine.single = True  # what is learned from is computed in double precision, what is only used need not be
    return engine


register_engine(KIND, load_particle_engine)
