"""Everything that a person gets from one run of the glass twin: video, recording, pictures, tables.

`keep_glass_run` writes `twin.webm` (the overlay), `twin.rrd`, `twin.h5` (the states), `frames.csv`, `latency.csv`,
`summary.png`, `strip.png` (picture, open loop, closed loop and, in the virtual lab, the truth at the moments of the
seed's Fig. 5).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import UInt8

from zsdt.files import atomic_path
from zsdt.perception.video import FrameSource, write_video
from zsdt.twin.glass_errors import error_curves
from zsdt.twin.glass_log import GlassTwinLog
from zsdt.twin.glass_overlay import GlassOverlayOptions
from zsdt.twin.glass_plots import glass_summary
from zsdt.twin.glass_recording import record_glass_twin
from zsdt.twin.glass_video import glass_comparison, glass_frames, moments_of
from zsdt.twin.glass_view import GlassTwinView
from zsdt.twin.overlay_video import write_picture
from zsdt.twin.show import KeptFrames, narrowed
from zsdt.twin.twin_states import TWIN_STATES, write_states

Picture = UInt8[np.ndarray, "height width 3"]


@dataclass
class GlassSides:
    """The views of a run: closed loop (or the only run), open loop and truth where there are."""

    twin: GlassTwinView
    open_loop: GlassTwinView | None = None
    truth: GlassTwinView | None = None

    @property
    def rows(self) -> list[GlassTwinView]:
        """From the open loop to the truth."""
        return [side for side in (self.open_loop, self.twin, self.truth) if side is not None]


def keep_glass_run(
    out: str | Path,
    log: GlassTwinLog,
    sides: GlassSides,
    source: FrameSource | KeptFrames,
    options: GlassOverlayOptions,
    recording: bool = True,
    config_text: str = "",
    say: Callable[[str], None] = lambda line: None,
) -> None:
    """Writes all files of a run into folder `out`; source: its pictures once more. Raises: DataError (disk)."""
    out = Path(out)

    def pictures() -> Iterator[tuple[int, Picture]]:
        return ((frame.index, frame.image) for frame in source)

    say("video")
    drawn = (image for _, image in glass_frames(sides.twin, pictures(), options))
    write_video(out / "twin.webm", drawn, source.fps)
    if recording:
        say("recording")
        record_glass_twin(out / "twin.rrd", sides.twin, pictures(), sides.truth, sides.open_loop, options, config_text)
    write_states(out / TWIN_STATES, log)
    say("pictures and tables")
    with atomic_path(out / "summary.png") as beside:
        beside.write_bytes(glass_summary(sides.twin, sides.truth, sides.open_loop))
    numbers = set(moments_of(sides.twin))
    shown = {number: image.copy() for number, image in pictures() if number in numbers}
    write_picture(out / "strip.png", narrowed(glass_comparison(shown, sides.rows, options)))
    for name, table in (("frames", glass_table(log, sides)), ("latency", glass_latency_frame(log))):
        with atomic_path(out / f"{name}.csv") as beside:
            table.to_csv(beside, index=False)


def glass_table(log: GlassTwinLog, sides: GlassSides) -> pd.DataFrame:
    """A row per frame: status, flags of trust and how near each is to its limit, seen columns, innovation, levels at
    the walls, centroid, volume, energies, latency, errors where the truth is known; empty before t0, without particles.
    """
    view, start = sides.twin, log.start
    table = pd.DataFrame({"frame": log.frames, "time_s": log.times, "status": log.status})
    table["vessel_x_mm"] = 1e3 * log.origin[:, 0]

    def put(name: str, values: np.ndarray) -> None:
        table[name] = np.concatenate([np.full(start, np.nan), np.asarray(values, np.float64)])

    if log.trust is not None:
        table["trust"] = [""] * start + log.trust.flags
        for flag, share in log.trust.shares.items():
            put(f"trust_{flag}_share", share)
    put("seen_columns", np.isfinite(log.seen_level).sum(axis=1))
    put("innovation_mm", 1e3 * view.innovation_rms())
    for number, wall in enumerate(("left", "right")):
        put(f"level_{wall}_mm", 1e3 * view.walls()[:, number])
        put(f"seen_{wall}_mm", 1e3 * view.seen_walls()[:, number])
    put("centroid_x_mm", 1e3 * view.centroid()[:, 0])
    put("centroid_z_mm", 1e3 * view.centroid()[:, 2])
    if view.shows("velocity"):
        put("vertical_velocity_rms_mm_s", 1e3 * view.rise())
    put("viscosity_over_told", log.viscosity)
    put("level_offset_mm", 1e3 * log.level_offset)
    put("taken_share", log.taken)
    units = {"volume": ("cm3", 1e6)}
    for name, values in log.account.items():
        unit, factor = units.get(name, ("J", 1.0))
        put(f"{name}_{unit}", factor * np.asarray(values))
    for part, milliseconds in log.latency.items():
        table[f"{part}_ms"] = milliseconds
    for before, side in (("", view), ("open_", sides.open_loop)):
        if side is not None and sides.truth is not None and side.shows("velocity"):
            for name, curve in error_curves(side, sides.truth).items():
                put(f"{before}{name}_error", curve)
    return table


def glass_latency_frame(log: GlassTwinLog) -> pd.DataFrame:
    """Milliseconds of each part of the loop over the frames from t0 on, and of what happens once at t0."""
    rows = [{"part": part, **row} for part, row in log.latency_table().items()]
    rows += [{"part": f"start: {part}", "p50": value} for part, value in log.start_ms.items()]
    return pd.DataFrame(rows)
