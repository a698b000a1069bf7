"""How a liquid swings as a whole: its centroid, the direction of the swing, its frequency and damping.

Single particles of two simulations part ways quickly; what a person sees is where the bulk of the liquid is.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from zsdt.evaluation.modal import Mode
from zsdt.trajectory import Body

FADED = 0.02  # share of its largest swing below which the centroid of the truth is at rest again
SHORTEST = 12  # samples that a fit needs
LEAST_SWING = 0.02  # of a particle spacing: a centroid that swings less is at rest
LEAST_QUALITY = 0.9  # share of the variance that a damped sine must explain
MOST_DAMPING = 0.85  # nearer to critical damping a frequency has no meaning


def centroid(body: Body, position: Float[np.ndarray, "frames nodes 3"]) -> Float[np.ndarray, "frames 3"]:
    """Centre of mass [m] at every frame."""
    return np.einsum("n,tni->ti", body.mass / body.mass.sum(), position)


def main_direction(path: Float[np.ndarray, "frames 3"]) -> Float[np.ndarray, "3"]:
    """Horizontal unit vector along which a centroid [m] swings about the axis of its vessel.

    The axis of largest spread about x = y = 0, pointing to the side of the largest excursion: the *front*, where the
    liquid first climbs the wall after a stop. Along x where the liquid does not move.
    """
    flat = path[:, :2]
    _, _, axes = np.linalg.svd(flat, full_matrices=False)
    along = flat @ axes[0]
    far = float(along[np.argmax(np.abs(along))])
    if far == 0.0:
        return np.array([1.0, 0.0, 0.0])
    return np.array([*(math.copysign(1.0, far) * axes[0]), 0.0])


def fit_window(trace: Float[np.ndarray, " frames"]) -> int:
    """Frames of a trace [m] until it has faded for good: what truth and prediction are both fitted over."""
    moving = np.flatnonzero(np.abs(trace) > FADED * max(float(np.abs(trace).max()), 1e-30))
    return min(len(trace), max(int(moving[-1]) + 1, SHORTEST)) if len(moving) else len(trace)


def damped_sine(trace: Float[np.ndarray, " frames"], dt: float, least_swing: float = 0.0) -> Mode | None:
    """Fits `offset + exp(-decay t) (a cos wt + b sin wt)` to a trace [m] sampled every `dt` [s].

    Glycerin in a glass swings little more than once, so a spectrum would not find it: the best of a lattice of
    frequencies and dampings starts the fit (variable projection: linear in offset, a and b).

    Returns: None where the trace is too short (12 samples), has numbers that are not finite, swings less than
    `least_swing` [m], is no damped sine (less than 90 % of its variance explained), or creeps back without swinging
    (damping ratio above 0.85, or less than a third of a period seen).
    """
    count = len(trace)
    if count < SHORTEST or not np.isfinite(trace).all():
        return None
    span = float(np.ptp(trace))
    if span <= max(least_swing, 1e-12):
        return None
    times = dt * np.arange(count)
    values = (trace - trace.mean()) / span

    def project(shape: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        fade = np.exp(-shape[1] * times)
        angle = 2.0 * np.pi * shape[0] * times
        basis = np.stack([np.ones(count), fade * np.cos(angle), fade * np.sin(angle)], axis=1)
        amounts, *_ = np.linalg.lstsq(basis, values, rcond=None)
        return basis @ amounts - values, amounts

    def misfit(shape: np.ndarray) -> np.ndarray:
        return project(shape)[0]

    lowest, highest = 0.3 / times[-1], 0.3 / dt
    starts = [(f, 2.0 * np.pi * f * z) for f in np.geomspace(1.2 * lowest, 0.8 * highest, 24) for z in (0.02, 0.2, 0.6)]
    start = np.array(min(starts, key=lambda shape: float(np.sum(misfit(np.array(shape)) ** 2))))
    bounds = ([lowest, 0.0], [highest, 20.0 * highest])
    fit = least_squares(misfit, start, bounds=bounds, x_scale=np.maximum(start, 0.1))
    frequency, decay = float(fit.x[0]), float(fit.x[1])
    amounts = project(fit.x)[1]
    quality = 1.0 - 2.0 * float(fit.cost) / float(np.sum(values**2))
    damping = decay / math.hypot(decay, 2.0 * math.pi * frequency)
    at_edge = frequency < 1.01 * lowest or frequency > 0.99 * highest
    if at_edge or quality < LEAST_QUALITY or damping > MOST_DAMPING:
        return None
    offset = trace.mean() + span * float(amounts[0])
    return Mode(frequency, damping, span * float(np.hypot(*amounts[1:])), offset, quality)


def swing_figures(
    predicted: Float[np.ndarray, " frames"], truth: Float[np.ndarray, " frames"], dt: float, spacing: float
) -> dict[str, float]:
    """Frequency [Hz], damping ratio [-] and their relative errors, of centroids [m] along the main direction.

    Both are fitted over the same window, the one in which the truth moves. `frequency_hz` and `damping` are NaN for
    a prediction that does not swing, the true ones where the truth does not (see `damped_sine`).
    """
    window = fit_window(truth)
    modes = [damped_sine(side[:window], dt, LEAST_SWING * spacing) for side in (predicted, truth)]
    (ours, our_damping), (theirs, true_damping) = [
        (math.nan, math.nan) if mode is None else (mode.frequency, mode.damping) for mode in modes
    ]
    return {
        "frequency_hz": ours,
        "true_frequency_hz": theirs,
        "frequency_error": abs(ours / theirs - 1.0),
        "damping": our_damping,
        "true_damping": true_damping,
        "damping_error": abs(our_damping / true_damping - 1.0),
    }
