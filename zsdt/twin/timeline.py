"""The two timelines of a recording: frames and seconds."""

from __future__ import annotations

import numpy as np
import rerun as rr
from jaxtyping import Float, Int

FRAME, TIME = "frame", "time"


def index_of(frames: Int[np.ndarray, " kept"], times: Float[np.ndarray, " frames"]) -> list[rr.TimeColumn]:
    """Both timelines for the kept frames."""
    return clock_of(frames, times[frames])


def clock_of(frames: Int[np.ndarray, " kept"], times: Float[np.ndarray, " kept"]) -> list[rr.TimeColumn]:
    """Both timelines for frames and their times [s]."""
    nanoseconds = np.rint(1e9 * times).astype("timedelta64[ns]")
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
    frames = first + np.arange(len(values))
    send_clocked_line(stream, entity, frames, times[frames], values, name, colour)


def send_clocked_line(
    stream: rr.RecordingStream,
    entity: str,
    frames: Int[np.ndarray, " values"],
    times: Float[np.ndarray, " values"],
    values: Float[np.ndarray, " values"],
    name: str,
    colour: tuple[int, int, int],
) -> None:
    """Sends a series below `plots`, a value for each frame and time [s]. What is not finite is left out."""
    known = np.isfinite(values)
    if not known.any():
        return
    stream.log(f"plots/{entity}", rr.SeriesLines(names=[name], colors=[colour], widths=[2.0]), static=True)
    columns = rr.Scalars.columns(scalars=values[known])
    stream.send_columns(f"plots/{entity}", clock_of(frames[known], times[known]), columns)
