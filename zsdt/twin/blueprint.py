"""The layout in which a recording opens: the fields as tabs on the left, what it costs on the right."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import rerun.blueprint as rrb
from jaxtyping import Float

if TYPE_CHECKING:
    from zsdt.twin.colours import ShownField

DARK = (13, 16, 17)


def blueprint(
    shown: Sequence[ShownField],
    stage: Float[np.ndarray, "2 3"],
    eye: Float[np.ndarray, "3"] | None = None,
    curves: Sequence[rrb.View | rrb.Container] | None = None,
) -> rrb.Blueprint:
    """Layout for the fields `shown`, with the camera in front of `stage` (lower and upper corner, m).

    eye: where the camera is, seen from the middle of the stage [m]. curves: views of the time series,
    three above each other; both as for a beam if not given.
    """
    size = np.ptp(stage, axis=0)
    place = max(float(size[0]), 1.1 * float(size[2])) * np.array([0.3, -1.0, 0.6]) if eye is None else eye
    middle = stage.mean(axis=0)
    bodies = [field_view(one.name, one.title, "/bodies", middle + place, middle, one.title, 8) for one in shown]
    fields = rrb.Tabs(*bodies, active_tab=0, name="field")
    pages = rrb.Tabs(
        rrb.TextDocumentView(origin="/about", name="about"),
        rrb.TextDocumentView(origin="/config", name="config"),
        active_tab=0,
    )
    views = _solid_curves() if curves is None else list(curves)
    columns = rrb.Vertical(*views, pages, row_shares=[*[3] * len(views), 4])
    return on_time(rrb.Horizontal(fields, columns, column_shares=[5, 3]))


def on_time(views: rrb.View | rrb.Container) -> rrb.Blueprint:
    """The views and nothing else: panels folded, on the time of the clip."""
    return rrb.Blueprint(
        views,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="time"),
        auto_views=False,
    )


def twin_page(
    source: str, fields: rrb.Container, curves: Sequence[rrb.View | rrb.Container], log: str, shares: Sequence[int]
) -> rrb.Blueprint:
    """Page of a twin: picture of the camera and the body in 3D, with curves and words below.

    source: name of the clip. log: what the log tells. shares: widths of picture and body.
    """
    picture = rrb.Spatial2DView(
        origin="/world/camera",
        contents=["/world/camera/picture", "/world/camera/trust"],
        name=f"camera: {source or 'clip'}",
    )
    pages = rrb.Tabs(
        rrb.TextDocumentView(origin="/about", name="about"),
        rrb.TextLogView(origin="/log", name=log),
        rrb.TextDocumentView(origin="/config", name="config"),
        active_tab=0,
    )
    return on_time(
        rrb.Vertical(
            rrb.Horizontal(picture, fields, column_shares=list(shares)),
            rrb.Horizontal(*curves, pages, column_shares=[*[3] * len(curves), 4]),
            row_shares=[7, 4],
        )
    )


def field_view(
    field: str,
    label: str,
    bodies: str,
    eye: Float[np.ndarray, "3"],
    middle: Float[np.ndarray, "3"],
    tab: str,
    times: int = 7,
) -> rrb.Vertical:
    """The bodies below the path `bodies` coloured by a field, seen from `eye` towards `middle` [m], over a legend.

    field, label: its name in paths and in words. tab: words of the tab. times: how often as high as the legend.
    """
    scene = rrb.Spatial3DView(
        origin=bodies,
        contents=[f"{bodies}/{field}/**", f"{bodies}/shape/**"],
        name=label,
        background=DARK,
        line_grid=False,
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital, position=eye.tolist(), look_target=middle.tolist(), eye_up=(0.0, 0.0, 1.0)
        ),
    )
    legend = rrb.Spatial2DView(origin=f"/legend/{field}", name="colours", background=DARK, titlebar=False)
    return rrb.Vertical(scene, legend, row_shares=[times, 1], name=tab)


def _solid_curves() -> list[rrb.View | rrb.Container]:
    return [
        series_view("tip", "tip displacement [mm]", rrb.Corner2D.LeftBottom),
        series_view("error", "error / truth [%]"),
        rrb.Tabs(
            series_view("energy", "energies [J]"),
            series_view("dissipation", "dissipation, entropy production [W]"),
            series_view("latency", "latency [ms]"),
            active_tab=0,
        ),
    ]


def series_view(group: str, name: str, corner: rrb.Corner2D = rrb.Corner2D.LeftTop) -> rrb.TimeSeriesView:
    """A plot of all series of a group."""
    return rrb.TimeSeriesView(origin=f"/plots/{group}", name=name, plot_legend=rrb.PlotLegend(corner, visible=True))
