"""Frequency and damping of something that swings freely, with the uncertainty that its own scatter gives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import least_squares

from zsdt.errors import DataError

OUTLIER = 5.0  # robust standard deviations beyond which a sample is left out
LEAST_SAMPLES = 12


@dataclass(frozen=True)
class Mode:
    """A damped cosine: frequency [Hz] as it is seen (damped), damping ratio [-], amplitude at the start of the
    trace, offset it settles at (both in the unit of the trace), and the share of the variance that it explains [-].
    """

    frequency: float
    damping: float
    amplitude: float
    offset: float
    quality: float


def first_mode(trace: Float[np.ndarray, " frames"], dt: float) -> Mode | None:
    """Fits `offset + creep exp(-t/tau) + exp(-decay t) (a cos + b sin)` to a trace sampled every `dt` [s].

    The spectrum gives starts, the fit (variable projection: linear in the four amplitudes) the answer, so that a
    trace of little more than one period suffices. The creep term takes the viscoelastic recovery of the foam.

    Returns: None where the trace is too short (12 samples, one period), does not move, or is no damped cosine.
    """
    count = len(trace)
    span = float(np.ptp(trace)) if count else 0.0
    if count < 12 or not np.isfinite(trace).all() or span <= 1e-12:
        return None
    times = dt * np.arange(count)
    values = (trace - trace.mean()) / span

    def project(shape: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        basis = _basis(times, *shape)
        amounts, *_ = np.linalg.lstsq(basis, values, rcond=None)
        return basis @ amounts - values, amounts

    def misfit(shape: np.ndarray) -> np.ndarray:
        return project(shape)[0]

    best: tuple[float, np.ndarray] | None = None
    lowest, highest = 0.7 / times[-1], 0.45 / dt
    for start in _starts(values, dt, lowest, highest):
        bounds = ([lowest, 0.0, 0.2 * dt], [highest, 20.0 * highest, 10.0 * times[-1]])
        guess = np.array([start, 0.1 * start, 0.2 * times[-1]])
        fit = least_squares(misfit, guess, bounds=bounds, x_scale=guess)
        if best is None or fit.cost < best[0]:
            best = (float(fit.cost), fit.x)
    if best is None:
        return None
    cost, shape = best
    frequency, decay = float(shape[0]), float(shape[1])
    amounts = project(shape)[1]
    quality = 1.0 - 2.0 * cost / float(np.sum(values**2))
    at_edge = frequency < 1.01 * lowest or frequency > 0.99 * highest
    swing = float(np.hypot(*amounts[2:]))
    pulsation = 2.0 * np.pi * frequency
    damping = decay / np.hypot(decay, pulsation)
    if at_edge or quality < 0.5 or damping > 0.7 or swing < 0.02:
        return None
    offset = trace.mean() + span * float(amounts[0])
    return Mode(frequency, float(damping), span * swing, float(offset), quality)


def _basis(times: np.ndarray, frequency: float, decay: float, tau: float) -> np.ndarray:
    swing = np.exp(-decay * times)
    angle = 2.0 * np.pi * frequency * times
    return np.stack([np.ones_like(times), np.exp(-times / tau), swing * np.cos(angle), swing * np.sin(angle)], axis=1)


def _starts(values: np.ndarray, dt: float, lowest: float, highest: float) -> list[float]:
    """The strongest peak of the spectrum and its neighbourhood."""
    size = 8 * len(values)
    spectrum = np.abs(np.fft.rfft((values - values.mean()) * np.hanning(len(values)), size))
    frequencies = np.fft.rfftfreq(size, dt)
    inside = (frequencies >= lowest) & (frequencies <= highest)
    if not inside.any():
        return []
    peak = float(frequencies[inside][np.argmax(spectrum[inside])])
    return [float(np.clip(peak * k, 1.01 * lowest, 0.99 * highest)) for k in (0.7, 1.0, 1.4)]


def free_from(load: Float[np.ndarray, "frames nodes 3"]) -> int:
    """First frame from which the load no longer changes: what follows swings freely."""
    changes = np.flatnonzero(np.abs(np.diff(load, axis=0)).max(axis=(1, 2)) > 1e-9 * max(np.abs(load).max(), 1e-30))
    return int(changes[-1]) + 1 if len(changes) else 0


@dataclass(frozen=True)
class Decay:
    """A free vibration as it was fitted.

    samples [resamples, 2]: frequencies [Hz] and damping ratios that moving blocks of the residual, put back in
    another order, would have given; used: share of the samples that were seen and are no outliers; cycles: how many
    the fitted window holds; noise: root mean square of what the fit leaves (unit of the trace).
    """

    mode: Mode
    samples: Float[np.ndarray, "resamples 2"]
    used: float
    cycles: float
    noise: float

    @property
    def frequency_sd(self) -> float:
        """Standard deviation of the frequency [Hz]."""
        return float(self.samples[:, 0].std()) if len(self.samples) else 0.0

    @property
    def damping_sd(self) -> float:
        """Standard deviation of the damping ratio [-]."""
        return float(self.samples[:, 1].std()) if len(self.samples) else 0.0


def fit_decay(
    times: Float[np.ndarray, " frames"],
    trace: Float[np.ndarray, " frames"],
    resamples: int = 24,
    seed: int = 0,
    near: float | None = None,
) -> Decay:
    """Damped cosine of a trace at equidistant `times` [s]; NaN where nothing was seen.

    The fit of `first_mode`, repeated without the samples that lie more than `OUTLIER` robust standard deviations off,
    until none is left. near: a frequency [Hz] from which to look, where creep would hide it in the spectrum.
    Raises: DataError where too little was seen or what was seen is no damped cosine.
    """
    seen = np.isfinite(trace)
    if seen.sum() < max(LEAST_SAMPLES, 0.5 * len(trace)):
        raise DataError(f"Only {seen.sum()} of {len(trace)} samples of the vibration were seen; record it again.")
    dt = float(times[1] - times[0])
    filled = np.interp(times, times[seen], trace[seen])
    typical = np.median(np.abs(np.diff(filled))) * 1.4826 + 1e-9 * np.ptp(filled)
    jump = np.abs(filled - _running_median(filled))
    keep = seen & (jump <= OUTLIER * max(typical, 0.02 * float(np.ptp(filled))))
    filled = np.interp(times, times[keep], trace[keep])
    start = _start(filled, dt, near)
    for _ in range(5):
        shape, residual = _refine(times, trace, keep, start)
        scale = 1.4826 * float(np.median(np.abs(residual[keep]))) + 1e-12 * float(np.ptp(filled))
        kept = seen & (np.abs(np.where(seen, residual, 0.0)) <= OUTLIER * scale)
        start = shape
        if (kept == keep).all() or kept.sum() < max(LEAST_SAMPLES, 0.5 * len(trace)):
            break
        keep = kept
    fitted = np.where(seen, trace, 0.0) - np.where(seen, residual, 0.0)
    samples = _bootstrap(times, fitted, residual, keep, shape, resamples, seed)
    return Decay(
        mode=_mode_of(times, trace, keep, shape),
        samples=samples,
        used=float(keep.mean()),
        cycles=float(shape[0] * (times[-1] - times[0])),
        noise=float(np.sqrt(np.mean(residual[keep] ** 2))),
    )


def principal_trace(
    displacement: Float[np.ndarray, "frames points 3"],
) -> tuple[Float[np.ndarray, " frames"], Float[np.ndarray, "points 3"]]:
    """The movement of many points as one trace [m]: along the pattern (unit vector) in which they move most.

    A frame in which a point was not seen is NaN.
    """
    flat = displacement.reshape(len(displacement), -1)
    whole = np.isfinite(flat).all(axis=1)
    if whole.sum() < LEAST_SAMPLES:
        raise DataError(f"Only {whole.sum()} frames show all points; leave out the points that are seldom seen.")
    moved = flat[whole] - flat[whole].mean(axis=0)
    pattern = np.linalg.svd(moved, full_matrices=False)[2][0]
    return flat @ pattern, pattern.reshape(displacement.shape[1:])


def _start(trace: np.ndarray, dt: float, near: float | None) -> np.ndarray:
    """First guess of frequency [Hz], decay [1/s], creep time [s]."""
    span = dt * (len(trace) - 1)
    if near is not None:
        return np.array([near, 0.3 * near, 0.2 * span])
    mode = first_mode(trace, dt)
    if mode is None:
        raise DataError("The trace is no damped cosine; choose a window in which the beam swings freely.")
    return np.array([mode.frequency, _rate(mode), 0.2 * span])


def _running_median(values: np.ndarray) -> np.ndarray:
    padded = np.pad(values, 2, mode="edge")
    return np.median(np.lib.stride_tricks.sliding_window_view(padded, 5), axis=1)


def _rate(mode: Mode) -> float:
    return 2.0 * np.pi * mode.frequency * mode.damping / np.sqrt(1.0 - mode.damping**2)


def _refine(
    times: np.ndarray, trace: np.ndarray, keep: Bool[np.ndarray, " frames"], start: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Frequency [Hz], decay [1/s] and creep time [s] by least squares over the kept samples; residual of all."""
    clock = times - times[0]

    def amounts(shape: np.ndarray) -> np.ndarray:
        return np.linalg.lstsq(_basis(clock[keep], *shape), trace[keep], rcond=None)[0]

    def misfit(shape: np.ndarray) -> np.ndarray:
        return _basis(clock[keep], *shape) @ amounts(shape) - trace[keep]

    span = clock[-1]
    low, high = np.array([0.5 * start[0], 0.0, 0.02 * span]), np.array([1.5 * start[0], 20.0 * start[0], 10.0 * span])
    guess = np.clip(start, low + 1e-9, high)
    found = least_squares(misfit, guess, bounds=(low, high), x_scale=np.maximum(guess, 1e-3 * start[0])).x
    return found, trace - _basis(clock, *found) @ amounts(found)


