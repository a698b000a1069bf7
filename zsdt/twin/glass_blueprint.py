"""The layout of a glass twin's recording: the picture on the left, the liquids in 3D on the right, curves below."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun.blueprint as rrb
from jaxtyping import Float

from zsdt.twin.blueprint import field_view, series_view, twin_page
from zsdt.twin.field_scale import FieldScale
from zsdt.twin.glass_view import GlassTwinView


def glass_blueprint(
    scales: Sequence[FieldScale], stage: Float[np.ndarray, "2 3"], view: GlassTwinView, with_truth: bool
) -> rrb.Blueprint:
    """Layout for the fields of `scales`; the eye looks at `stage` (two corners, m) from the camera's side."""
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
    return twin_page(view.source, fields, [levels, motion, costs], "states, trust", (10, 11))


def _field_view(scale: FieldScale, stage: Float[np.ndarray, "2 3"]) -> rrb.Vertical:
    """All sides coloured by a field, seen from the front and a little from above, as the camera does."""
    middle = stage.mean(axis=0)
    size = np.ptp(stage, axis=0)
    far = 0.68 * max(float(size[0]), 1.3 * float(size[2])) + 0.5 * float(size[1])
    eye = middle + far * np.array([0.0, -1.0, 0.32])
    return field_view(scale.name, scale.label, "/bodies", eye, middle, scale.title)
