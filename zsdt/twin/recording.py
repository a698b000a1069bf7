"""One rollout as one file for the Rerun viewer: prediction and truth as coloured bodies, and what they cost.

Entities of a recording of a solid (of a liquid: `zsdt.twin.liquid_recording`):

- `bodies/<field>/<prediction|truth>` (Mesh3D) for von_mises, axial_stress and displacement_error: the truth hangs
  below the prediction, both in metres and with the same colours;
- `bodies/shape/*`: edges of both, the outline of the truth around the prediction, the load, names;
- `legend/<field>` (Image): the colour bar with its unit;
- `plots/{tip,error,energy,dissipation,latency}/*` (Scalars); `about` and `config` (TextDocument).

Timelines: `frame` (number) and `time` (seconds). Bodies are kept for at most `BODY_FRAMES` frames, plots for all.
"""

from __future__ import annotations

import os
from collections.abc import Mapping

import numpy as np
import rerun as rr
from jaxtyping import Float, Int

from zsdt.fields import von_mises
from zsdt.tignn.engine import Rollout
from zsdt.trajectory import Trajectory
from zsdt.twin import liquid_recording, plots
from zsdt.twin.blueprint import blueprint
from zsdt.twin.colours import Palette, ShownField, colour_bar, robust_top
from zsdt.twin.drawn_body import send_edges, send_skin
from zsdt.twin.recording_file import new_recording
from zsdt.twin.surface import Surface, surface_of
from zsdt.twin.timeline import index_of

BODY_FRAMES = 120
SIDES = ("prediction", "truth")

_EDGE = {"prediction": (165, 165, 165), "truth": (165, 165, 165), "truth_outline": (60, 170, 255)}


def record_rollout(
    path: str | os.PathLike[str], trajectory: Trajectory, rollout: Rollout, config_text: str = ""
) -> None:
    """Writes one `.rrd` with the rollout beside the truth; `config_text` is the resolved configuration (YAML).

    A rollout that left the numbers is shown up to there.

    Raises: DataError where a solid has no cells, a liquid has no vessel, or the disk does not take the file.
    """
    count = min(rollout.diverged_at or len(rollout.fields["position"]), trajectory.frames)
    predicted = {k: v[:count] for k, v in rollout.fields.items()}
    truth = {k: v[:count] for k, v in trajectory.fields.items()}
    identity, name = f"{rollout.name}/{trajectory.name}", f"{rollout.name} on {trajectory.name}"
    with new_recording(path, identity, name, config_text) as stream:
        send = _send_solid if trajectory.body.liquid is None else liquid_recording.send
        about = send(stream, trajectory, rollout, predicted, truth)
        stream.log("about", rr.TextDocument(about, media_type="text/markdown"), static=True)


def _send_solid(
    stream: rr.RecordingStream,
    trajectory: Trajectory,
    rollout: Rollout,
    predicted: Mapping[str, np.ndarray],
    truth: Mapping[str, np.ndarray],
) -> str:
    """Sends layout, bodies and series of a rollout of a solid; returns what the page `about` says."""
    shown = shown_fields(predicted, truth)
    surface = surface_of(trajectory.body)
    drop = _drop(trajectory, truth["position"])
    # Active, not only the default: the web viewer opens a recording without it in a layout of its own.
    stream.send_blueprint(blueprint(shown, _stage(predicted, truth, drop)))
    _send_bodies(stream, trajectory, surface, shown, predicted["position"], truth["position"], drop)
    plots.send(stream, trajectory, rollout, predicted, truth)
    return plots.about(trajectory, rollout, predicted, truth)


def shown_fields(predicted: Mapping[str, np.ndarray], truth: Mapping[str, np.ndarray]) -> list[ShownField]:
    """Von Mises and axial stress between the limits of the truth, and how far a node is from its true place."""
    scale, unit = (1e-3, "kPa") if np.abs(truth["stress"]).max() >= 2e3 else (1.0, "Pa")
    sides = {"prediction": scale * predicted["stress"], "truth": scale * truth["stress"]}
    mises = {side: von_mises(stress) for side, stress in sides.items()}
    axial = {side: stress[..., 0] for side, stress in sides.items()}
    gap = 1e3 * np.linalg.norm(predicted["position"] - truth["position"], axis=2)
    most, swing = robust_top(mises["truth"]), robust_top(np.abs(axial["truth"]))
    return [
        ShownField("von_mises", f"von Mises stress [{unit}]", Palette("viridis", 0.0, most), mises),
        ShownField("axial_stress", f"axial stress 11 [{unit}]", Palette("RdBu_r", -swing, swing), axial),
        ShownField(
            "displacement_error",
            "distance from the true place [mm]",
            Palette("magma", 0.0, robust_top(gap)),
            {"prediction": gap, "truth": np.full_like(gap, np.nan)},  # the truth has no error: grey
        ),
    ]


