"""What is watched while a liquid runs: leaving the range of the method is a rejection with its reason (DESIGN 3.2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from zsdt.errors import OptionError, RunRejected
from zsdt.fluid.ledger import Account
from zsdt.scene import Liquid

VISCOUS = 0.1  # Pa s from which friction damps what an abrupt stop stirs up
GENTLE_SPEED, VISCOUS_SPEED, FULL_RAMP = 0.5, 1.0, 0.02  # m/s, m/s, s: range in which the solver was tested


@dataclass
class WatchOptions:
    """Limits of a run; lengths in particle spacings.

    mach: speed over the speed of sound; density: largest deviation of a density from that at rest, relative; leak:
    depth in the wall below the rim; nearest: distance of the closest two particles; residual: of the energy balance
    over the largest kinetic energy so far, at least `quiet` [J/kg]; layers: least depth of the liquid.
    """

    mach: float = 0.25
    density: float = 0.08
    leak: float = 0.02
    nearest: float = 0.1
    residual: float = 0.02
    quiet: float = 1e-3
    layers: float = 4.0

    def __post_init__(self) -> None:
        if min(self.mach, self.density, self.leak, self.residual, self.quiet, self.layers) <= 0 or self.nearest < 0:
            raise OptionError("Limits of a watched run must be positive.")


def check_range(liquid: Liquid, speed: float, ramp: float) -> None:
    """Refuses stops outside the range in which the solver was tested: a change of speed [m/s] within `ramp` [s].

    Viscous liquids (glycerin): 0.5 m/s at once up to 1 m/s over 20 ms or more; thin ones (water): 0.5 m/s.
    Raises: OptionError with the range.
    """
    if speed < 0 or ramp < 0:
        raise OptionError(f"Speed ({speed} m/s) and duration ({ramp} s) of a stop must not be negative.")
    if liquid.viscosity < VISCOUS:
        limit = GENTLE_SPEED
    else:
        limit = GENTLE_SPEED + (VISCOUS_SPEED - GENTLE_SPEED) * min(ramp / FULL_RAMP, 1.0)
    if speed > limit * (1.0 + 1e-9):
        raise OptionError(
            f"A change of speed by {speed:g} m/s within {1e3 * ramp:g} ms is outside the range in which {liquid.name} "
            f"is computed rightly (up to {limit:g} m/s here); use a slower or, for a viscous liquid, a longer stop."
        )


def check_layers(level: float, spacing: float, limits: WatchOptions) -> None:
    """Rejects a liquid of depth `level` [m] that is too few particles of `spacing` [m] deep ("layers")."""
    if level < limits.layers * spacing:
        raise RunRejected(
            "layers",
            f"The liquid is only {level / spacing:.1f} particles deep, less than {limits.layers:g}; "
            "use smaller particles or more liquid.",
        )


def check_state(
    position: Float[np.ndarray, "particles 3"],
    speed: float,
    density: Float[np.ndarray, " particles"],
    distance: Float[np.ndarray, " particles"],
    rim: float,
    spacing: float,
    liquid: Liquid,
    limits: WatchOptions,
) -> None:
    """Rejects a state outside the limits: positions [m], largest speed [m/s], densities [kg/m3], wall distances [m].

    Raises: RunRejected("not_finite", "mach", "density", "leak" or "clustering").
    """
    if not (np.isfinite(position).all() and np.isfinite(speed) and np.isfinite(density).all()):
        raise RunRejected("not_finite", "A position, speed or density is not a finite number: the run blew up.")
    mach = speed / liquid.sound_speed
    if mach > limits.mach:
        raise RunRejected(
            "mach",
            f"A particle reached {speed:.2f} m/s, {mach:.2f} of the speed of sound (limit {limits.mach:g}); "
            "use a gentler motion or a larger sound_speed.",
        )
    off = float(np.abs(density / liquid.density - 1.0).max())
    if off > limits.density:
        raise RunRejected(
            "density",
            f"A density is {100 * off:.1f} % off that at rest (limit {100 * limits.density:g} %); "
            "use a gentler motion.",
        )
    deep = (distance < -limits.leak * spacing) & (position[:, 2] < rim)
    if deep.any():
        raise RunRejected("leak", f"{int(deep.sum())} particles are inside the wall below the rim; report this motion.")
    if limits.nearest > 0 and len(position) > 1:
        nearest = float(np.asarray(cKDTree(position).query(position, k=2)[0])[:, 1].min()) / spacing
        if nearest < limits.nearest:
            raise RunRejected(
                "clustering",
                f"Two particles are only {nearest:.3f} spacings apart (limit {limits.nearest:g}); "
                "use a gentler motion.",
            )


def check_balance(account: Account, peak_kinetic: float, mass: float, limits: WatchOptions) -> None:
    """Rejects a run whose energies do not add up, measured by its largest kinetic energy [J] ("ledger")."""
    scale = max(peak_kinetic, limits.quiet * mass)
    if not abs(account.residual) <= limits.residual * scale:
        raise RunRejected(
            "ledger",
            f"The energies of the run do not add up: {account.residual:.3g} J of {scale:.3g} J are missing; "
            "use a smaller courant number or a gentler motion.",
        )
