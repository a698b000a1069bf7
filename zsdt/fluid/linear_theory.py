"""Linear theory of sloshing and closed forms of viscous decay: the cheap referee of the solver and of recordings.

Potential flow under a free surface that is nearly flat (Ibrahim, "Liquid Sloshing Dynamics", 2005, chapters 1 and 5;
Abramson, NASA SP-106). A mode n has the wave number k_n and the shape `s_n` (1 at the wall where it is highest), and
`omega_n^2 = g k_n tanh(k_n h)`. Lateral acceleration is the field `-a x`, and x is the sum of `b_n s_n`; hence the
height `q_n` of mode n at the wall obeys

    q_n'' + 2 zeta omega_n q_n' + k_n tanh(k_n h) (G q_n + b_n f_n) = 0

in the axes of the vessel, where G is the part along the vessel's axis and f_n the lateral part of the specific force
(acceleration less gravity) at the height `z_n = h - 2/k_n tanh(k_n h / 2)` of the mode's equivalent mass.
A constant slope comes out exactly: the b_n add up to the half-width.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.special import j1, jn_zeros, jnp_zeros

from zsdt.errors import OptionError

GRAVITY = 9.81


@dataclass(frozen=True)
class SloshingModes:
    """Antisymmetric modes of a liquid of rest height `depth` [m].

    wavenumber [1/m]; weight b_n [m] of x in the modes; norm: mean square of the shape over the cross-section.
    """

    depth: float
    wavenumber: Float[np.ndarray, " modes"]
    weight: Float[np.ndarray, " modes"]
    norm: Float[np.ndarray, " modes"]

    def __post_init__(self) -> None:
        if not self.depth > 0:
            raise OptionError(f"A liquid of depth {self.depth} m does not slosh; give a positive depth.")

    @property
    def stiffness(self) -> Float[np.ndarray, " modes"]:
        """k tanh(k h) [1/m]: the square of the angular frequency over gravity."""
        return self.wavenumber * np.tanh(self.wavenumber * self.depth)

    @property
    def mass_height(self) -> Float[np.ndarray, " modes"]:
        """Height of the equivalent sloshing masses over the floor [m] (Ibrahim 2005, section 5.2)."""
        return self.depth - 2.0 / self.wavenumber * np.tanh(0.5 * self.wavenumber * self.depth)

    def frequency(self, gravity: float = GRAVITY) -> Float[np.ndarray, " modes"]:
        """Frequencies [Hz] under `gravity` [m/s2]."""
        return np.sqrt(gravity * self.stiffness) / (2.0 * np.pi)

    @property
    def kinetic_share_after_stop(self) -> float:
        """Share of the kinetic energy left when a vessel in steady motion stops at once, between 0 and 1.

        The impulse is zero on the free surface, so the liquid is left with the potential `U b_n s_n
        cosh(k z)/cosh(k h)`; in very shallow liquid nothing is lost.
        """
        return float(np.sum(self.weight**2 * self.stiffness * self.norm) / self.depth)


def cylinder_modes(radius: float, depth: float, count: int = 4) -> SloshingModes:
    """First `count` modes cos(theta) J1(k r) of an upright cylinder of `radius` [m]; k R = 1.8412, 5.3314, ...

    Raises: OptionError for a radius, depth or count that is not positive.
    """
    _positive(radius, count)
    root = jnp_zeros(1, count)
    return SloshingModes(
        depth=depth,
        wavenumber=root / radius,
        weight=2.0 * radius / (root**2 - 1.0),
        norm=0.5 * (1.0 - 1.0 / root**2),
    )


def tank_modes(length: float, depth: float, count: int = 4) -> SloshingModes:
    """First `count` antisymmetric modes of a rectangular tank of `length` [m] along the motion; k L = pi, 3 pi, ...

    Raises: OptionError for a length, depth or count that is not positive.
    """
    _positive(length, count)
    odd = 2.0 * np.arange(count) + 1.0
    return SloshingModes(
        depth=depth,
        wavenumber=odd * np.pi / length,
        weight=4.0 * length / (odd * np.pi) ** 2,
        norm=np.full(count, 0.5),
    )


def tank_shapes(modes: SloshingModes, x: float) -> Float[np.ndarray, " modes"]:
    """Shapes of a tank's modes at `x` [m] from its middle; 1 at the wall x = L/2."""
    half = 0.5 * np.pi / modes.wavenumber[0]
    return np.cos(modes.wavenumber * (half - x))


