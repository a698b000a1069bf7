"""One run of a glass twin on a clip as one file for the Rerun viewer: picture with overlay, particles in 3D, plots.

Entities:

- `world/camera` (Transform3D, Pinhole) and `world/camera/picture` (EncodedImage, JPEG): the overlay on every frame;
- `bodies/<field>/<side>` (Points3D): the particles of the twin, of the open loop and, in the virtual lab, of the truth,
  beside each other in the axes of their vessels, with the colours of the overlay;
- `bodies/shape/<side>/*`: vessels (Mesh3D, LineStrips3D) and names; `bodies/shape/twin/seen_level`: the observed level;
- `legend/<field>` (Image); `plots/{left,right,centroid,velocity,error,innovation,seen,volume,viscosity,energy,
  latency,trust}/*` (Scalars);
- `log` (TextLog): when the twin was not corrected, and why; `log/trust`, `world/camera/trust`: as of a beam; `about`
  and `config` (TextDocument).

Timelines: `frame` (number in the clip) and `time` (seconds).
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable

import numpy as np
import rerun as rr
from jaxtyping import Float, UInt8

from zsdt.errors import DataError
from zsdt.twin import glass_series
from zsdt.twin.colours import colour_bar
from zsdt.twin.field_scale import LIQUID_LOOKS, FieldScale, LiquidName, scale_of
from zsdt.twin.glass_blueprint import glass_blueprint
from zsdt.twin.glass_overlay import SEEN, GlassOverlayOptions
from zsdt.twin.glass_video import glass_frames, scale_of_glass
from zsdt.twin.glass_view import RIGHT, GlassTwinView
from zsdt.twin.liquid_recording import send_vessel
from zsdt.twin.recording_file import new_recording
from zsdt.twin.timeline import clock_of
from zsdt.twin.trust_recording import send_trust
from zsdt.twin.twin_recording import BODY_FRAMES, PICTURE_FRAMES, jpeg, jpeg_quality, spread

Picture = UInt8[np.ndarray, "height width 3"]
Sides = dict[str, tuple[GlassTwinView, Float[np.ndarray, "3"]]]
PICTURE_BYTES = 80_000  # of a JPEG, on average: clips of glasses are short
APART = 2.35  # half-widths of a vessel between the axes of two sides


def record_glass_twin(
    path: str | os.PathLike[str],
    view: GlassTwinView,
    pictures: Iterable[tuple[int, Picture]],
    truth: GlassTwinView | None = None,
    open_loop: GlassTwinView | None = None,
    options: GlassOverlayOptions | None = None,
    config_text: str = "",
) -> None:
    """Writes one `.rrd` of a run.

    pictures: number in the clip and BGR image, once through the clip. truth: of the lab, at the frames of the run.
    open_loop: a run on the same frames that was never corrected. config_text: YAML.

    Raises: DataError where sides have different frames, or the disk does not take the file.
    """
    options = options or GlassOverlayOptions()
    for side in (truth, open_loop):
        if side is not None and (side.start != view.start or not np.array_equal(side.frames, view.frames)):
            raise DataError(f"{side.name} and {view.name} have different frames; record sides of the same run.")
    scales = scales_of_glass(view, truth, options)
    sides = _placed(view, truth, open_loop)
    with new_recording(path, f"{view.name}/{view.source}", f"{view.name} glass twin", config_text) as stream:
        stream.send_blueprint(glass_blueprint(list(scales.values()), _stage(sides), view, truth is not None))
        _send_pictures(stream, view, pictures, options, scales[options.field])
        _send_bodies(stream, sides, scales)
        _send_seen_level(stream, view, sides["twin"][1])
        _send_states(stream, view)
        glass_series.send(stream, view, truth, open_loop)
        factor = scale_of_picture(view, options)
        size = (factor * view.camera.width, factor * view.camera.height)
        send_trust(stream, view.trust, view.frames[view.start :], view.times[view.start :], size)
        about = glass_series.about(view, truth, open_loop)
        stream.log("about", rr.TextDocument(about, media_type="text/markdown"), static=True)


def scales_of_glass(
    view: GlassTwinView, truth: GlassTwinView | None, options: GlassOverlayOptions
) -> dict[LiquidName, FieldScale]:
    """A scale for each field that the run can show, the overlay's first and as it is there; where there is a truth, it
    sets the limits of the others."""
    scales = {options.field: scale_of_glass(view, options, truth)}
    for name in LiquidName:
        if name != options.field and view.shows(name) and name in LIQUID_LOOKS:
            side = truth if truth is not None and truth.shows(name) else view
            scales[name] = scale_of(name, side.values(name))
    return scales


def _placed(view: GlassTwinView, truth: GlassTwinView | None, open_loop: GlassTwinView | None) -> Sides:
    """Each side with where it is drawn [m]: open loop, twin, truth from left to right, clear of one another."""
    there = {"open": open_loop, "twin": view, "truth": truth}
    widest = max(float(side.vessel.bounds()[1][0]) for side in there.values() if side is not None)
    step = APART * widest * RIGHT
    found = [(name, side) for name, side in there.items() if side is not None]
    return {name: (side, number * step) for number, (name, side) in enumerate(found)}


def _stage(sides: Sides) -> Float[np.ndarray, "2 3"]:
    """Lower and upper corner [m] of all vessels."""
    corners = np.concatenate([np.stack(side.vessel.bounds()) + shift for side, shift in sides.values()])
    return np.stack([corners.min(axis=0), corners.max(axis=0)])


def scale_of_picture(view: GlassTwinView, options: GlassOverlayOptions) -> int:
    """By how much the pictures of a recording are larger than those of the camera."""
    return max(1, math.ceil(options.height / view.camera.height))


def _send_pictures(
    stream: rr.RecordingStream,
    view: GlassTwinView,
    pictures: Iterable[tuple[int, Picture]],
    options: GlassOverlayOptions,
    scale: FieldScale,
) -> None:
    """Camera, and the overlay on every frame as JPEG."""
    camera = view.camera
    factor = scale_of_picture(view, options)
    matrix = camera.matrix.copy()
    matrix[:2] *= factor
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    pose = rr.Transform3D(translation=camera.center, mat3x3=camera.rotation.T)
    lens = rr.Pinhole(
        image_from_camera=matrix,
        resolution=[factor * camera.width, factor * camera.height],
        camera_xyz=rr.ViewCoordinates.RDF,
    )
    stream.log("world/camera", pose, lens, static=True)
    quality, numbers, blobs = None, [], []
    shown = set(view.frames[spread(view.count, PICTURE_FRAMES)].tolist())
    for number, drawn in glass_frames(view, pictures, options, scale):
        if number in shown:
            quality = quality or jpeg_quality(drawn, PICTURE_BYTES)
            numbers.append(number)
            blobs.append(jpeg(drawn, quality))
    if not blobs:
        raise DataError(f"None of the pictures belongs to a frame of the run {view.name}; give the clip it ran on.")
    kept = np.flatnonzero(np.isin(view.frames, numbers))
    columns = rr.EncodedImage.columns(blob=blobs, media_type=["image/jpeg"] * len(blobs))
    stream.send_columns("world/camera/picture", clock_of(view.frames[kept], view.times[kept]), columns)


def _send_bodies(stream: rr.RecordingStream, sides: Sides, scales: dict[LiquidName, FieldScale]) -> None:
    """Particles of all sides in the colours of each field, their vessels and names."""
    stream.log("bodies", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for name, scale in scales.items():
        stream.log(f"legend/{name}", rr.Image(colour_bar(scale.palette, scale.label)), static=True)
        for side, (view, shift) in sides.items():
            if not view.shows(name):
                continue
            entity = f"bodies/{name}/{side}"
            kept = spread(len(view.positions), BODY_FRAMES)
            rows = view.start + kept
            stream.log(entity, rr.Points3D.from_fields(radii=[0.5 * view.body.pitch]), static=True)
            colours = scale.palette.colours(scale.factor * view.values(name)[kept])
            places = (view.positions[kept] + shift).reshape(-1, 3).astype(np.float32)
            points = rr.Points3D.columns(positions=places, colors=colours.reshape(-1, 4))
            index = clock_of(view.frames[rows], view.times[rows])
            stream.send_columns(entity, index, points.partition([view.body.nodes] * len(kept)))
    for side, (view, shift) in sides.items():
        words = f"twin ({view.name})" if side == "twin" else f"truth ({view.source})" if view.source else view.name
        send_vessel(stream, side, view.vessel, shift, view.name if side == "open" else words)


def _send_seen_level(stream: rr.RecordingStream, view: GlassTwinView, shift: Float[np.ndarray, "3"]) -> None:
    """The observed level as a line on the glass of the twin."""
    assert view.seen_level is not None
    entity = "bodies/shape/twin/seen_level"
    blue, green, red = SEEN
    stream.log(
        entity, rr.LineStrips3D.from_fields(colors=[(red, green, blue)], radii=rr.Radius.ui_points(2.0)), static=True
    )
    kept = spread(len(view.positions), BODY_FRAMES)
    order = np.argsort(view.places[:, 0])
    strips, counts = [], []
    for row in kept:
        level = view.seen_level[row, order]
        known = order[np.isfinite(level)]
        if len(known) > 1:
            line = np.column_stack([view.places[known], view.seen_level[row, known]]) + shift
            strips.append(line.astype(np.float32))
        counts.append(int(len(known) > 1))
    rows = view.start + kept
    columns = rr.LineStrips3D.columns(strips=strips).partition(counts)
    stream.send_columns(entity, clock_of(view.frames[rows], view.times[rows]), columns)


def _send_states(stream: rr.RecordingStream, view: GlassTwinView) -> None:
    """A line wherever the twin does something else: waits, starts, goes on alone, is corrected again."""
    calm = "corrected by the camera" if view.closed else "open loop: never corrected"
    states = [phase or (f"predicting: {fault}" if fault else calm) for phase, fault in
              zip(view.phases, view.faults, strict=True)]  # fmt: skip
    changed = [k for k, state in enumerate(states) if k == 0 or state != states[k - 1]]
    levels = [rr.TextLogLevel.WARN if states[k].startswith("predicting") else rr.TextLogLevel.INFO for k in changed]
    columns = rr.TextLog.columns(text=[states[k] for k in changed], level=levels)
    stream.send_columns("log", clock_of(view.frames[changed], view.times[changed]), columns)
