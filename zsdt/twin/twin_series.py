"""Time series and texts of a twin's recording: errors, innovation, seen nodes, latency, energies, entropy."""

from __future__ import annotations

import numpy as np
import rerun as rr
from jaxtyping import Float

from zsdt.evaluation.ledger import WORK, heat, work_of_ports
from zsdt.twin.plots import ENERGIES
from zsdt.twin.timeline import send_clocked_line
from zsdt.twin.trust import summary_of
from zsdt.twin.twin_errors import ERROR_NAMES, relative_errors, tip_of
from zsdt.twin.twin_view import TwinView

Colour = tuple[int, int, int]

_CLOSED, _OPEN, _TRUTH = (110, 205, 90), (255, 140, 40), (110, 190, 255)
_PARTS: tuple[Colour, ...] = (
    (110, 190, 255),
    (255, 140, 40),
    (120, 210, 130),
    (205, 120, 220),
    (255, 210, 60),
    (240, 90, 80),
    (150, 200, 200),
    (200, 170, 140),
)
_WHITE = (235, 235, 235)
CORRECTION = "work_assimilation"  # entry of a twin's account: what the correction by the camera did on the body
_CORRECTION_COLOUR: Colour = (205, 120, 220)


def send(stream: rr.RecordingStream, view: TwinView, truth: TwinView | None, open_loop: TwinView | None) -> None:
    """Sends all time series of a run; those that it has no numbers for are left out."""
    assert view.seen is not None

    def line(entity: str, values: Float[np.ndarray, " frames"], name: str, colour: Colour) -> None:
        send_clocked_line(stream, entity, view.frames, view.times, values, name, colour)

    sides = [(truth, _TRUTH), (open_loop, _OPEN), (view, _CLOSED if view.closed else _OPEN)]
    for side, colour in sides:
        if side is not None:
            line(f"tip/{_word(side)}", 1e3 * (tip_of(side) - tip_of(truth or view)[0]), side.name, colour)
    if truth is not None:
        for side, colour in sides[1:]:
            if side is None:
                continue
            for number, (name, curve) in enumerate(relative_errors(side, truth).items()):
                shade = _dim(colour) if number else colour
                line(f"error/{_word(side)}_{name}", 100 * curve, f"{side.name}: {ERROR_NAMES[name]}", shade)
    line("innovation/rms", 1e3 * view.innovation_rms(), "root mean square of all seen nodes", _WHITE)
    line("seen/share", 100 * view.seen.reshape(view.count, -1).mean(axis=1), "seen nodes", _WHITE)
    for number, (part, milliseconds) in enumerate(view.latency.items()):
        line(f"latency/{part}", milliseconds, part, _PARTS[number % len(_PARTS)])
    if view.latency:
        line("latency/all", view.milliseconds(), "all but waiting", _WHITE)
    _send_energies(line, view, truth)


def _send_energies(line, view: TwinView, truth: TwinView | None) -> None:
    for before, side in (("", view), ("true ", truth)):
        if side is None or not side.account:
            continue
        account = dict(side.account)
        work = work_of_ports(account)
        if work is not None:
            account[WORK] = work
        for name, colour in {**ENERGIES, CORRECTION: _CORRECTION_COLOUR}.items():
            if name in account:
                entity = f"energy/{before.strip()}{'_' if before else ''}{name}"
                shade = _dim(colour) if before else colour
                line(entity, account[name] - account[name][0], before + name.replace("_", " "), shade)
        booked = heat(account)
        if booked is not None and side.count > 1:
            watts = np.concatenate([[np.nan], np.diff(booked) / np.diff(side.times)])
            line(f"entropy/{_word(side)}", watts, side.name, _TRUTH if before else _CLOSED)


def _word(side: TwinView) -> str:
    return side.name.replace(" ", "_")


def _dim(colour: Colour) -> Colour:
    red, green, blue = colour
    return red // 2, green // 2, blue // 2


def about(view: TwinView, truth: TwinView | None, open_loop: TwinView | None) -> str:
    """What is seen here, in Markdown: clip, body, errors, latency, faults, and how to use the viewer."""
    assert view.seen is not None
    size = " x ".join(f"{100 * s:.0f}" for s in np.ptp(view.body.points, axis=0))
    alone = sum(bool(fault) for fault in view.faults)
    lines = [
        f"# Twin of a beam, {view.name}",
        f"{f'Pictures: {view.source}. ' if view.source else ''}{size} cm, {view.body.nodes} nodes, of which the camera "
        f"sees {view.front.size}; {view.count} frames. In {alone} of them the twin went on alone.",
        "",
    ]
    if truth is not None:
        lines += [
            "Above the twin, below the truth (a simulation that the twin does not know); the blue outline is the truth "
            f"around the twin{', the orange one the open loop' if open_loop is not None else ''}, red points are nodes "
            "that the camera does not see.",
            "",
            "| side | " + " | ".join(f"{ERROR_NAMES[n]} %" for n in relative_errors(view, truth)) + " |",
            "|---|" + "---:|" * len(relative_errors(view, truth)),
        ]
        for side in (view, open_loop):
            if side is not None:
                cells = [f"{100 * np.sqrt(np.mean(c[1:] ** 2)):.3g}" for c in relative_errors(side, truth).values()]
                lines.append(f"| {side.name} | {' | '.join(cells)} |")
        lines.append("")
    if view.latency:
        p50, p99 = np.percentile(view.warm(view.milliseconds()), [50, 99])
        lines.append(f"One frame: {p50:.2f} ms (99 % below {p99:.2f} ms), waiting for its picture not counted.")
    lines += ["", summary_of(view.trust), "", "Tabs above the 3D view choose the field, the slider below the frame."]
    return "\n".join(lines)
