"""How a seen surface corrects a liquid: choices, and the observer of its sloshing modes.

One camera sees a line of the free surface. The liquid's slowest sloshing modes hold nearly all of its motion, and each
of them says how the whole inside moves with that line: displacements and velocities along them are gradients of
harmonic functions, so they compress nothing. A Kalman filter estimates per mode by how much the twin's height and rate
are off, and beside them how much more viscous the liquid is than told, by how much the whole seen level is off (glass
and liquid refract), and by what share waves look flatter or steeper than they are. It believes the twin as little as
the modes' own swing, damped by viscosity, allows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float

from zsdt.errors import OptionError
from zsdt.twin.assimilation import discrete

LATE = 0.5  # of a push of the vessel: how much of it may be wrong because it comes late
IDLE = 1e-3  # m/s: motion of which an engine may always be wrong
BENDS = 3  # polynomials along the profile, from the tilt on, of which what is seen may be off
BIASES = 2 + BENDS  # of what is seen: level, steepness, bends
EXTRAS = 1 + BIASES  # numbers beside those of the modes: log viscosity, biases
WANDER = 0.2  # s within which a bend that was seen wrongly becomes another
WALL_SHARE = 1.5  # damping by viscosity over that of the inside of a deep liquid alone, 2 nu k^2: the wall rubs, too


class LiquidMethod(Enum):
    """modes: heights and rates of the slowest sloshing modes by an observer. columns: every vertical column of the
    liquid is stretched to the seen height, as in the seed."""

    modes = "modes"
    columns = "columns"


@dataclass
class LiquidAssimilationOptions:
    """How seen surfaces correct the twin of a liquid.

    gain: share of the correction that is applied; 0 is the open loop. noise [m]: standard deviation of a seen height,
    steep_noise: more of it, as a share of how far the surface is from its rest level; independent: how many seen
    heights of a picture say something of their own (errors of neighbours are alike). gate: heights further from the
    fitted surface than this many times the scatter are not taken; patience: frames in a row whose whole surface is
    impossible that are not believed.
    modes: how many. first_height [m], first_rate: doubts about height and, as a share of the liquid's motion, rate of
    the first mode at a first frame that Psi_ini tells; carried_height, carried_rate: at one to which the engine
    carried the liquid. model_error: share of the motion's acceleration that the engine may get wrong.
    viscosity_doubt: relative standard deviation of the told viscosity, 0: it is known; level_doubt [m]: of the whole
    seen level; steep_doubt: share by which seen waves may be steeper or flatter than true ones throughout.
    sight [m]: by how much surfaces that are level look bent, root mean square: masks that err bend them (None: as the
    pictures before t0 show, in which the liquid is level).
    columns: velocity_gain: share of the correction over the frame time that is added to the velocity.
    """

    method: LiquidMethod = LiquidMethod.modes
    gain: float = 1.0
    noise: float = 2e-3
    steep_noise: float = 0.3
    independent: float = 5.0
    gate: float = 5.0
    patience: int = 4
    modes: int = 6
    first_height: float = 1e-3
    first_rate: float = 0.6
    carried_height: float = 4e-4
    carried_rate: float = 0.07
    model_error: float = 0.05
    viscosity_doubt: float = 0.2
    level_doubt: float = 2e-3
    steep_doubt: float = 0.15
    sight: float | None = None
    velocity_gain: float = 0.1

    def __post_init__(self) -> None:
        if not 0.0 <= self.gain <= 1.0 or not 0.0 <= self.velocity_gain <= 1.0:
            raise OptionError("gain and velocity_gain must lie in [0, 1].")
        sure = (self.noise, self.independent, self.gate, self.first_height, self.carried_height)
        if min(sure) <= 0 or self.modes < 1 or self.patience < 0:
            raise OptionError(
                "noise, independent, gate, the first heights and modes must be positive, patience not negative."
            )
        doubts = (self.model_error, self.viscosity_doubt, self.level_doubt, self.steep_doubt, self.sight or 0.0)
        if min(self.steep_noise, self.first_rate, self.carried_rate, *doubts) < 0:
            raise OptionError("steep_noise, the rates, model_error and all doubts must not be negative.")


@dataclass(frozen=True)
class FlowModes:
    """Free modes of the liquid in the shape that it has now, as combinations of given potentials.

    mix [potentials, modes]: potential of a mode per amplitude; back: its inverse; omega [modes] rad/s of the ideal
    liquid; height [modes] m: root mean square rise of the surface per amplitude.
    """

    mix: Float[np.ndarray, "potentials modes"]
    back: Float[np.ndarray, "modes potentials"]
    omega: Float[np.ndarray, " modes"]
    height: Float[np.ndarray, " modes"]


def flow_modes(
    inertia: Float[np.ndarray, "potentials potentials"],
    rise: Float[np.ndarray, "columns potentials"],
    area: Float[np.ndarray, " columns"],
    gravity: float,
) -> FlowModes:
    """Modes of displacements along gradients of potentials. With a sum of potentials that move the liquid, its kinetic
    energy per density is that of the rates with the `inertia` [m3/m4], its potential energy `g/2 int rise^2 dA`.

    rise [columns, potentials]: of the surface in columns of `area` [m2], per displacement potential; gravity [m/s2].
    """
    stiffness = gravity * rise.T @ (area[:, None] * rise)
    square, mix = scipy.linalg.eigh(stiffness, inertia)
    omega = np.sqrt(np.maximum(square, 1.0))
    return FlowModes(mix, mix.T @ inertia, omega, omega / math.sqrt(gravity * float(area.sum())))


@dataclass(frozen=True)
class Estimate:
    """What an update found: changes of the displacement potentials and of the velocity potentials, of the logarithm of
    the viscosity, and of what seen heights are off by: see `biases_of`."""

    move: Float[np.ndarray, " potentials"]
    push: Float[np.ndarray, " potentials"]
    viscosity: float
    biases: Float[np.ndarray, " biases"]


def biases_of(
    x: Float[np.ndarray, " places"], above: Float[np.ndarray, " places"]
) -> Float[np.ndarray, "places biases"]:
    """By how much seen heights [m] are off per bias: the whole level [m]; waves that are `above` [m] the rest level, as
    a share; and Legendre polynomials [m] along the profile, x [places] in half-widths of the vessel."""
    bends = np.polynomial.legendre.legvander(np.clip(x, -1.0, 1.0), BENDS)[:, 1:]
    return np.column_stack([np.ones(len(x)), above, bends])


class SloshObserver:
    """Kalman filter of what is wrong with the twin: displacement and velocity potentials, log viscosity; and with what
    is seen: the biases of `biases_of`.

    The twin itself holds the state; here is `covariance` [2 potentials + 1 + biases, ...] of its errors, in that order.
    Errors swing as the free modes of the liquid in its present shape do (`FlowModes`), damped by viscosity.
    """

    def __init__(
        self, potentials: int, viscosity: float, gravity: float, frame_dt: float, options: LiquidAssimilationOptions
    ):
        """viscosity: kinematic [m2/s]; gravity [m/s2]; frame_dt [s]."""
        self.options, self.count, self.frame_dt = options, potentials, frame_dt
        self.viscosity, self.gravity = viscosity, gravity
        self.covariance = np.zeros((2 * potentials + EXTRAS, 2 * potentials + EXTRAS))
        self.keep = math.exp(-frame_dt / WANDER)  # share of a bend that is still there in the next frame

    def _into(self, modes: FlowModes, of_modes: np.ndarray) -> np.ndarray:
        """A covariance of modal amplitudes and rates as one of potentials, the others as they are."""
        whole = scipy.linalg.block_diag(modes.mix, modes.mix, np.eye(EXTRAS))
        return whole @ of_modes @ whole.T

    def begin(self, modes: FlowModes, rate: Float[np.ndarray, " modes"], carried: bool = False) -> None:
        """Doubts at the first frame; rate [modes]: amplitudes of the modes in the twin's velocity; carried: whether the
        engine carried the liquid there."""
        o, fade = self.options, modes.omega[0] ** 2 / modes.omega**2
        height, share = (o.carried_height, o.carried_rate) if carried else (o.first_height, o.first_rate)
        speed = max(float(np.sqrt(((rate * modes.height) ** 2).sum())), 1e-3)
        spread = [height * fade / modes.height, share * speed * fade / modes.height]
        biases = [o.level_doubt, o.steep_doubt, *[o.sight or 0.0] * BENDS]
        both = np.concatenate([*spread, [o.viscosity_doubt, *biases]])
        self.covariance = self._into(modes, np.diag(both**2))

    def swing(
        self, modes: FlowModes, rate: Float[np.ndarray, " modes"], unevenness: float, shaken: float = 0.0
    ) -> tuple[Float[np.ndarray, "numbers numbers"], Float[np.ndarray, "numbers numbers"]]:
        """How errors go on over one frame, and the covariance of what is added to them. shaken [m/s]: change of the
        vessel's velocity, which comes when it has been seen and so too late."""
        n = self.count
        transition, noise = np.eye(2 * n + EXTRAS), np.zeros((2 * n + EXTRAS, 2 * n + EXTRAS))
        damping = 2.0 * WALL_SHARE * self.viscosity * (modes.omega**2 / self.gravity) ** 2
        speed = float(np.sqrt(((rate * modes.height) ** 2).sum())) + modes.omega[0] * unevenness
        fade = modes.omega[0] ** 2 / modes.omega**2
        # An acceleration that is wrong by a share of the motion's, for as long as a mode turns by a radian.
        wrong = ((self.options.model_error * speed + LATE * shaken) * fade + IDLE) * modes.omega / modes.height
        for i in range(n):
            rates = np.array([[0.0, 1.0], [-(modes.omega[i] ** 2), -2.0 * damping[i]]])
            step, spread = discrete(rates, np.diag([0.0, wrong[i] ** 2 / modes.omega[i]]), self.frame_dt)
            here = np.ix_([i, n + i], [i, n + i])
            transition[here], noise[here] = step, spread
            slide = np.linalg.solve(rates, (step - np.eye(2)) @ [0.0, 1.0])  # of a steady unit acceleration
            transition[[i, n + i], 2 * n] = -2.0 * damping[i] * rate[i] * slide
        bends = np.arange(2 * n + EXTRAS - BENDS, 2 * n + EXTRAS)
        transition[bends, bends] = self.keep
        noise[bends, bends] = (1.0 - self.keep**2) * (self.options.sight or 0.0) ** 2
        back = scipy.linalg.block_diag(modes.back, modes.back, np.eye(EXTRAS))
        whole = scipy.linalg.block_diag(modes.mix, modes.mix, np.eye(EXTRAS))
        return whole @ transition @ back, self._into(modes, noise)

    def seen(
        self,
        rise: Float[np.ndarray, "places potentials"],
        biases: Float[np.ndarray, "places biases"],
        modes: FlowModes,
    ) -> tuple[Float[np.ndarray, "places numbers"], Float[np.ndarray, " numbers"]]:
        """By how much seen heights change with independent numbers (modes and biases): the rows [m], and the variances
        of these numbers."""
        n = self.count
        which = np.append(np.arange(n), np.arange(2 * n + 1, 2 * n + EXTRAS))
        of_modes = scipy.linalg.block_diag(modes.back, np.eye(BIASES))
        spread = of_modes @ self.covariance[np.ix_(which, which)] @ of_modes.T
        return np.column_stack([rise @ modes.mix, biases]), np.maximum(np.diag(spread), 1e-30)

    def look_back(
        self,
        rows: Float[np.ndarray, "places numbers"],
        gap: Float[np.ndarray, " places"],
        noise: Float[np.ndarray, " places"],
    ) -> Estimate:
        """What was wrong at the first frame, from gaps [m] of all pictures since then; `rows` say by how much each
        grows with the numbers of `covariance` at the first frame. Leaves that covariance as the pictures make it.
        """
        cross = self.covariance @ rows.T
        inside = rows @ cross
        inside[np.diag_indices_from(inside)] += noise**2
        kalman = np.linalg.solve(inside, cross.T).T
        self.covariance = self.covariance - kalman @ cross.T
        return self._estimate(kalman @ gap)

    def _estimate(self, change: Float[np.ndarray, " numbers"]) -> Estimate:
        n = self.count
        return Estimate(change[:n], change[n : 2 * n], float(change[2 * n]), change[2 * n + 1 :])

    def doubt(self, modes: FlowModes) -> float:
        """Standard deviation [m] of the surface's height that is expected, root mean square over the surface."""
        n = self.count
        turned = modes.back @ self.covariance[:n, :n]
        return math.sqrt(max(float(((turned * modes.back).sum(axis=1) * modes.height**2).sum()), 0.0))

    def widen(self, factor: float) -> None:
        """Believes displacement and velocity less: variances times `factor`."""
        scale = np.ones(2 * self.count + EXTRAS)
        scale[: 2 * self.count] = math.sqrt(factor)
        self.covariance = scale[:, None] * self.covariance * scale

    def rows(
        self, rise: Float[np.ndarray, "places potentials"], biases: Float[np.ndarray, "places biases"]
    ) -> Float[np.ndarray, "places numbers"]:
        """By how much seen heights [m] grow with the numbers of `covariance`."""
        return np.column_stack([rise, np.zeros((len(rise), self.count + 1)), biases])

    def update(
        self,
        rise: Float[np.ndarray, "places potentials"],
        biases: Float[np.ndarray, "places biases"],
        gap: Float[np.ndarray, " places"],
        taken: Bool[np.ndarray, " places"],
        noise: Float[np.ndarray, " places"],
        gain: float,
    ) -> Estimate:
        """Takes gaps [m] between seen and predicted heights at places that rise by `rise` per displacement potential
        and are off by `biases` per bias.

        noise [places] m: standard deviation of the gaps."""
        observed = self.rows(rise[taken], biases[taken])
        variance = noise[taken] ** 2 * max(1.0, len(observed) / self.options.independent)
        cross = self.covariance @ observed.T
        inside = observed @ cross
        inside[np.diag_indices_from(inside)] += variance
        kalman = gain * np.linalg.solve(inside, cross.T).T
        left = np.eye(len(self.covariance)) - kalman @ observed
        after = left @ self.covariance @ left.T + (kalman * variance) @ kalman.T
        self.covariance = 0.5 * (after + after.T)
        return self._estimate(kalman @ gap[taken])