def forced_response(
    modes: SloshingModes,
    times: Float[np.ndarray, " steps"],
    specific_force: Float[np.ndarray, "steps 3"],
    angular_acceleration: Float[np.ndarray, "steps 3"] | None = None,
    damping: float = 0.0,
) -> Float[np.ndarray, "steps modes 2"]:
    """Wall heights of the modes along x and y [m], from rest, by velocity Verlet at the given equidistant times [s].

    specific_force: acceleration of the middle of the vessel's floor less gravity, in vessel axes [m/s2]: (0, 0, 9.81)
    at rest. angular_acceleration: of the vessel, in its axes [rad/s2]. damping: ratio to the critical one, of all
    modes.
    Raises: OptionError where the time step does not resolve the fastest mode.
    """
    step = float(times[1] - times[0])
    omega = np.sqrt(GRAVITY * modes.stiffness)
    if omega.max() * step > 0.5:
        raise OptionError(
            f"A step of {1e3 * step:.1f} ms does not resolve {len(omega)} modes; give finer times or take fewer modes."
        )
    lateral = np.repeat(specific_force[:, None, :2], len(omega), axis=1)
    if angular_acceleration is not None:
        turning = np.stack([angular_acceleration[:, 1], -angular_acceleration[:, 0]], axis=-1)
        lateral = lateral + modes.mass_height[None, :, None] * turning[:, None, :]
    push = -(modes.stiffness * modes.weight)[None, :, None] * lateral
    spring = modes.stiffness[None, :, None] * specific_force[:, 2, None, None]
    drag = (2.0 * damping * omega)[:, None]
    height = np.zeros((len(times), len(omega), 2))
    rate = np.zeros((len(omega), 2))
    pull = push[0]
    for t in range(1, len(times)):
        half = rate + 0.5 * step * pull
        height[t] = height[t - 1] + step * half
        still = push[t] - spring[t] * height[t]
        rate = (half + 0.5 * step * still) / (1.0 + 0.5 * step * drag)
        pull = still - drag * rate
    return height


def highest_at_wall(height: Float[np.ndarray, "steps modes 2"]) -> Float[np.ndarray, " steps"]:
    """Highest point of a cylinder's surface over its rest level [m]: at the wall all its modes share cos(theta)."""
    return np.linalg.norm(height.sum(axis=1), axis=-1)


def wall_damping_ratio(radius: float, viscosity: float, gravity: float = GRAVITY) -> float:
    """Damping ratio of the first mode of a deep cylinder from the boundary layers at its walls alone.

    Logarithmic decrement `4.98 nu^(1/2) R^(-3/4) g^(-1/4)` (Mikishev and Dorozhkin 1961, in Ibrahim 2005, section
    3.3); `viscosity` is the kinematic one [m2/s], `radius` in m. Contact lines and dirty surfaces damp more.
    """
    decrement = 4.98 * math.sqrt(viscosity) * radius**-0.75 * gravity**-0.25
    return decrement / math.sqrt(4.0 * math.pi**2 + decrement**2)


def torsional_decay_rate(radius: float, depth: float, viscosity: float) -> float:
    """Decay rate [1/s] of the slowest swirl in a no-slip cylinder with a free surface on top.

    `v_theta = J1(j r/R) sin(pi z / 2h)` with j = 3.8317 decays as `exp(-nu ((j/R)^2 + (pi/2h)^2) t)`; an exact
    solution of the Navier-Stokes equations while it is slow (no centrifugal flow). Lengths in m, nu in m2/s.
    """
    return viscosity * ((jn_zeros(1, 1)[0] / radius) ** 2 + (0.5 * math.pi / depth) ** 2)


def torsional_velocity(
    points: Float[np.ndarray, "points 3"], radius: float, depth: float, speed: float
) -> Float[np.ndarray, "points 3"]:
    """Velocity [m/s] of that swirl at `points` [m]; `speed` [m/s] multiplies J1 sin."""
    distance = np.hypot(points[:, 0], points[:, 1])
    swirl = speed * j1(jn_zeros(1, 1)[0] * distance / radius) * np.sin(0.5 * np.pi * points[:, 2] / depth)
    turn = swirl / np.maximum(distance, 1e-12)
    return np.stack([-turn * points[:, 1], turn * points[:, 0], np.zeros(len(points))], axis=-1)


def _positive(extent: float, count: int) -> None:
    if not extent > 0 or count < 1:
        raise OptionError("Radius or length of a vessel and the number of modes must be positive.")
