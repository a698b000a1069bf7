"""One run of a twin on a clip as one file for the Rerun viewer: the picture with the overlay, the twin in 3D, plots.

Entities:

- `world/camera` (Transform3D, Pinhole) and `world/camera/picture` (EncodedImage, JPEG): the overlay on every frame;
- `world/<field>/<twin|truth>` (Mesh3D): the twin coloured by each field that the run has decoded, with the colours of
  the overlay; in the virtual lab the truth below it;
- `world/innovation/nodes` (Points3D): how far each visible node was from its predicted place; lost nodes grey;
- `world/shape/*`: edges of twin and truth, the truth's outline around the twin, the open loop if given, lost nodes;
- `legend/<field>` (Image); `plots/{tip,error,innovation,seen,latency,energy,entropy,trust}/*` (Scalars);
- `log` (TextLog): when the twin was not corrected, and why; `log/trust`: when it is not to be believed, and why, with a
  frame of that colour around the picture (`world/camera/trust`); `about` and `config` (TextDocument).

Timelines: `frame` (number in the clip) and `time` (seconds). Bodies are kept for at most `BODY_FRAMES` frames,
pictures for `PICTURE_FRAMES`.
"""

from __future__ import annotations

import os
from collections.abc import Iterable

import cv2
import numpy as np
import rerun as rr
from jaxtyping import Float, Int, UInt8

from zsdt.errors import DataError
from zsdt.twin import twin_series
from zsdt.twin.colours import colour_bar
from zsdt.twin.drawn_body import send_edges, send_skin
from zsdt.twin.field_scale import FieldScale, ShownName, scale_of
from zsdt.twin.overlay import OverlayOptions
from zsdt.twin.overlay_video import overlay_frames, scale_of_run
from zsdt.twin.recording_file import new_recording
from zsdt.twin.surface import surface_of
from zsdt.twin.timeline import clock_of
from zsdt.twin.trust_recording import send_trust
from zsdt.twin.twin_blueprint import twin_blueprint
from zsdt.twin.twin_view import TwinView

Picture = UInt8[np.ndarray, "height width 3"]

BODY_FRAMES = 100
PICTURE_FRAMES = 240
PICTURE_BYTES = 30_000  # of a JPEG, on average
QUALITIES = (85, 75, 65, 55, 45, 35)
_TWIN, _TRUTH, _OPEN = (215, 215, 215), (60, 170, 255), (255, 140, 40)
_LOST = (240, 70, 70)


def record_twin(
    path: str | os.PathLike[str],
    view: TwinView,
    pictures: Iterable[tuple[int, Picture]],
    truth: TwinView | None = None,
    open_loop: TwinView | None = None,
    options: OverlayOptions | None = None,
    config_text: str = "",
) -> None:
    """Writes one `.rrd` of a run.

    pictures: number in the clip and BGR image, once through the clip. truth: of the lab, at the frames of the run.
    open_loop: a run on the same frames that was never corrected, drawn as an outline. config_text: YAML.

    Raises: DataError where sides have different frames, the body has no cells, or the disk does not take the file.
    """
    options = options or OverlayOptions()
    for side in (truth, open_loop):
        if side is not None and not np.array_equal(side.frames, view.frames):
            raise DataError(f"{side.name} and {view.name} have different frames; record sides of the same run.")
    scales = scales_of(view, truth, options)
    with new_recording(path, f"{view.name}/{view.source}", f"{view.name} twin", config_text) as stream:
        drop = _drop(view, truth)
        stream.send_blueprint(twin_blueprint(list(scales.values()), _stage(view, truth, drop), view, truth is not None))
        _send_pictures(stream, view, pictures, options, scales[options.field])
        _send_bodies(stream, view, truth, open_loop, scales, drop)
        _send_faults(stream, view)
        twin_series.send(stream, view, truth, open_loop)
        send_trust(stream, view.trust, view.frames, view.times, (view.camera.width, view.camera.height))
        about = twin_series.about(view, truth, open_loop)
        stream.log("about", rr.TextDocument(about, media_type="text/markdown"), static=True)


