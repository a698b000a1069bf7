"""Trust in a recording: curves of how near each flag is, a frame around the picture in the colour of the status, and
the reason in words wherever it changes."""

from __future__ import annotations

import numpy as np
import rerun as rr
from jaxtyping import Float, Int

from zsdt.twin.timeline import clock_of, send_clocked_line
from zsdt.twin.trust import TrustSeries
from zsdt.twin.trust_limits import Flag

Colour = tuple[int, int, int]

TRUSTED, DOUBTED = (110, 205, 90), (240, 70, 60)
PICTURE = "world/camera/trust"
MOST = 4.0  # limits: curves are cut there, so that the limit itself stays to be seen
_COLOURS: dict[str, Colour] = {
    Flag.card: (200, 170, 140),
    Flag.range: (110, 190, 255),
    Flag.energy: (255, 210, 60),
    Flag.entropy: (240, 90, 80),
    Flag.innovation: (205, 120, 220),
    Flag.blind: (150, 200, 200),
}
WORDS: dict[str, str] = {
    Flag.card: "body: size, material",
    Flag.range: "state outside of the training",
    Flag.energy: "energy from nowhere",
    Flag.entropy: "heat that falls",
    Flag.innovation: "innovation",
    Flag.blind: "what nobody sees",
}


def send_trust(
    stream: rr.RecordingStream,
    series: TrustSeries | None,
    frames: Int[np.ndarray, " n"],
    times: Float[np.ndarray, " n"],
    size: tuple[int, int],
) -> None:
    """Sends `plots/trust/*`, the frame around the picture of `size` (width, height) px, and lines of `log/trust`."""
    if series is None or not series.flags:
        return
    for flag, share in series.shares.items():
        percent = 100.0 * np.minimum(np.nan_to_num(share, nan=0.0), MOST)
        send_clocked_line(stream, f"trust/{flag}", frames, times, percent, WORDS.get(flag, flag), _COLOURS[flag])
    send_clocked_line(stream, "trust/limit", frames, times, np.full(len(frames), 100.0), "limit", (235, 235, 235))
    changed = [k for k, text in enumerate(series.flags) if k == 0 or text != series.flags[k - 1]]
    index = clock_of(frames[changed], times[changed])
    colours = [DOUBTED if series.flags[k] else TRUSTED for k in changed]
    _send_frame(stream, series, changed, index, colours, size)
    words = [f"not trusted: {series.reasons[k]}" if series.flags[k] else "trusted" for k in changed]
    levels = [rr.TextLogLevel.WARN if series.flags[k] else rr.TextLogLevel.INFO for k in changed]
    stream.send_columns("log/trust", index, rr.TextLog.columns(text=words, level=levels, color=colours))


def _send_frame(stream, series: TrustSeries, changed: list[int], index, colours: list[Colour], size) -> None:
    width, height = size
    labels = [f"not trusted: {series.flags[k]}" if series.flags[k] else "trusted" for k in changed]
    inside = np.array([[0.5 * width, 0.5 * height]], np.float32)
    half = np.array([[0.494 * width, 0.49 * height]], np.float32)
    stream.log(PICTURE, rr.Boxes2D.from_fields(radii=rr.Radius.ui_points(2.5), show_labels=True), static=True)
    boxes = rr.Boxes2D.columns(
        centers=np.repeat(inside, len(changed), axis=0),
        half_sizes=np.repeat(half, len(changed), axis=0),
        colors=np.array(colours, np.uint8),
        labels=labels,
    )
    stream.send_columns(PICTURE, index, boxes)
