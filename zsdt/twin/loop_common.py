"""What the loops of all twins share: open or closed, the pace of a video, and how latencies are told."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from jaxtyping import Float, UInt8

from zsdt.errors import DataError, OptionError
from zsdt.perception.video import VideoFrame
from zsdt.tignn.sleep import SleepOptions

LONGEST_GAP = 10.0  # s, above which a video is taken for another one

Image = UInt8[np.ndarray, "height width 3"]


class LoopMode(StrEnum):
    """closed: corrected by what is seen. open: predicted from the first frame on."""

    closed = "closed"
    open = "open"


class Clock:
    """Time for latencies and for the pace of the real-time mode; a test gives another one."""

    def now(self) -> float:
        """Seconds from some origin."""
        return time.perf_counter()

    def wait(self, seconds: float) -> None:
        """Lets time pass."""
        time.sleep(seconds)


@dataclass
class LoopOptions:
    """frames: how many, 0 for all. watch: looks in the open loop, too, only to report how far off it is. realtime:
    keeps to the pace of the video; a frame that is later than `deadline` [s] (0: one frame time) is predicted but not
    corrected. look_every: looks at every so-manieth picture only and predicts over the others. sleep: a body at rest is
    neither predicted nor corrected until it is seen elsewhere (`zsdt.tignn.sleep`). keep_fields: the log
    holds the decoded fields (else only the sink gets them). trust: every frame is judged (`zsdt.twin.trust`), with the
    limits beside the engine's weights."""

    mode: LoopMode = LoopMode.closed
    frames: int = 0
    watch: bool = False
    realtime: bool = False
    deadline: float = 0.0
    look_every: int = 1
    sleep: SleepOptions = field(default_factory=SleepOptions)
    keep_fields: bool = True
    trust: bool = True

    def __post_init__(self) -> None:
        if self.frames < 0 or self.deadline < 0:
            raise OptionError("frames and deadline must not be negative.")
        if self.look_every < 1:
            raise OptionError("look_every counts frames from one look to the next; it must be at least 1.")


def missed_frames(frame: VideoFrame, last_time: float, fps: float) -> list[VideoFrame]:
    """Frames that should have come after `last_time` [s] and before `frame`, which lends them its picture.

    Raises: DataError for a gap over which no twin predicts.
    """
    passed = frame.time - last_time
    if passed > LONGEST_GAP:
        raise DataError(
            f"Frame {frame.index} comes {passed:.0f} s after the one before it; the twin would predict that long "
            "without a picture. Cut the video there, or correct its frame rate."
        )
    missing = max(round(passed * fps), 1) - 1
    return [VideoFrame(frame.index - missing + k, last_time + (k + 1) / fps, frame.image) for k in range(missing)]


def latency_table(
    latency: Mapping[str, Float[np.ndarray, " n"]], skip: int, whole: Float[np.ndarray, " n"] | None = None
) -> dict[str, dict[str, float]]:
    """Part -> p50, p95, p99 and most [ms] of the frames after the first `skip`.

    `total` is `whole`, by default the sum of all parts but `capture`.
    """
    parts = {name: values[skip:] for name, values in latency.items()}
    work = [np.nan_to_num(v) for name, v in parts.items() if name != "capture"]
    if whole is not None:
        parts["total"] = whole[skip:]
    else:
        parts["total"] = np.sum(work, axis=0) if work else np.zeros(0)
    table = {}
    for name, values in parts.items():
        known = values[np.isfinite(values)]
        if len(known):
            p50, p95, p99 = np.percentile(known, [50, 95, 99])
            table[name] = {"p50": float(p50), "p95": float(p95), "p99": float(p99), "max": float(known.max())}
    return table