def _mode_of(times: np.ndarray, trace: np.ndarray, keep: np.ndarray, shape: np.ndarray) -> Mode:
    basis = _basis(times - times[0], *shape)[keep]
    amounts = np.linalg.lstsq(basis, trace[keep], rcond=None)[0]
    left = trace[keep] - basis @ amounts
    frequency, decay = float(shape[0]), float(shape[1])
    quality = 1.0 - float(left @ left) / max(float(((trace[keep] - trace[keep].mean()) ** 2).sum()), 1e-300)
    damping = decay / float(np.hypot(decay, 2.0 * np.pi * frequency))
    return Mode(frequency, damping, float(np.hypot(*amounts[2:])), float(amounts[0]), quality)


def _bootstrap(
    times: np.ndarray,
    fitted: np.ndarray,
    residual: np.ndarray,
    keep: np.ndarray,
    shape: np.ndarray,
    resamples: int,
    seed: int,
) -> np.ndarray:
    """Fits to the fitted curve plus blocks of the residual, one period long (the residual is no white noise)."""
    generator = np.random.default_rng(seed)
    left = residual[keep]
    block = int(np.clip(round(1.0 / (shape[0] * (times[1] - times[0]))), 1, len(left)))
    results = np.empty((resamples, 2))
    for k in range(resamples):
        starts = generator.integers(0, len(left) - block + 1, size=len(left) // block + 1)
        drawn = np.concatenate([left[s : s + block] for s in starts])[: len(left)]
        made = np.full(len(times), np.nan)
        made[keep] = fitted[keep] + drawn
        found, _ = _refine(times, made, keep, shape)
        results[k] = found[0], found[1] / np.hypot(found[1], 2.0 * np.pi * found[0])
    return results
