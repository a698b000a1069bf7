"""How an observation corrects the twin: choices, the observer of the modes, and who is believed.

The load on the body is not known. A twin that is only pulled towards what is seen keeps an offset under a load that
stays, and its stress is that of the pull. So the observer estimates three things per vibration mode: amplitude,
velocity, and the unknown force, which wanders and is slowly forgotten. Gains are those of a Kalman filter on the
mode's own (viscoelastic) dynamics. They depend on two physical numbers, the noise of an observed point and how fast an
unknown load may change; they grow in a gap by themselves, and at once when the body is pushed as nobody expected. The
body itself is always stepped by the full engine.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float

from zsdt.errors import OptionError

_C, _V, _H, _F = range(4)


SURPRISE, MOST_SURPRISE = 3.0, 100.0  # from which variances are widened, and by how much at most
MOST_LOAD = 3.0  # an unknown load is at most that of so many seconds of wandering
NOTHING = np.zeros(0)
LEAST_KNOWN = 0.1  # of the prior's precision: a mode of which a picture says less counts as not seen
LONGEST_STEP = 8.0  # of rates times time, that is not taken in halves
FAST_LOAD = 0.5  # of the correction of a fast mode's amplitude, as the share that its load explains


class Method(Enum):
    """observer: amplitude, velocity and unknown load of the body's lowest modes (cell engine only). relaxation:
    observed nodes are pulled towards what is seen, as in the seed (any engine)."""

    observer = "observer"
    relaxation = "relaxation"


@dataclass
class AssimilationOptions:
    """How observations correct the twin.

    gain: share of the correction that is applied; 0 is the open loop. noise [m]: standard deviation of an observed
    point across its ray between frames; first_noise [m]: the same at the first frame, where points are found and not
    tracked; depth_noise [m]: along the ray, where depth is measured.
    observer: modes, sideways_modes: how many (the latter only where the scene is not planar); load_rate [N/sqrt(s)]:
    how fast the unknown load wanders (at most by the body's weight in a second); forget [s]: time after which an
    unseen load is forgotten; first_load [N]: how large an unknown load may already be at the first frame (0: none,
    the beam hangs under its weight); shake [m]: standard deviation by which the whole picture wanders on the face (a
    camera that is not steady).
    calibrate: the first frame weighs the beam: how stiff it is for its weight follows from its sag; stiffness_doubt,
    density_doubt: relative standard deviations of the told card, between which the change is shared.
    gate: points further from the fitted motion than this many times the scatter are not taken.
    relaxation: velocity_gain: share of the correction over the frame time that is added to the velocity; layer_weight:
    correction of each layer of nodes behind the visible one, relative to that in front of it.
    """

    method: Method = Method.observer
    gain: float = 1.0
    noise: float = 2e-4
    first_noise: float = 6e-4
    depth_noise: float = 3e-3
    modes: int = 14
    sideways_modes: int = 8
    load_rate: float = 2.0
    forget: float = 10.0
    first_load: float = 0.0
    shake: float = 3e-4
    calibrate: bool = True
    stiffness_doubt: float = 0.2
    density_doubt: float = 0.12
    gate: float = 5.0
    velocity_gain: float = 0.1
    layer_weight: float = 1.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.gain <= 1.0 or not 0.0 <= self.velocity_gain <= 1.0 or not 0.0 <= self.layer_weight <= 1.0:
            raise OptionError("gain, velocity_gain and layer_weight must lie in [0, 1].")
        if min(self.noise, self.first_noise, self.depth_noise, self.load_rate, self.forget, self.gate) <= 0:
            raise OptionError("noise, first_noise, depth_noise, load_rate, forget and gate must be positive.")
        if self.modes < 1 or min(self.sideways_modes, self.first_load, self.stiffness_doubt, self.shake) < 0:
            raise OptionError(
                "modes must be positive; sideways_modes, first_load, stiffness_doubt, shake not negative."
            )


@dataclass(frozen=True)
class Fit:
    """Result of `robust_fit`: amplitude [modes], its covariance, which points were taken, their scatter (1: as
    expected), and the surprise: what was seen of the amplitudes, squared, over what was to be expected (about 1).
    whitened [modes]: the normalised innovation of each mode, of variance 1 if the prior is right (NaN: not seen)."""

    amplitude: Float[np.ndarray, " modes"]
    covariance: Float[np.ndarray, "modes modes"]
    taken: Bool[np.ndarray, " points"]
    scatter: float
    surprise: float
    whitened: Float[np.ndarray, " _"] = field(default_factory=lambda: np.zeros(0))


def robust_fit(
    rows: Float[np.ndarray, "points numbers modes"],
    gap: Float[np.ndarray, "points numbers"],
    seen: Bool[np.ndarray, " points"],
    prior: Float[np.ndarray, " modes"],
    gate: float,
) -> Fit:
    """Amplitudes that explain `gap` = `rows` @ amplitude + noise of unit variance, without the points that do not fit.

    prior: variance of each amplitude before. Which points fit is judged with a prior a hundred times as wide where
    there are points enough, so that a sudden motion of the whole body is not taken for a crowd of outliers; then they
    are fitted with the prior itself.
    """
    usable = seen & np.isfinite(gap).all(axis=1) & np.isfinite(rows).all(axis=(1, 2))
    count, numbers, modes = rows.shape
    size = np.sqrt((np.where(usable[:, None], gap, 0.0) ** 2).mean(axis=1))
    usual = max(1.0, float(np.median(size[usable]))) if usable.any() else 1.0
    trust = np.where(usable, _trust(size / usual), 0.0)  # who is far from the prediction is not believed at first
    flat = np.where(usable[:, None, None], rows, 0.0).reshape(count * numbers, modes)
    value = np.where(usable[:, None], gap, 0.0).ravel()
    scatter, misfit = 1.0, np.zeros(count)
    wide = (100.0 if usable.sum() * numbers >= 3 * modes else 1.0) * prior
    if usable.any():
        for _ in range(3):
            amplitude = _ridge(flat, value, np.repeat(trust, numbers), wide)[0]
            misfit = np.sqrt(((value - flat @ amplitude).reshape(count, numbers) ** 2).mean(axis=1))
            scatter = max(1.0, 1.2 * float(np.median(misfit[usable])))
            trust = np.where(usable, _trust(misfit / scatter), 0.0)
    taken = usable & (misfit <= gate * scatter)
    weight = np.repeat(taken / scatter**2, numbers)
    amplitude, covariance, surprise, whitened = _ridge(flat, value, weight, prior, whiten=True)
    return Fit(amplitude, covariance, taken, scatter, surprise, whitened)


def _trust(size: Float[np.ndarray, " points"]) -> Float[np.ndarray, " points"]:
    """Weight of a point whose misfit is `size` times the usual one."""
    return 1.0 / (1.0 + (size / 2.0) ** 2) ** 2


def evidence(
    rows: Float[np.ndarray, "points numbers modes"],
    gap: Float[np.ndarray, "points numbers"],
    fit: Fit,
    prior: Float[np.ndarray, " modes"],
) -> float:
    """Logarithm of how likely the gap of the points that `fit` took is under a `prior`, up to what priors share."""
    flat, value = rows[fit.taken].reshape(-1, rows.shape[2]), gap[fit.taken].ravel() / fit.scatter
    scaled = flat * np.sqrt(prior) / fit.scatter
    normal = scaled.T @ scaled + np.eye(len(prior))
    right = scaled.T @ value
    explained = float(right @ np.linalg.solve(normal, right))
    return 0.5 * (explained - float(np.linalg.slogdet(normal)[1]))


def _ridge(
    rows: Float[np.ndarray, "equations modes"],
    value: Float[np.ndarray, " equations"],
    weight: Float[np.ndarray, " equations"],
    prior: Float[np.ndarray, " modes"],
    whiten: bool = False,
) -> tuple[Float[np.ndarray, " modes"], Float[np.ndarray, "modes modes"], float, Float[np.ndarray, " _"]]:
    """Weighted least squares with a prior; amplitude, covariance, surprise and, if asked, whitened innovation (`Fit`).

    Scaled by the prior: nothing is lost. With N = rows' weight rows the innovation `right` has the covariance N + N^2.
    """
    root = np.sqrt(prior)
    scaled = rows * root
    normal = scaled.T @ (weight[:, None] * scaled)
    known = normal.diagonal().copy()
    spread = known + np.einsum("ij,ij->i", normal, normal) if whiten else known
    normal[np.diag_indices_from(normal)] += 1.0
    inverse = np.linalg.inv(normal)
    right = scaled.T @ (weight * value)
    amplitude = inverse @ right
    surprise = float(right @ amplitude) / max(float(known.sum()), 1e-300)
    whitened = np.where(known > LEAST_KNOWN, right / np.sqrt(np.maximum(spread, 1e-300)), np.nan) if whiten else NOTHING
    return root * amplitude, root[:, None] * inverse * root, surprise, whitened


class ModeObserver:
    """Kalman filter of the modes: what is known of amplitude [m kg^1/2], velocity, overstrain and force of each mode.

    The state itself lives in the engine (amplitude, velocity, memory) and in `force` [modes] N kg^-1/2; here are
    the covariances [modes, 4, 4] of their errors. A correction of the amplitude moves the memory by as much, because
    it is a deformation. Modes are taken for uncorrelated before an observation.
    """

    def __init__(
        self,
        frequency: Float[np.ndarray, " modes"],
        stiffening: float,
        tau: float,
        frame_dt: float,
        mass: float,
        weight: float,
        options: AssimilationOptions,
    ):
        """frequency [modes] rad/s of the relaxed body; stiffening: instantaneous over relaxed stiffness; tau [s];
        mass [kg] and weight [N] of the body."""
        count = len(frequency)
        self.force, self.square = np.zeros(count), frequency**2
        # A mode that turns by a radian or more between two frames is seen too seldom to know where in its swing it is,
        # and its frequency in the bent body is not exactly this one. There a push could come at the wrong moment: such
        # modes get none, and less load than amplitude, which takes energy from their swing whatever its phase is.
        self.slow = 1.0 / (1.0 + (frequency * frame_dt) ** 4)
        self.keep = float(np.exp(-frame_dt / options.forget))
        rate = min(options.load_rate, weight)
        density = rate**2 / mass
        self.transition, self.diffusion = np.empty((count, 4, 4)), np.empty((count, 4, 4))
        for k, omega in enumerate(frequency):
            unit = np.array([1.0, omega, 1.0, omega**2])  # of amplitude, velocity, overstrain, force: one size for all
            rates = mode_rates(omega, stiffening, tau, options.forget) * unit / unit[:, None]
            step, spread = discrete(rates, np.diag([0.0, 0.0, 0.0, density / omega**4]), frame_dt)
            self.transition[k], self.diffusion[k] = step * unit[:, None] / unit, spread * unit * unit[:, None]
        # At rest, and as the first frame said; a trace of doubt is left.
        load = (0.05 * rate) ** 2 / mass
        self.covariance = np.zeros((count, 4, 4))
        self.covariance[:, _C, _C] = load / frequency**4
        self.covariance[:, _V, _V] = 0.01 * load / frequency**2
        self.covariance[:, _F, _F] = load
        self.initial, self.most = self.covariance, (MOST_LOAD * rate) ** 2 / mass

    def forecast(self) -> None:
        """One frame without an observation."""
        self.force = self.keep * self.force
        turned = self.transition @ self.covariance
        self.covariance = turned @ self.transition.transpose(0, 2, 1) + self.diffusion

    def restart(self) -> None:
        """Forgets the load, and believes the first state little."""
        self.force = np.zeros_like(self.force)
        self.covariance = self.initial
        self.widen(MOST_SURPRISE)

    def widen(self, factor: float) -> None:
        """Believes the present state less: variances times `factor`, up to that of a load of a few weights.

        Without a limit, modes that are hardly seen would be believed less and less, and at last anything of them.
        """
        wide = factor * self.covariance
        excess = np.maximum(wide[:, _F, _F] / self.most, wide[:, _C, _C] * self.square**2 / self.most)
        self.covariance = np.maximum(1.0, factor / np.maximum(excess, 1.0))[:, None, None] * self.covariance

    @property
    def prior(self) -> Float[np.ndarray, " modes"]:
        """Variance of the amplitudes now."""
        return self.covariance[:, _C, _C]

    def update(self, fit: Fit, gain: float) -> tuple[Float[np.ndarray, " modes"], Float[np.ndarray, " modes"]]:
        """Takes a fit of the amplitudes; gives the changes of amplitude and velocity and changes `force`."""
        count = len(self.force)  # a fit may have found more: how the picture wandered
        before = self.covariance[:, _C, _C]
        after = np.minimum(np.diag(fit.covariance)[:count], before)
        share = self.covariance[:, :, _C] / before[:, None]
        share[:, _V] *= self.slow
        share[:, _H] = 1.0
        most = np.where(self.slow > 0.5, np.inf, FAST_LOAD * self.square)
        share[:, _F] = np.clip(share[:, _F], -most, most)
        change = gain * fit.amplitude[:count]
        self.force = self.force + share[:, _F] * change
        kappa = gain * (1.0 - after / before)
        full = 1.0 - after / before  # posterior = (1 - full) prior = full noise
        noise = np.where(full > 1e-12, after / np.maximum(full, 1e-12), 0.0)
        gains = share * kappa[:, None]
        left = np.broadcast_to(np.eye(4), self.covariance.shape).copy()
        left[:, :, _C] -= gains
        covariance = left @ self.covariance @ left.transpose(0, 2, 1)
        covariance += gains[:, :, None] * gains[:, None, :] * noise[:, None, None]
        self.covariance = 0.5 * (covariance + covariance.transpose(0, 2, 1))
        return share[:, _C] * change, share[:, _V] * change


def mode_rates(omega: float, stiffening: float, tau: float, forget: float) -> Float[np.ndarray, "4 4"]:
    """Rates of amplitude, velocity, overstrain and force of one mode of a standard linear solid.

    c' = v; v' = -w^2 c - (s - 1) w^2 h + f; h' = v - h / tau; f' = -f / forget.
    """
    square = omega**2
    rates = np.zeros((4, 4))
    rates[_C, _V] = 1.0
    rates[_V] = [-square, 0.0, -(stiffening - 1.0) * square, 1.0]
    rates[_H, _V], rates[_H, _H] = 1.0, -1.0 / tau
    rates[_F, _F] = -1.0 / forget
    return rates


def discrete(
    rates: Float[np.ndarray, "n n"], density: Float[np.ndarray, "n n"], dt: float
) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n n"]]:
    """Transition over `dt` [s] and covariance of what white noise of `density` adds meanwhile (Van Loan 1978).

    His block matrix holds exp(-rates dt) beside exp(rates dt), which drowns what dies within a small part of `dt`: so a
    short step is taken and doubled until it is `dt` long.
    """
    n = len(rates)
    doublings = max(0, math.ceil(math.log2(max(float(np.abs(rates).sum(axis=0).max()) * dt / LONGEST_STEP, 1.0))))
    block = np.zeros((2 * n, 2 * n))
    block[:n, :n], block[:n, n:], block[n:, n:] = -rates, density, rates.T
    whole = scipy.linalg.expm(block * (dt / 2**doublings))
    transition = whole[n:, n:].T
    spread = transition @ whole[:n, n:]
    for _ in range(doublings):
        spread = spread + transition @ spread @ transition.T
        transition = transition @ transition
    return transition, 0.5 * (spread + spread.T)
