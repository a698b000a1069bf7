"""First frequency of a tip that swings freely (the fit itself: `zsdt.solid.free_vibration`)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from zsdt.solid.free_vibration import Mode, first_mode
from zsdt.trajectory import Body

__all__ = ["Mode", "first_mode", "free_from", "frequencies", "tip_trace"]


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