def scales_of(view: TwinView, truth: TwinView | None, options: OverlayOptions) -> dict[ShownName, FieldScale]:
    """A scale for each field that the run can show, the overlay's first and as it is there.

    Colours of the twin and of the truth are the same; where there is a truth, it sets the limits of all but the first,
    which fits both.
    """
    names = [options.field, *(name for name in ShownName if name != options.field)]
    scales = {}
    for name in names:
        if name == options.field:
            scales[name] = scale_of_run(view, options, truth)
        elif name == ShownName.innovation:
            assert view.innovation is not None
            scales[name] = scale_of(name, view.innovation)
        elif view.shows(name):
            side = truth if truth is not None and truth.shows(name) else view
            scales[name] = scale_of(name, side.values(name))
    return scales


def _drop(view: TwinView, truth: TwinView | None) -> Float[np.ndarray, "3"]:
    """Where the truth is drawn, seen from the twin [m]: below, clear of the room in which it moves."""
    if truth is None:
        return np.zeros(3)
    depth = float(np.ptp(view.body.points[:, 2]))
    return np.array([0.0, 0.0, -(float(np.ptp(truth.positions[..., 2])) + 0.4 * depth)])


def _stage(view: TwinView, truth: TwinView | None, drop: Float[np.ndarray, "3"]) -> Float[np.ndarray, "2 3"]:
    """Lower and upper corner [m] of all that is drawn; a run that left for infinity does not stretch it."""
    places = view.positions.reshape(-1, 3)
    low, high = np.percentile(places[np.isfinite(places).all(axis=1)], [1, 99], axis=0)
    assert view.rest is not None
    parts = [view.rest, np.stack([low, high])]
    if truth is not None:
        parts += [truth.positions.reshape(-1, 3) + drop]
    everything = np.concatenate(parts)
    return np.stack([everything.min(axis=0), everything.max(axis=0)])


def _send_pictures(
    stream: rr.RecordingStream,
    view: TwinView,
    pictures: Iterable[tuple[int, Picture]],
    options: OverlayOptions,
    scale: FieldScale,
) -> None:
    """Camera, and the overlay on every frame as JPEG of a quality with which a clip stays small."""
    camera = view.camera
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    pose = rr.Transform3D(translation=camera.center, mat3x3=camera.rotation.T)
    far = float(np.median(camera.depths(view.body.points)))
    lens = rr.Pinhole(
        image_from_camera=camera.matrix,
        resolution=[camera.width, camera.height],
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=0.2 * far,
    )
    stream.log("world/camera", pose, lens, static=True)
    quality, numbers, blobs = None, [], []
    shown = set(view.frames[spread(view.count, PICTURE_FRAMES)].tolist())
    for number, drawn in overlay_frames(view, pictures, options, scale):
        if number in shown:
            quality = quality or jpeg_quality(drawn)
            numbers.append(number)
            blobs.append(jpeg(drawn, quality))
    if not blobs:
        raise DataError(f"None of the pictures belongs to a frame of the run {view.name}; give the clip it ran on.")
    kept = np.flatnonzero(np.isin(view.frames, numbers))
    columns = rr.EncodedImage.columns(blob=blobs, media_type=["image/jpeg"] * len(blobs))
    stream.send_columns("world/camera/picture", clock_of(view.frames[kept], view.times[kept]), columns)


