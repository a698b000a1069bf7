"""Material of a painted beam from a video of it swinging: grid, tracks, back-projection, `zsdt.solid.characterise`.

The video must begin with the beam at rest under its weight; then it is plucked, by anything, and left alone. The camera
sees displacements only, so sag and swing fix Young's modulus *over the density*: the density that the scene tells is
taken as true (weigh the beam, or hang a known mass on it). No twin is needed, and none is running.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from zsdt.errors import DataError
from zsdt.perception.camera import Camera
from zsdt.perception.grid_graph import GridGraph, GridOptions, extract_grid
from zsdt.perception.optical_flow import GridTracker, TrackerOptions
from zsdt.perception.segmentation import Segmenter
from zsdt.perception.video import FrameSource
from zsdt.scene import BeamShape
from zsdt.solid.beam_observation import BeamObservation, observe_positions
from zsdt.solid.characterise import CharacteriseOptions, MaterialEstimate, characterise
from zsdt.solid.prony import PronyChoice
from zsdt.solid.specimen import Specimen
from zsdt.twin.beam_graph import BeamGraph, build_beam_graph
from zsdt.twin.twin_scene import BeamTwinScene

LEAST_SEEN = 0.7  # share of the frames in which a node must be seen to be used
ROLL_DOUBT = 0.03  # rad: of a picture laid on the few nodes of a short clamped column
FOUND_TO = 5e-4  # m: accuracy of a node that was found in the first frame


def material_from_video(
    source: FrameSource,
    segmenter: Segmenter,
    camera: Camera,
    scene: BeamTwinScene,
    options: CharacteriseOptions | None = None,
    *,
    tracker: TrackerOptions | None = None,
    grid: GridOptions | None = None,
    released: float | None = None,
) -> MaterialEstimate:
    """The material of the beam in a video that begins at rest; `released` [s]: from when it swings freely.

    Raises: DataError where no grid is found in the first frame, the video is too short, or the beam does not swing;
    RunRejected where no material of this kind does what was seen.
    """
    graph, times, positions = track_front(source, segmenter, camera, scene, tracker, grid)
    specimen, seen = observed_beam(graph, times, positions, released)
    return characterise(specimen, seen, options or options_of(scene))


def options_of(scene: BeamTwinScene) -> CharacteriseOptions:
    """Options of the fit that the scene suggests: its Poisson ratio, and its tau, which a video does not say well."""
    card = scene.material
    return CharacteriseOptions(
        poisson=card.poisson,
        state=card.modulus,
        prony=PronyChoice.given_tau,
        tau=card.tau,
        straight_sd=FOUND_TO,
        turn_sd=ROLL_DOUBT,
    )


def track_front(
    source: FrameSource,
    segmenter: Segmenter,
    camera: Camera,
    scene: BeamTwinScene,
    tracker: TrackerOptions | None = None,
    grid: GridOptions | None = None,
) -> tuple[BeamGraph, Float[np.ndarray, " frames"], Float[np.ndarray, "frames points 3"]]:
    """The beam's graph, times [s] and positions [m] of its front nodes (NaN where lost) in equidistant frames.

    Frames that never came are NaN. Raises: DataError as `material_from_video`.
    """
    fps = scene.fps or source.fps
    frames = iter(source)
    first = next(frames, None)
    if first is None:
        raise DataError("The video has no frames; record it again.")
    found: GridGraph = extract_grid(segmenter.probability(first.image), first.image, grid)
    graph = build_beam_graph(found, camera, scene, fps)
    flow = GridTracker(tracker)
    flow.start(first.image, found.pixels.reshape(-1, 2), found.edges)
    plane = graph.body.points[graph.front_nodes.ravel()[0]]
    rows = {0: graph.positions.reshape(-1, 3)}
    for frame in frames:
        tracks = flow.track(frame.image)
        seen = graph.camera.on_plane(tracks.pixels, plane, np.array([0.0, 1.0, 0.0]))
        rows[frame.index - first.index] = np.where(tracks.seen[:, None], seen, np.nan)
    positions = np.full((max(rows) + 1, found.pixels[..., 0].size, 3), np.nan)
    for index, values in rows.items():
        positions[index] = values
    return graph, np.arange(len(positions)) / fps, positions


def observed_beam(
    graph: BeamGraph,
    times: Float[np.ndarray, " frames"],
    positions: Float[np.ndarray, "frames points 3"],
    released: float | None = None,
) -> tuple[Specimen, BeamObservation]:
    """What the front nodes say, and the beam itself.

    Movement across the width is left out: a single camera does not see it.
    Raises: DataError where too few nodes were seen long enough.
    """
    front = graph.front_nodes.ravel()
    places = graph.body.points[front]
    used = (np.isfinite(positions).all(axis=2).mean(axis=0) > LEAST_SEEN) & ~graph.body.clamped[front]
    if used.sum() < 3:
        raise DataError("Fewer than three nodes of the beam were tracked; film it closer or lit better.")
    moved = positions[:, used].copy()
    moved[..., 1] = np.where(np.isfinite(moved[..., 1]), places[used, 1], np.nan)
    observation = observe_positions(times, _bridged(moved), places[used], released, begins_at_rest=True)
    sizes = np.ptp(graph.body.points, axis=0)
    material = graph.body.material
    if material is None:
        raise DataError("The scene tells no density, and movement alone says nothing of stiffness; give a material.")
    specimen = Specimen(BeamShape(*(float(s) for s in sizes)), material.density, graph.body.pitch, graph.body.gravity)
    return specimen, observation


def _bridged(positions: Float[np.ndarray, "frames points 3"]) -> Float[np.ndarray, "frames points 3"]:
    """Positions with gaps of single points bridged by a straight line in time."""
    frames = np.arange(len(positions))
    bridged = positions.copy()
    for point in range(positions.shape[1]):
        seen = np.isfinite(positions[:, point]).all(axis=1)
        for axis in range(3):
            bridged[:, point, axis] = np.interp(frames, frames[seen], positions[seen, point, axis])
    return bridged
