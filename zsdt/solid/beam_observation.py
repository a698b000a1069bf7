"""What was seen of a beam over time, in the form in which its material is fitted (`zsdt.solid.characterise`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.signal import savgol_filter

from zsdt.errors import DataError
from zsdt.solid.free_vibration import principal_trace

QUIET = 0.05  # of the highest speed, below which a beam counts as at rest
LEAST_REST = 0.1  # s
LEAST_SWING = 12  # frames
SMOOTH = 5  # frames, window of the smoothing derivative


@dataclass(frozen=True)
class BeamObservation:
    """What was seen of a beam: points that ride on it, over time.

    times [frames] s, equidistant. displacement [frames, points, 3] m from the straight, unloaded shape, beam axes, NaN
    where a point was not seen. places [points, 3] m of the points on the straight beam. resting [frames]: frames in
    which it hangs at rest. swinging [frames]: one stretch of frames in which it swings freely.
    """

    times: Float[np.ndarray, " frames"]
    displacement: Float[np.ndarray, "frames points 3"]
    places: Float[np.ndarray, "points 3"]
    resting: Bool[np.ndarray, " frames"]
    swinging: Bool[np.ndarray, " frames"]

    def rest(self) -> Float[np.ndarray, "points 3"]:
        """Mean displacement at rest [m]. Raises: DataError where a point was never seen at rest."""
        still = self.displacement[self.resting]
        if len(still) == 0 or not np.isfinite(still).any(axis=0).all():
            raise DataError("Some points were never seen at rest; leave them out or mark more frames as resting.")
        return np.nanmean(still, axis=0)


def observe_positions(
    times: Float[np.ndarray, " frames"],
    positions: Float[np.ndarray, "frames points 3"],
    places: Float[np.ndarray, "points 3"],
    released: float | None = None,
    begins_at_rest: bool = False,
) -> BeamObservation:
    """Tracked positions [m] as an observation: front nodes of a twin, markers, nodes of a simulation.

    places [points, 3] m: where the points are on the straight, unloaded beam (`Body.points` of the nodes). positions
    are NaN where a point was not seen. released [s]: from when the beam swings freely; by default from its highest
    speed on. It counts as at rest in the quiet stretch at the end, or in the one at the beginning where it still moves
    at the end (a beam that hung there before it was plucked). begins_at_rest: the first frame is known to show it at
    rest, and only the beginning counts.
    Raises: DataError where there is no quiet stretch or too little of a swing.
    """
    trace, _ = principal_trace(positions - places)
    seen = np.isfinite(trace)
    filled = np.interp(times, times[seen], trace[seen])
    speed = np.abs(savgol_filter(filled, SMOOTH, 2, deriv=1, delta=float(times[1] - times[0]), mode="nearest"))
    start = released if released is not None else float(times[np.argmax(speed)])
    swinging = times >= start
    if swinging.sum() < LEAST_SWING:
        raise DataError("Too little was recorded after the release; record some seconds of free swing.")
    quiet = speed < QUIET * speed.max()
    least = max(round(LEAST_REST / float(times[1] - times[0])), 3)
    resting = _stretch(quiet[::-1])[::-1]
    if begins_at_rest or resting.sum() < least:
        resting = _stretch(quiet)
    if begins_at_rest:
        resting[0], least = True, 1
    if resting.sum() < least:
        raise DataError("The beam never rests in this recording; let it hang still for a moment before or after.")
    return BeamObservation(times, positions - places, places, resting, swinging)


def _stretch(flags: Bool[np.ndarray, " frames"]) -> Bool[np.ndarray, " frames"]:
    """The flags from the first frame on until one is not set."""
    return np.cumsum(~flags) == 0
