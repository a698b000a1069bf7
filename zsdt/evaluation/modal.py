"""First frequency and damping of a tip that swings freely."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from zsdt.trajectory import Body


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


def tip_trace(body: Body, position: Float[np.ndarray, "frames nodes 3"]) -> Float[np.ndarray, "frames 3"]:
    """Mean position [m] of the nodes at the free end (largest reference x) over the frames."""
    x = body.points[:, 0]
    return position[:, x > x.max() - 1e-6 * max(np.ptp(x), 1e-30)].mean(axis=1)


def frequencies(
    body: Body,
    predicted: Float[np.ndarray, "frames nodes 3"],
    truth: Float[np.ndarray, "frames nodes 3"],
    load: Float[np.ndarray, "frames nodes 3"],
    quality: float = 0.9,
) -> tuple[float, float]:
    """Frequencies [Hz] of the free swing of the tip, predicted and true, along the direction in which the truth
    moves most; NaN for the truth where it does not swing clearly (fit below `quality`) and for a prediction that
    does not swing.
    """
    begin = free_from(load)
    ours, theirs = tip_trace(body, predicted)[begin:], tip_trace(body, truth)[begin:]
    if len(theirs) < 12:
        return float("nan"), float("nan")
    axis = int(np.argmax(np.ptp(theirs, axis=0)))
    true_mode = first_mode(theirs[:, axis], body.frame_dt)
    if true_mode is None or true_mode.quality < quality:
        return float("nan"), float("nan")
    our_mode = first_mode(ours[:, axis], body.frame_dt)
    return (float("nan") if our_mode is None else our_mode.frequency), true_mode.frequency
