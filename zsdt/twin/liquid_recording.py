"""A liquid in its vessel for the Rerun viewer: particles as spheres, the vessel as glass, prediction beside truth.

Entities of a recording of a liquid:

- `bodies/<field>/<prediction|truth>` (Points3D) for vertical_velocity, speed, internal_energy and displacement_error:
  the prediction on the left, the truth on the right, in metres and with the same colours;
- `bodies/shape/*`: both vessels (Mesh3D, LineStrips3D), names, and on the prediction the true height of the surface at
  the wall, in front and behind;
- `legend/<field>` (Image); `plots/{centroid,surface,error,energy,latency}/*` (Scalars).

Particles are kept for at most `LIQUID_FRAMES` frames, plots for all.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import Float, Int

from zsdt.errors import DataError
from zsdt.evaluation.liquid_metrics import Swing, swing_of
from zsdt.evaluation.outline import reach, shell
from zsdt.fluid.vessel import Vessel
from zsdt.tignn.engine import Rollout
from zsdt.trajectory import Body, Trajectory
from zsdt.twin import liquid_series
from zsdt.twin.blueprint import blueprint, series_view
from zsdt.twin.colours import Palette, ShownField, colour_bar, robust_top
from zsdt.twin.timeline import index_of

LIQUID_FRAMES = 90
MOST = 98.0  # percent of all particles and frames that lie within the colours of a velocity: it fades quickly
DISTANCE = 1.9  # of the camera, in distances of the two vessels or 3/4 of their height
SIDES = ("prediction", "truth")
_GLASS = (190, 215, 235)
_MARK = (60, 170, 255)
Fields = Mapping[str, Float[np.ndarray, "frames nodes _"]]


def send(stream: rr.RecordingStream, trajectory: Trajectory, rollout: Rollout, predicted: Fields, truth: Fields) -> str:
    """Sends layout, bodies and series of a rollout of a liquid; returns what the page `about` says.

    Raises: DataError where the body has no vessel to draw.
    """
    body = trajectory.body
    if body.vessel is None:
        raise DataError("This liquid has no vessel to draw; record only liquids whose file has a vessel.")
    true_swing = swing_of(body, truth["position"])
    swing = swing_of(body, predicted["position"], true_swing.direction)
    shift = _shift(body, true_swing.direction)
    shown = shown_fields(predicted, truth)
    across = np.array([true_swing.direction[1], -true_swing.direction[0], 0.0])
    eye = DISTANCE * max(float(np.linalg.norm(shift)), 0.75 * body.vessel.rim) * (across + np.array([0.0, 0.0, 0.42]))
    stream.send_blueprint(blueprint(shown, _stage(body, shift), eye, _curve_views()))
    kept = np.unique(np.linspace(0, len(truth["position"]) - 1, LIQUID_FRAMES).astype(int))
    index = index_of(kept, trajectory.times)
    places = {"prediction": predicted["position"][kept], "truth": truth["position"][kept] + shift}
    stream.log("bodies", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for choice in shown:
        stream.log(f"legend/{choice.name}", rr.Image(colour_bar(choice.palette, choice.title)), static=True)
        for side in SIDES:
            _send_particles(stream, choice, side, places[side], kept, index, body.pitch)
    for side, offset in (("prediction", np.zeros(3)), ("truth", shift)):
        send_vessel(stream, side, Vessel(body.vessel), offset)
    _send_levels(stream, Vessel(body.vessel), true_swing, kept, index)
    liquid_series.send(stream, trajectory, rollout, predicted, truth, swing, true_swing)
    return liquid_series.about(trajectory, rollout, predicted, truth, swing, true_swing)


def shown_fields(predicted: Fields, truth: Fields) -> list[ShownField]:
    """Vertical velocity, speed and internal energy between the limits of the truth, and the distance from the truth."""
    sides = {"prediction": predicted, "truth": truth}
    up = {side: 100.0 * fields["velocity"][..., 2] for side, fields in sides.items()}
    speed = {side: 100.0 * np.linalg.norm(fields["velocity"], axis=2) for side, fields in sides.items()}
    gap = 1e3 * np.linalg.norm(predicted["position"] - truth["position"], axis=2)
    swing, fast = [float(np.percentile(np.abs(side["truth"]), MOST)) or 1e-6 for side in (up, speed)]
    shown = [
        ShownField("vertical_velocity", "vertical velocity [cm/s]", Palette("RdBu_r", -swing, swing), up),
        ShownField("speed", "speed [cm/s]", Palette("viridis", 0.0, fast), speed),
    ]
    if "internal_energy" in predicted and "internal_energy" in truth:
        heat = {side: 1e3 * fields["internal_energy"][..., 0] for side, fields in sides.items()}
        low, high = float(np.percentile(heat["truth"], 2)), robust_top(heat["truth"])
        shown.append(ShownField("internal_energy", "internal energy [mJ/kg]", Palette("inferno", low, high), heat))
    far = {"prediction": gap, "truth": np.full_like(gap, np.nan)}  # the truth has no error: grey
    title = "distance from the true place [mm]"
    shown.append(ShownField("displacement_error", title, Palette("magma", 0.0, robust_top(gap)), far))
    return shown


def _shift(body: Body, direction: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Where the truth is drawn, seen from the prediction [m]: to the right along the swing, clear of its vessel."""
    assert body.vessel is not None
    vessel = Vessel(body.vessel)
    heights = np.linspace(1e-6, vessel.rim, 60)
    widest = max(float(reach(vessel, heights, sign * direction).max()) for sign in (1.0, -1.0))
    return 2.35 * widest * direction


