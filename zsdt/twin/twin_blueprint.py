"""The layout of a twin's recording: the picture on the left, the twin in 3D on the right, what it costs below."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun.blueprint as rrb
from jaxtyping import Float

from zsdt.twin.blueprint import DARK, series_view
from zsdt.twin.field_scale import FieldScale, ShownName
from zsdt.twin.twin_view import TwinView


def twin_blueprint(
    scales: Sequence[FieldScale], stage: Float[np.ndarray, "2 3"], view: TwinView, with_truth: bool
) -> rrb.Blueprint:
    """Layout for the fields of `scales`; the eye looks at `stage` (two corners, m) from the camera's side."""
    picture = rrb.Spatial2DView(
        origin="/world/camera",
        contents=["/world/camera/picture", "/world/camera/trust"],
        name=f"camera: {view.source or 'clip'}",
    )
    fields = rrb.Tabs(*[_field_view(scale, stage, view) for scale in scales], active_tab=0, name="twin in 3D")
    right = rrb.Corner2D.RightTop
    motion = series_view("error", "error [%] against the truth") if with_truth else series_view("tip", "tip [mm]")
    costs = rrb.Tabs(
        series_view("latency", "latency [ms]", right),
        series_view("energy", "energies [J]"),
        series_view("entropy", "entropy production as heat [W]"),
        active_tab=0,
    )
    watch = rrb.Tabs(
        series_view("innovation", "innovation [mm]", right),
        series_view("trust", "trust [% of limit]", right),
        series_view("seen", "seen nodes [%]", rrb.Corner2D.RightBottom),
        *([series_view("tip", "tip [mm]")] if with_truth else []),
        active_tab=0,
    )
    pages = rrb.Tabs(
        rrb.TextDocumentView(origin="/about", name="about"),
        rrb.TextLogView(origin="/log", name="faults, trust"),
        rrb.TextDocumentView(origin="/config", name="config"),
        active_tab=0,
    )
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(picture, fields, column_shares=[11, 10]),
            rrb.Horizontal(motion, watch, costs, pages, column_shares=[3, 3, 3, 4]),
            row_shares=[7, 4],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="time"),
        auto_views=False,
    )


def _field_view(scale: FieldScale, stage: Float[np.ndarray, "2 3"], view: TwinView) -> rrb.Vertical:
    """The twin coloured by a field, seen from the side of the camera and a little from above and beyond the tip."""
    middle = stage.mean(axis=0)
    size = np.ptp(stage, axis=0)
    # Along the camera's own sideways and forward axes, so that left in the picture is left here.
    sideways, forward = view.camera.rotation[0], view.camera.rotation[2]
    far = 0.9 * max(float(size[0]), 1.15 * float(size[2])) + 0.5 * float(size[1])
    eye = middle + far * (0.3 * sideways - 1.0 * forward + np.array([0.0, 0.0, 0.4]))
    scene = rrb.Spatial3DView(
        origin="/world",
        contents=[f"/world/{scale.name}/**", "/world/shape/**"],
        name=scale.label,
        background=DARK,
        line_grid=False,
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital, position=eye.tolist(), look_target=middle.tolist(), eye_up=(0.0, 0.0, 1.0)
        ),
    )
    legend = rrb.Spatial2DView(origin=f"/legend/{scale.name}", name="colours", background=DARK, titlebar=False)
    return rrb.Vertical(scene, legend, row_shares=[7, 1], name=_tab(scale))


def _tab(scale: FieldScale) -> str:
    return "innovation" if scale.name == ShownName.innovation else scale.title
