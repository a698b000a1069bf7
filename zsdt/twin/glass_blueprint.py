"""The layout of a glass twin's recording: the picture on the left, the liquids in 3D on the right, curves below."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun.blueprint as rrb
from jaxtyping import Float

from zsdt.twin.blueprint import DARK, series_view
from zsdt.twin.field_scale import FieldScale
from zsdt.twin.glass_view import GlassTwinView


def glass_blueprint(
    scales: Sequence[FieldScale], stage: Float[np.ndarray, "2 3"], view: GlassTwinView, with_truth: bool
) -> rrb.Blueprint:
    """Layout for the fields of `scales`; the eye looks at `stage` (two corners, m) from the camera's side."""
    picture = rrb.Spatial2DView(
        origin="/world/camera",
        contents=["/world/camera/picture", "/world/camera/trust"],
        name=f"camera: {view.source or 'clip'}",
    )
    fields = rrb.Tabs(*[_field_view(scale, stage) for scale in scales], active_tab=0, name="liquids in 3D")
    right, below = rrb.Corner2D.RightTop, rrb.Corner2D.RightBottom
    levels = rrb.Tabs(
        series_view("right", "level at the right wall [mm]", right),
        series_view("left", "level at the left wall [mm]", below),
        series_view("centroid", "centroid along the motion [mm]", right),
        active_tab=0,
    )
    motion = rrb.Tabs(
        series_view("velocity", "vertical velocity, rms [mm/s]", right),
        *([series_view("error", "error against the truth", right)] if with_truth else []),
        active_tab=0,
    )
    costs = rrb.Tabs(
        series_view("innovation", "innovation [mm]", right),
        series_view("trust", "trust [% of limit]", right),
        series_view("seen", "seen columns [%]", below),
        series_view("volume", "change of volume [%]", right),
        series_view("viscosity", "viscosity over the told one", right),
        series_view("energy", "energies [mJ]", right),
        series_view("latency", "latency [ms]", right),
        active_tab=0,
    )
    pages = rrb.Tabs(
        rrb.TextDocumentView(origin="/about", name="about"),
        rrb.TextLogView(origin="/log", name="states, trust"),
        rrb.TextDocumentView(origin="/config", name="config"),
        active_tab=0,
    )
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(picture, fields, column_shares=[10, 11]),
            rrb.Horizontal(levels, motion, costs, pages, column_shares=[3, 3, 3, 4]),
            row_shares=[7, 4],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="time"),
        auto_views=False,
    )


def _field_view(scale: FieldScale, stage: Float[np.ndarray, "2 3"]) -> rrb.Vertical:
    """All sides coloured by a field, seen from the front and a little from above, as the camera does."""
    middle = stage.mean(axis=0)
    size = np.ptp(stage, axis=0)
    far = 0.68 * max(float(size[0]), 1.3 * float(size[2])) + 0.5 * float(size[1])
    eye = middle + far * np.array([0.0, -1.0, 0.32])
    scene = rrb.Spatial3DView(
        origin="/bodies",
        contents=[f"/bodies/{scale.name}/**", "/bodies/shape/**"],
        name=scale.label,
        background=DARK,
        line_grid=False,
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital, position=eye.tolist(), look_target=middle.tolist(), eye_up=(0.0, 0.0, 1.0)
        ),
    )
    legend = rrb.Spatial2DView(origin=f"/legend/{scale.name}", name="colours", background=DARK, titlebar=False)
    return rrb.Vertical(scene, legend, row_shares=[7, 1], name=scale.title)
