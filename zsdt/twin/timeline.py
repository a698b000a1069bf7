"""The two timelines of a recording: frames and seconds."""

from __future__ import annotations

import numpy as np
import rerun as rr
from jaxtyping import Float, Int

FRAME, TIME = "frame", "time"


def index_of(frames: Int[np.ndarray, " kept"], times: Float[np.ndarray, " frames"]) -> list[rr.TimeColumn]:
    """Both timelines for the kept frames."""
    nanoseconds = np.rint(1e9 * times[frames]).astype("timedelta64[ns]")
    return [rr.TimeColumn(FRAME, sequence=frames), rr.TimeColumn(TIME, duration=nanoseconds)]


def send_line(
    stream: rr.RecordingStream,
    entity: str,
    times: Float[np.ndarray, " frames"],
    values: Float[np.ndarray, " values"],
    name: str,
    colour: tuple[int, int, int],
    first: int = 0,
) -> None:
    """Sends a series below `plots`; its values begin at the frame `first`. What is not finite is left out."""
    known = first + np.flatnonzero(np.isfinite(values))
    if len(known) == 0:
        return
    stream.log(f"plots/{entity}", rr.SeriesLines(names=[name], colors=[colour], widths=[2.0]), static=True)
    stream.send_columns(f"plots/{entity}", index_of(known, times), rr.Scalars.columns(scalars=values[known - first]))
