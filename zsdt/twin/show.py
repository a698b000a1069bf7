"""Everything that a person gets from one run of the twin: video, recording, pictures, tables.

`keep_run` writes `twin.webm` (the overlay), `twin.rrd`, `twin.h5` (the states), `frames.csv`, `latency.csv`,
`summary.png` and, where the truth is known, `strip.png` (picture, open loop, closed loop, truth at some moments).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from jaxtyping import UInt8

from zsdt.files import atomic_path
from zsdt.perception.video import FrameSource, VideoFrame, write_video
from zsdt.twin.glass_log import GlassRecord
from zsdt.twin.overlay import OverlayOptions
from zsdt.twin.overlay_video import comparison, overlay_pictures, write_picture
from zsdt.twin.twin_errors import relative_errors
from zsdt.twin.twin_log import FrameRecord, TwinLog
from zsdt.twin.twin_plots import run_summary
from zsdt.twin.twin_recording import record_twin
from zsdt.twin.twin_states import TWIN_STATES, write_states
from zsdt.twin.twin_view import TwinView

Picture = UInt8[np.ndarray, "height width 3"]
MOMENTS = 5  # of the strip
STRIP_WIDTH = 1600  # px


class KeptFrames:
    """The pictures of a live source, kept as JPEG while the twin runs, to be drawn over afterwards (a `Sink`)."""

    def __init__(self, fps: float, name: str):
        self.fps, self.name = fps, name
        self._kept: list[tuple[int, float, np.ndarray]] = []

    def __call__(self, record: FrameRecord | GlassRecord, image: Picture | None) -> None:
        """Keeps the picture of a frame, if it came."""
        if image is not None:
            self._kept.append((record.index, record.time, cv2.imencode(".jpg", image)[1]))

    def __iter__(self) -> Iterator[VideoFrame]:
        """The kept frames."""
        for index, time, content in self._kept:
            yield VideoFrame(index, time, np.asarray(cv2.imdecode(content, cv2.IMREAD_COLOR)))


@dataclass
class Sides:
    """The views of a run: closed loop (or the only run), open loop and truth where there are."""

    twin: TwinView
    open_loop: TwinView | None = None
    truth: TwinView | None = None


def keep_run(
    out: str | Path,
    log: TwinLog,
    sides: Sides,
    source: FrameSource | KeptFrames,
    options: OverlayOptions,
    recording: bool = True,
    config_text: str = "",
    say: Callable[[str], None] = lambda line: None,
) -> None:
    """Writes all files of a run into folder `out`; source: its pictures once more. Raises: DataError (disk)."""
    out = Path(out)

    def pictures() -> Iterator[tuple[int, Picture]]:
        return ((frame.index, frame.image) for frame in source)

    say("video")
    write_video(out / "twin.webm", overlay_pictures(sides.twin, pictures(), options), source.fps)
    if recording:
        say("recording")
        record_twin(out / "twin.rrd", sides.twin, pictures(), sides.truth, sides.open_loop, options, config_text)
    write_states(out / TWIN_STATES, log)
    say("pictures and tables")
    with atomic_path(out / "summary.png") as beside:
        beside.write_bytes(run_summary(sides.twin, sides.truth, sides.open_loop))
    if sides.truth is not None:
        wanted = np.unique(np.linspace(0, log.count - 1, MOMENTS).astype(int))
        numbers = {int(log.frames[k]) for k in wanted}
        shown = {number: image.copy() for number, image in pictures() if number in numbers}
        rows = [side for side in (sides.open_loop, sides.twin, sides.truth) if side is not None]
        write_picture(out / "strip.png", narrowed(comparison(shown, rows, options)))
    for name, table in (("frames", frames_table(log, sides)), ("latency", latency_frame(log))):
        with atomic_path(out / f"{name}.csv") as beside:
            table.to_csv(beside, index=False)


def narrowed(image: Picture) -> UInt8[np.ndarray, "lower narrower 3"]:
    """A picture that fits on a page."""
    share = STRIP_WIDTH / image.shape[1]
    return (
        image if share >= 1.0 else np.asarray(cv2.resize(image, None, fx=share, fy=share, interpolation=cv2.INTER_AREA))
    )


def frames_table(log: TwinLog, sides: Sides) -> pd.DataFrame:
    """A row per frame: status, flags of trust and how near each is to its limit, nodes seen, innovation [mm], load [N],
    energies [J], latency [ms], errors if known."""
    table = pd.DataFrame({"frame": log.frames, "time_s": log.times, "status": log.status})
    if log.trust is not None:
        table["trust"] = log.trust.flags
        for flag, share in log.trust.shares.items():
            table[f"trust_{flag}_share"] = share
    table["seen"] = log.seen.sum(axis=1)
    table["innovation_mm"] = 1e3 * sides.twin.innovation_rms()
    for axis, name in enumerate("xyz"):
        table[f"load_{name}_N"] = log.load[:, axis]
    for name, joules in log.account.items():
        table[f"{name}_J"] = joules
    table["dissipated_W"] = log.dissipated_power()
    for part, milliseconds in log.latency.items():
        table[f"{part}_ms"] = milliseconds
    for name, view in (("", sides.twin), ("open_", sides.open_loop)):
        if view is not None and sides.truth is not None:
            for field, curve in relative_errors(view, sides.truth).items():
                table[f"{name}{field}_error"] = curve
    return table


def latency_frame(log: TwinLog) -> pd.DataFrame:
    """Milliseconds of each part of the loop over the frames."""
    rows = [{"part": part, **row} for part, row in log.latency_table().items()]
    rows += [{"part": f"start: {part}", "p50": value} for part, value in log.start_ms.items()]
    return pd.DataFrame(rows)
