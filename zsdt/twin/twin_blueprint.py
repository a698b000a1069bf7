"""The layout of a twin's recording: the picture on the left, the twin in 3D on the right, what it costs below."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun.blueprint as rrb
from jaxtyping import Float

from zsdt.twin.blueprint import field_view, series_view, twin_page
from zsdt.twin.field_scale import FieldScale, ShownName
from zsdt.twin.twin_view import TwinView


def twin_blueprint(
    scales: Sequence[FieldScale], stage: Float[np.ndarray, "2 3"], view: TwinView, with_truth: bool
) -> rrb.Blueprint:
    """Layout for the fields of `scales`; the eye looks at `stage` (two corners, m) from the camera's side."""
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
    return twin_page(view.source, fields, [motion, watch, costs], "faults, trust", (11, 10))


def _field_view(scale: FieldScale, stage: Float[np.ndarray, "2 3"], view: TwinView) -> rrb.Vertical:
    """The twin coloured by a field, seen from the side of the camera and a little from above and beyond the tip."""
    middle = stage.mean(axis=0)
    size = np.ptp(stage, axis=0)
    # Along the camera's own sideways and forward axes, so that left in the picture is left here.
    sideways, forward = view.camera.rotation[0], view.camera.rotation[2]
    far = 0.9 * max(float(size[0]), 1.15 * float(size[2])) + 0.5 * float(size[1])
    eye = middle + far * (0.3 * sideways - 1.0 * forward + np.array([0.0, 0.0, 0.4]))
    return field_view(scale.name, scale.label, "/world", eye, middle, _tab(scale))


def _tab(scale: FieldScale) -> str:
    return "innovation" if scale.name == ShownName.innovation else scale.title