def spread(count: int, most: int) -> Int[np.ndarray, " kept"]:
    """Up to `most` of `count` rows, evenly."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(int))


def jpeg_quality(image: Picture, most: int = PICTURE_BYTES) -> int:
    """The best JPEG quality with which `image` stays below `most` bytes, the last one where none does."""
    return next((q for q in QUALITIES if len(jpeg(image, q)) <= most), QUALITIES[-1])


def jpeg(image: Picture, quality: int) -> bytes:
    done, content = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done
    return content.tobytes()


def _send_bodies(
    stream: rr.RecordingStream,
    view: TwinView,
    truth: TwinView | None,
    open_loop: TwinView | None,
    scales: dict[ShownName, FieldScale],
    drop: Float[np.ndarray, "3"],
) -> None:
    kept = spread(view.count, BODY_FRAMES)
    index = clock_of(view.frames[kept], view.times[kept])
    sides = {"twin": (view, np.zeros(3)), "truth": (truth, drop)}
    for name, scale in scales.items():
        stream.log(f"legend/{name}", rr.Image(colour_bar(scale.palette, scale.label)), static=True)
        for side, (run, shift) in sides.items():
            if run is None or name == ShownName.innovation or not run.shows(name):
                continue
            surface = surface_of(run.body)
            colours = scale.palette.colours(scale.factor * run.values(name)[kept][:, surface.nodes])
            send_skin(
                stream, f"world/{name}/{side}", index, surface, run.positions[kept][:, surface.nodes] + shift, colours
            )
    outlines = {
        "twin": (view, 0 * drop, _TWIN),
        "truth": (truth, drop, _TRUTH),
        "truth_outline": (truth, 0 * drop, _TRUTH),
        "open_loop": (open_loop, 0 * drop, _OPEN),
    }
    for outline, (run, shift, colour) in outlines.items():
        if run is not None:
            surface = surface_of(run.body)
            places = run.positions[kept][:, surface.nodes] + shift
            send_edges(stream, f"world/shape/{outline}", index, surface.edges, places, colour)
    _send_names(stream, view, truth, drop)
    _send_nodes(stream, view, scales[ShownName.innovation], kept, index)


def _send_names(stream: rr.RecordingStream, view: TwinView, truth: TwinView | None, drop: np.ndarray) -> None:
    """What is what, above the clamps."""
    assert view.rest is not None
    clamp = view.rest[view.body.clamped]
    place = np.array([clamp[:, 0].min(), clamp[:, 1].mean(), clamp[:, 2].max() + 0.25 * np.ptp(clamp[:, 2])])
    for name, shift in (("twin", 0 * drop), *((("truth", drop),) if truth is not None else ())):
        words = f"{name} ({view.name})" if name == "twin" else f"{name} ({view.source})" if view.source else name
        label = rr.Points3D(
            [place + shift], labels=[words], colors=[_TWIN], radii=rr.Radius.ui_points(0.1), show_labels=True
        )
        stream.log(f"world/shape/{name}/name", label, static=True)


def _send_nodes(
    stream: rr.RecordingStream,
    view: TwinView,
    scale: FieldScale,
    kept: Int[np.ndarray, " kept"],
    index: list[rr.TimeColumn],
) -> None:
    """Innovation of every visible node as coloured points, and the lost ones in red."""
    assert view.innovation is not None and view.seen is not None
    places = view.on_front(view.positions)[kept].reshape(len(kept), -1, 3).astype(np.float32)
    colours = scale.palette.colours(scale.factor * view.innovation[kept].reshape(len(kept), -1))
    count = places.shape[1]
    radius = 0.16 * view.body.pitch
    stream.log("world/innovation/nodes", rr.Points3D.from_fields(radii=[radius]), static=True)
    points = rr.Points3D.columns(positions=places.reshape(-1, 3), colors=colours.reshape(-1, 4))
    stream.send_columns("world/innovation/nodes", index, points.partition([count] * len(kept)))
    lost = ~view.seen[kept].reshape(len(kept), -1)
    marks = rr.Points3D.from_fields(colors=[_LOST], radii=rr.Radius.ui_points(4.0))
    stream.log("world/shape/lost", marks, static=True)
    before = places - 0.2 * np.float32(view.body.pitch * view.camera.rotation[2])  # in front of the skin
    columns = rr.Points3D.columns(positions=before[lost].reshape(-1, 3))
    stream.send_columns("world/shape/lost", index, columns.partition(lost.sum(axis=1)))


def _send_faults(stream: rr.RecordingStream, view: TwinView) -> None:
    """A line wherever the twin goes on alone, and where it is corrected again."""
    changed = [k for k, fault in enumerate(view.faults) if k == 0 or fault != view.faults[k - 1]]
    calm = "corrected by the camera" if view.closed else "open loop: never corrected"
    words = [f"predicting: {view.faults[k]}" if view.faults[k] else calm for k in changed]
    levels = [rr.TextLogLevel.WARN if view.faults[k] else rr.TextLogLevel.INFO for k in changed]
    columns = rr.TextLog.columns(text=words, level=levels)
    stream.send_columns("log", clock_of(view.frames[changed], view.times[changed]), columns)
