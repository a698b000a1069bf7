"""Time series and texts of a glass twin's recording: levels, centroid, velocity, errors, volume, energies, latency."""

from __future__ import annotations

import numpy as np
import rerun as rr
from jaxtyping import Float

from zsdt.twin.glass_errors import ERROR_NAMES, error_curves, vertical_velocity_rrmse
from zsdt.twin.glass_view import GlassTwinView
from zsdt.twin.timeline import send_clocked_line
from zsdt.twin.trust import summary_of

Colour = tuple[int, int, int]

_CLOSED, _OPEN, _TRUTH, _SEEN = (110, 205, 90), (255, 140, 40), (110, 190, 255), (255, 220, 80)
_WHITE = (235, 235, 235)
_PARTS: tuple[Colour, ...] = (
    (110, 190, 255),
    (255, 140, 40),
    (120, 210, 130),
    (205, 120, 220),
    (255, 210, 60),
    (240, 90, 80),
    (150, 200, 200),
)
_ENERGIES: dict[str, Colour] = {"kinetic": (110, 190, 255), "potential": (255, 210, 60), "internal": (240, 90, 80)}
WALLS = ("left", "right")


def send(
    stream: rr.RecordingStream, view: GlassTwinView, truth: GlassTwinView | None, open_loop: GlassTwinView | None
) -> None:
    """Sends all time series of a run; those that it has no numbers for are left out."""
    assert view.seen_level is not None
    frames, times = view.frames[view.start :], view.times[view.start :]

    def line(entity: str, values: Float[np.ndarray, " moving"], name: str, colour: Colour) -> None:
        send_clocked_line(stream, entity, frames, times, np.asarray(values), name, colour)

    sides = [(truth, _TRUTH), (open_loop, _OPEN), (view, _CLOSED if view.closed else _OPEN)]
    for number, wall in enumerate(WALLS):
        line(f"{wall}/seen", 1e3 * view.seen_walls()[:, number], "seen", _SEEN)
    for side, colour in sides:
        if side is None:
            continue
        word = side.name.replace(" ", "_")
        for number, wall in enumerate(WALLS):
            line(f"{wall}/{word}", 1e3 * side.walls()[:, number], side.name, colour)
        line(f"centroid/{word}", 1e3 * side.centroid()[:, 0], side.name, colour)
        if side.shows("velocity"):
            line(f"velocity/{word}", 1e3 * side.rise(), side.name, colour)
        if "volume" in side.account:
            volume = np.asarray(side.account["volume"])
            line(f"volume/{word}", 100 * (volume / volume[0] - 1.0), side.name, colour)
        _send_energies(line, side, side is truth)
        if truth is not None and side is not truth and side.shows("velocity"):
            for number, (name, curve) in enumerate(error_curves(side, truth).items()):
                head = ERROR_NAMES[name] + (" [%]" if name == "vertical_velocity" else "")
                factor = 100.0 if name == "vertical_velocity" else 1.0
                line(f"error/{word}_{name}", factor * curve, f"{side.name}: {head}", _shade(colour, number))
    if view.viscosity is not None:
        line("viscosity/estimated", view.viscosity, "estimated over told", _CLOSED)
        if truth is not None and truth.body.liquid is not None and view.body.liquid is not None:
            ratio = truth.body.liquid.viscosity / view.body.liquid.viscosity
            line("viscosity/true", np.full(len(frames), ratio), "true over told", _TRUTH)
    line("innovation/rms", 1e3 * view.innovation_rms(), "root mean square of all seen columns", _WHITE)
    line("seen/share", 100 * np.isfinite(view.seen_level).mean(axis=1), "seen columns", _WHITE)
    for number, (part, milliseconds) in enumerate(view.latency.items()):
        shown = np.asarray(milliseconds)[view.start :]
        line(f"latency/{part}", shown, part, _PARTS[number % len(_PARTS)])
    if view.latency:
        line("latency/all", view.milliseconds()[view.start :], "all but waiting", _WHITE)


def _send_energies(line, side: GlassTwinView, true: bool) -> None:
    for name, colour in _ENERGIES.items():
        if name in side.account:
            joules = np.asarray(side.account[name])
            values = 1e3 * (joules - (0.0 if name == "kinetic" else joules[0]))
            line(f"energy/{side.name.replace(' ', '_')}_{name}", values, f"{side.name}: {name}", _shade(colour, true))


def _shade(colour: Colour, steps: int) -> Colour:
    red, green, blue = colour
    return red >> steps, green >> steps, blue >> steps


def about(view: GlassTwinView, truth: GlassTwinView | None, open_loop: GlassTwinView | None) -> str:
    """What is seen here, in Markdown: clip, liquid, vessel, errors, latency, and how to use the viewer."""
    liquid = view.body.liquid.name if view.body.liquid is not None else "a liquid"
    alone = sum(bool(fault) for fault in view.faults)
    moving = view.count - view.start
    lines = [
        f"# Twin of {liquid} in a glass, {view.name}",
        f"{f'Pictures: {view.source}. ' if view.source else ''}{view.body.nodes} particles "
        f"{1e3 * view.body.pitch:.1f} mm apart, built from the picture at t0 = {view.times[view.start]:.2f} s; "
        f"{moving} frames from there on. In {alone} of them the twin went on alone.",
        "",
        "The yellow line on the twin's glass is the level that the camera saw.",
        "",
    ]
    if truth is not None:
        lines += ["| side | level profile mm | centroid mm | vertical velocity % |", "|---|---:|---:|---:|"]
        for side in (view, open_loop):
            if side is not None and side.shows("velocity"):
                curves = error_curves(side, truth)
                level, middle = (np.sqrt(np.mean(curves[n][1:] ** 2)) for n in ("level_mm", "centroid_mm"))
                rrmse = 100 * vertical_velocity_rrmse(side, truth)
                lines.append(f"| {side.name} | {level:.2f} | {middle:.2f} | {rrmse:.3g} |")
        lines += ["", "Over all frames but the first; the truth is a simulation that the twin does not know."]
    if view.latency:
        p50, p99 = np.percentile(view.warm(view.milliseconds()), [50, 99])
        lines.append(f"One frame: {p50:.2f} ms (99 % below {p99:.2f} ms), waiting for its picture not counted.")
    lines += ["", summary_of(view.trust), "", "Tabs above the 3D view choose the field, the slider below the frame."]
    return "\n".join(lines)
