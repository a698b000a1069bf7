"""Energy account of the SPH solver: what there is, what came in, and where it went, in joules."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float

from zsdt.fluid.sph_kernels import APPROACH, DIFFUSION, HEAT, INERTIAL, WALL_WORK


@dataclass
class Account:
    """Energies and works [J] since the accounts were opened.

    kinetic, potential (gravity, the lift at walls and their barrier), internal (sum of m e: heat and compression);
    elastic: compression that the present densities store, part of internal. friction, impulse: heat of viscosity and of
    colliding pairs; numerical: elastic energy that density diffusion and clipping took, heat in `internal`; guard: heat
    of particles stopped at the wall by force. work_inertial: work of the vessel's acceleration and of gravity that
    turns; wall_work: work that pressure walls did, zero in exact arithmetic. spilled: energy that left over the rim.
    residual: kinetic + potential + internal - start - work_inertial - wall_work + spilled, zero at vanishing time step.
    """

    kinetic: float
    potential: float
    internal: float
    elastic: float
    friction: float
    impulse: float
    numerical: float
    guard: float
    work_inertial: float
    wall_work: float
    spilled: float
    residual: float

    def joules(self) -> dict[str, float]:
        """Name -> joules, the columns of a trajectory's ledger."""
        return {f.name: getattr(self, f.name) for f in fields(self)}


class Ledger:
    """Integrates the rates of the kernels by the trapezoidal rule and closes the balance."""

    def __init__(self) -> None:
        self._rates: Float[np.ndarray, " rates"] | None = None
        self._moment, self._gravity = np.zeros(3), np.zeros(3)
        self.friction = self.impulse = self.diffused = self.wall_work = self.work_inertial = 0.0
        self.spilled, self.start, self.peak_kinetic = 0.0, 0.0, 0.0

    def open(self, kinetic: float, other: float) -> None:
        """Starts at these energies [J] with all works zero; the rates seen last are the first ones."""
        self.start, self.peak_kinetic = kinetic + other, kinetic

    def step(
        self,
        dt: float,
        rates: Float[np.ndarray, " rates"],
        moment: Float[np.ndarray, "3"],
        gravity: Float[np.ndarray, "3"],
    ) -> None:
        """Adds a step of dt [s] (0: only remembers) that ends with these rates [W], moment [kg m], gravity [m/s2]."""
        if self._rates is not None and dt > 0:
            mean = 0.5 * dt * (rates + self._rates)
            self.friction += mean[HEAT] - mean[APPROACH]
            self.impulse += mean[APPROACH]
            self.diffused -= mean[DIFFUSION]
            self.wall_work += mean[WALL_WORK]
            self.work_inertial += mean[INERTIAL]
            self.work_inertial -= 0.5 * float((moment + self._moment) @ (gravity - self._gravity))
        self._rates, self._moment, self._gravity = rates.copy(), moment.copy(), gravity.copy()

    def forget_rates(self) -> None:
        """The next step starts anew, without a trapezoid across a change of the particles."""
        self._rates = None

    def account(
        self, kinetic: float, potential: float, internal: float, elastic: float, guard: float, clipped: float
    ) -> Account:
        """The account at the present energies [J]; guard and clipped as the kernels count them."""
        self.peak_kinetic = max(self.peak_kinetic, kinetic)
        total = kinetic + potential + internal + self.spilled
        return Account(
            kinetic=kinetic,
            potential=potential,
            internal=internal,
            elastic=elastic,
            friction=self.friction,
            impulse=self.impulse,
            numerical=self.diffused - clipped,
            guard=guard,
            work_inertial=self.work_inertial,
            wall_work=self.wall_work,
            spilled=self.spilled,
            residual=total - self.start - self.work_inertial - self.wall_work,
        )
