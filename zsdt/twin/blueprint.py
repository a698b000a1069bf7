"""The layout in which a recording opens: the fields as tabs on the left, what it costs on the right."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import rerun.blueprint as rrb
from jaxtyping import Float

if TYPE_CHECKING:
    from zsdt.twin.recording import ShownField

_DARK = (13, 16, 17)


def blueprint(shown: Sequence[ShownField], stage: Float[np.ndarray, "2 3"]) -> rrb.Blueprint:
    """Layout for the fields `shown`, with the camera in front of `stage` (lower and upper corner, m)."""
    fields = rrb.Tabs(*[_field_view(choice, stage) for choice in shown], active_tab=0, name="field")
    curves = rrb.Vertical(
        _series("tip", "tip displacement [mm]", rrb.Corner2D.LeftBottom),
        _series("error", "error / truth [%]"),
        rrb.Tabs(
            _series("energy", "energies [J]"),
            _series("dissipation", "dissipation, entropy production [W]"),
            _series("latency", "latency [ms]"),
            active_tab=0,
        ),
        rrb.Tabs(
            rrb.TextDocumentView(origin="/about", name="about"),
            rrb.TextDocumentView(origin="/config", name="config"),
            active_tab=0,
        ),
        row_shares=[3, 3, 3, 4],
    )
    return rrb.Blueprint(
        rrb.Horizontal(fields, curves, column_shares=[5, 3]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="time"),
        auto_views=False,
    )


def _field_view(choice: ShownField, stage: Float[np.ndarray, "2 3"]) -> rrb.Vertical:
    middle, size = stage.mean(axis=0), np.ptp(stage, axis=0)
    reach = max(float(size[0]), 1.1 * float(size[2]))
    eye = middle + reach * np.array([0.3, -1.0, 0.6])
    view = rrb.Spatial3DView(
        origin="/bodies",
        contents=[f"/bodies/{choice.name}/**", "/bodies/shape/**"],
        name=choice.title,
        background=_DARK,
        line_grid=False,
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital, position=eye.tolist(), look_target=middle.tolist(), eye_up=(0.0, 0.0, 1.0)
        ),
    )
    legend = rrb.Spatial2DView(origin=f"/legend/{choice.name}", name="colours", background=_DARK, titlebar=False)
    return rrb.Vertical(view, legend, row_shares=[8, 1], name=choice.title)


def _series(group: str, name: str, corner: rrb.Corner2D = rrb.Corner2D.LeftTop) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(origin=f"/plots/{group}", name=name, plot_legend=rrb.PlotLegend(corner, visible=True))