def _stage(body: Body, shift: Float[np.ndarray, "3"]) -> Float[np.ndarray, "2 3"]:
    """Lower and upper corner [m] of both vessels."""
    assert body.vessel is not None
    low, high = Vessel(body.vessel).bounds()
    return np.stack([np.minimum(low, low + shift), np.maximum(high, high + shift)])


def _curve_views() -> list[rrb.View | rrb.Container]:
    return [
        rrb.Tabs(
            series_view("centroid", "centroid along the swing [mm]", rrb.Corner2D.RightTop),
            series_view("surface", "surface at the wall [mm]", rrb.Corner2D.RightTop),
            active_tab=0,
        ),
        series_view("error", "error / truth [%]", rrb.Corner2D.RightTop),
        rrb.Tabs(
            series_view("energy", "energies [mJ]", rrb.Corner2D.RightTop),
            series_view("latency", "latency [ms]"),
            active_tab=0,
        ),
    ]


def _send_particles(
    stream: rr.RecordingStream,
    choice: ShownField,
    side: str,
    places: Float[np.ndarray, "kept nodes 3"],
    kept: Int[np.ndarray, " kept"],
    index: list[rr.TimeColumn],
    pitch: float,
) -> None:
    entity = f"bodies/{choice.name}/{side}"
    stream.log(entity, rr.Points3D.from_fields(radii=[0.5 * pitch]), static=True)
    colours = choice.palette.colours(choice.values[side][kept])
    points = rr.Points3D.columns(positions=places.reshape(-1, 3).astype(np.float32), colors=colours.reshape(-1, 4))
    stream.send_columns(entity, index, points.partition([places.shape[1]] * len(kept)))


def send_vessel(
    stream: rr.RecordingStream, side: str, vessel: Vessel, shift: Float[np.ndarray, "3"], title: str = ""
) -> None:
    """The wall as thin glass with rings and a rim, and the name of the side (or `title`) above it."""
    fine, coarse = shell(vessel, 40, 48) + shift, shell(vessel, 7, 64) + shift
    rings, angles, _ = fine.shape
    corner = (np.arange(rings - 1)[:, None] * angles + np.arange(angles)).ravel()
    beside = (np.arange(rings - 1)[:, None] * angles + (np.arange(angles) + 1) % angles).ravel()
    triangles = np.concatenate(
        [
            np.stack([corner, beside, beside + angles], axis=1),
            np.stack([corner, beside + angles, corner + angles], axis=1),
        ]
    )
    stream.log(
        f"bodies/shape/{side}/glass",
        rr.Mesh3D(
            vertex_positions=fine.reshape(-1, 3).astype(np.float32),
            triangle_indices=triangles.astype(np.uint32),
            albedo_factor=(*_GLASS, 14),
        ),
        static=True,
    )
    closed = np.concatenate([coarse, coarse[:, :1]], axis=1).astype(np.float32)
    sides = [fine[:, k].astype(np.float32) for k in range(0, angles, angles // 4)]
    for name, strips, width in (("rings", [*closed[1:-1], *sides], 0.4), ("rim", [closed[0], closed[-1]], 1.3)):
        lines = rr.LineStrips3D(strips, colors=[(*_GLASS, 160)], radii=rr.Radius.ui_points(width))
        stream.log(f"bodies/shape/{side}/{name}", lines, static=True)
    place = [*shift[:2], 1.08 * vessel.rim]
    invisible = rr.Radius.ui_points(0.1)
    label = rr.Points3D([place], labels=[title or side], radii=invisible, colors=[(255, 255, 255)], show_labels=True)
    stream.log(f"bodies/shape/{side}/name", label, static=True)


def _send_levels(
    stream: rr.RecordingStream,
    vessel: Vessel,
    truth: Swing,
    kept: Int[np.ndarray, " kept"],
    index: list[rr.TimeColumn],
) -> None:
    """Short lines on the wall of the prediction at the true height of the surface, in front and behind."""
    marks = []
    for sign, heights in zip((1.0, -1.0), np.maximum(truth.levels[kept].T, 1e-4), strict=True):
        middle = np.arctan2(sign * truth.direction[1], sign * truth.direction[0])
        angles = middle + np.radians(np.linspace(-35.0, 35.0, 15))
        rays = np.stack([np.cos(angles), np.sin(angles), np.zeros(15)], axis=1)
        far = 1.01 * np.stack([reach(vessel, heights, ray) for ray in rays], axis=1)
        marks.append(far[..., None] * rays + heights[:, None, None] * np.array([0.0, 0.0, 1.0]))
    strips = np.stack(marks, axis=1).reshape(2 * len(kept), 15, 3).astype(np.float32)
    entity = "bodies/shape/prediction/true_surface"
    stream.log(entity, rr.LineStrips3D.from_fields(colors=[_MARK], radii=rr.Radius.ui_points(1.8)), static=True)
    stream.send_columns(entity, index, rr.LineStrips3D.columns(strips=strips).partition([2] * len(kept)))
