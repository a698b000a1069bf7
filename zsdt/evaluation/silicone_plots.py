"""Pictures of the real silicone beam: measured and predicted heights, a withheld marker, choices."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from zsdt.evaluation.silicone import Prediction
from zsdt.evaluation.silicone_twin import Withheld
from zsdt.interop.silicone_beam import MARKERS, SiliconeRecording

TITLES = {"gravity": "no mass (characterised from this)", "load52": "52 g (predicted)", "load101": "101 g (predicted)"}
BLUE, ORANGE, GREEN = "#0072B2", "#E69F00", "#009E73"
LONGEST = 3.0  # s shown after the release
WIDEST = 20.0  # percent, errors beyond which only their number is shown


def prediction_figure(
    recordings: Mapping[str, SiliconeRecording], predictions: Mapping[str, Sequence[Prediction]]
) -> Figure:
    """Height of the tip (mean of three markers) over time for each mass."""
    figure = Figure(figsize=(13.0, 4.2), layout="constrained")
    styles = {"fem": (BLUE, "-", "finite elements"), "cell": (ORANGE, "--", "twin's engine, open loop")}
    for k, (name, recording) in enumerate(recordings.items()):
        axis = figure.add_subplot(1, len(recordings), k + 1)
        since = recording.times - recording.times[recording.release]
        height = -1e3 * (recording.displacement @ recording.down).mean(axis=1)
        axis.plot(since, height, color="black", lw=1.6, label="measured (real)")
        axis.axhline(-1e3 * float(recording.drop.mean()), color="black", lw=0.7, ls=":")
        for prediction in predictions[name]:
            colour, dash, label = styles[prediction.method]
            moved = -1e3 * (prediction.displacement @ recording.down).mean(axis=1)
            axis.plot(since[recording.release :], moved, color=colour, ls=dash, lw=1.1, label=label)
        axis.set(xlim=(-0.2, LONGEST), title=TITLES.get(name, name), xlabel="time since the release [s]")
        axis.grid(alpha=0.25)
        if k == 0:
            axis.set_ylabel("tip height over the held beam [mm]")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside upper center", ncol=3)
    return figure


def twin_figure(loops: Sequence[Withheld]) -> Figure:
    """Error of the withheld marker over time, open and closed loop, one row per recording."""
    names = list(dict.fromkeys(loop.recording.name for loop in loops))
    figure = Figure(figsize=(13.0, 3.0 * len(names)), layout="constrained")
    for loop in loops:
        row = names.index(loop.recording.name)
        axis = figure.add_subplot(len(names), 3, 3 * row + loop.marker + 1)
        recording = loop.recording
        since = (recording.times - recording.times[recording.release])[recording.release :]
        for values, colour, label in (
            (loop.open_loop, ORANGE, "open loop"),
            (loop.predicted, BLUE, "closed loop, marker withheld"),
        ):
            error = 1e3 * np.linalg.norm(values - loop.seen, axis=1)
            axis.semilogy(since, np.maximum(error, 1e-3), color=colour, lw=1.1, label=label)
        moved = 1e3 * np.linalg.norm(loop.seen, axis=1)
        axis.semilogy(since, np.maximum(moved, 1e-3), color="black", lw=0.8, alpha=0.5, label="movement itself")
        axis.set(xlim=(0.0, LONGEST), ylim=(0.02, 80.0))
        axis.set_title(f"{recording.name}: {MARKERS[loop.marker]} withheld", fontsize=10)
        axis.grid(alpha=0.25)
        if loop.marker == 0:
            axis.set_ylabel("distance [mm]")
        if row == len(names) - 1:
            axis.set_xlabel("time since the release [s]")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside upper center", ncol=3)
    return figure


def choices_figure(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Errors of drop and frequency by choice."""
    done = [row for row in rows if not row["refused"]]
    figure = Figure(figsize=(11.0, 0.42 * len(done) + 1.6), layout="constrained")
    place = np.arange(len(done))
    for k, (quantity, goal) in enumerate((("drop", 10.0), ("Hz", 5.0))):
        axis = figure.add_subplot(1, 2, k + 1)
        axis.axvspan(-goal, goal, color="#eeeeee", zorder=0)
        for name, colour in (("gravity", "black"), ("load52", BLUE), ("load101", GREEN)):
            errors = np.array([row[f"{name} {quantity} %"] for row in done], np.float64)
            axis.plot(np.clip(errors, -WIDEST, WIDEST), place, "o", color=colour, label=name)
            for error, at in zip(errors, place, strict=True):
                if abs(error) > WIDEST:
                    side = math.copysign(WIDEST, error)
                    shift = {"gravity": -0.3, "load52": 0.0, "load101": 0.3}[name]
                    axis.annotate(f"{error:+.0f} %", (side, at + shift), (-8.0, 0.0), textcoords="offset points",
                                  ha="right", va="center", fontsize=8, color=colour)  # fmt: skip
        axis.set_yticks(place, [str(row["choice"]) for row in done] if k == 0 else [""] * len(done))
        axis.set_xlabel(f"error of {'static drop' if quantity == 'drop' else 'frequency'} [%]; grey: required")
        axis.invert_yaxis()
        axis.grid(alpha=0.25)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside upper center", ncol=3)
    return figure