def _drop(trajectory: Trajectory, truth: Float[np.ndarray, "frames nodes 3"]) -> Float[np.ndarray, "3"]:
    """Where the truth is drawn, seen from the prediction [m]: below, clear of the room in which the body moves."""
    return np.array([0.0, 0.0, -(float(np.ptp(truth[..., 2])) + 0.4 * float(np.ptp(trajectory.body.points[:, 2])))])


def _stage(
    predicted: Mapping[str, np.ndarray], truth: Mapping[str, np.ndarray], drop: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "2 3"]:
    """Lower and upper corner [m] of all that is drawn."""
    low, high = np.percentile(predicted["position"].reshape(-1, 3), [1, 99], axis=0)
    places = np.concatenate([truth["position"].reshape(-1, 3), truth["position"].reshape(-1, 3) + drop, [low, high]])
    return np.stack([places.min(axis=0), places.max(axis=0)])


def _send_bodies(
    stream: rr.RecordingStream,
    trajectory: Trajectory,
    surface: Surface,
    shown: list[ShownField],
    predicted: Float[np.ndarray, "frames nodes 3"],
    truth: Float[np.ndarray, "frames nodes 3"],
    drop: Float[np.ndarray, "3"],
) -> None:
    kept = np.unique(np.linspace(0, len(truth) - 1, min(len(truth), BODY_FRAMES)).astype(int))
    index = index_of(kept, trajectory.times)
    skin = {
        "prediction": predicted[kept][:, surface.nodes],
        "truth": truth[kept][:, surface.nodes] + drop,
        "truth_outline": truth[kept][:, surface.nodes],
    }
    stream.log("bodies", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for choice in shown:
        stream.log(f"legend/{choice.name}", rr.Image(colour_bar(choice.palette, choice.title)), static=True)
        for side in SIDES:
            entity = f"bodies/{choice.name}/{side}"
            colours = choice.palette.colours(choice.values[side][kept][:, surface.nodes])
            send_skin(stream, entity, index, surface, skin[side], colours)
    for name, places in skin.items():
        send_edges(stream, f"bodies/shape/{name}", index, surface.edges, places, _EDGE[name])
    for side, shift in (("prediction", np.zeros(3)), ("truth", drop)):
        _send_name(stream, side, trajectory.body.points[trajectory.body.clamped] + shift)
    _send_load(stream, trajectory, truth, kept, index)


def _send_name(stream: rr.RecordingStream, side: str, clamp: Float[np.ndarray, "clamped 3"]) -> None:
    """The name of a side above its clamp, and the clamped nodes as points."""
    low, high = clamp.min(axis=0), clamp.max(axis=0)
    place = [low[0], (low[1] + high[1]) / 2, high[2] + 0.25 * (high[2] - low[2])]
    invisible = rr.Radius.ui_points(0.1)
    label = rr.Points3D([place], labels=[side], radii=invisible, colors=[(255, 255, 255)], show_labels=True)
    stream.log(f"bodies/shape/{side}/name", label, static=True)
    points = rr.Points3D(clamp.astype(np.float32), radii=rr.Radius.ui_points(2.5), colors=[(150, 150, 150)])
    stream.log(f"bodies/shape/{side}/clamp", points, static=True)


def _send_load(
    stream: rr.RecordingStream,
    trajectory: Trajectory,
    truth: Float[np.ndarray, "frames nodes 3"],
    kept: Int[np.ndarray, " kept"],
    index: list[rr.TimeColumn],
) -> None:
    """The sum of the load as an arrow to the middle of where it acts; a quarter of the body long at its largest."""
    load = trajectory.load[kept]
    total, weight = load.sum(axis=1), np.linalg.norm(load, axis=2)
    largest = float(np.linalg.norm(total, axis=1).max())
    if largest == 0.0:
        return
    loaded = weight.sum(axis=1) > 0
    share = weight[loaded] / weight[loaded].sum(axis=1, keepdims=True)
    where = np.einsum("tn,tni->ti", share, truth[kept][loaded])
    vectors = total[loaded] * (0.25 * float(np.ptp(trajectory.body.points[:, 0])) / largest)
    stream.log(
        "bodies/shape/load",
        rr.Arrows3D.from_fields(colors=[(255, 210, 60)], radii=rr.Radius.ui_points(2.0), labels=["load"]),
        static=True,
    )
    arrows = rr.Arrows3D.columns(vectors=vectors.astype(np.float32), origins=(where - vectors).astype(np.float32))
    # Frames without a load get an empty row, so that no arrow is left standing.
    stream.send_columns("bodies/shape/load", index, arrows.partition(loaded.astype(int)))
