"""From the grid in the picture to the body that the engine computes: extrusion, placement, first positions.

The painted grid gives length and height, the scene the width. The picture is placed so that the observed clamped
column lies on x = 0 (translation and turn in the plane of the picture; the turn is a compromise between the few nodes
of that column and the told roll of the camera, by their accuracies), and the grid is its own ruler: the depth is
corrected until the mean pitch is the told one. So a camera that is a bit off neither bends nor stretches the beam.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from zsdt.errors import DataError
from zsdt.perception.camera import Camera, ClampSide
from zsdt.perception.depth import look_up
from zsdt.perception.grid_graph import ClampChoice, GridGraph
from zsdt.solid.mesh import BrickMesh
from zsdt.trajectory import Body
from zsdt.twin.twin_scene import BeamTwinScene

FOUND_TO = 0.01  # of the pitch: accuracy of a found node
BADLY_FOUND = 3.0  # times less accurate may single nodes be: a clamp hides part of its column
UNTOLD_ROLL = 0.01  # rad: of a camera that somebody put up by eye


@dataclass(frozen=True)
class BeamGraph:
    """The body and where the camera is from it.

    front_nodes [columns, rows]: nodes of the visible face. camera: in the axes of the body (placement folded in).
    depth [m]: of the visible face along the optical axis. positions [columns, rows, 3] m: of the front nodes at frame
    0 as observed, NaN where not found. pitch [m]: of these, measured at the told depth, before the ruler. roll_doubt
    [rad]: standard deviation of the turn that is left.
    """

    body: Body
    front_nodes: Int[np.ndarray, "columns rows"]
    camera: Camera
    depth: float
    positions: Float[np.ndarray, "columns rows 3"]
    pitch: float
    roll_doubt: float


def beam_body(columns: int, rows: int, scene: BeamTwinScene, fps: float) -> Body:
    """Body with `columns` x `rows` tracked nodes on the visible face, extruded through the width of the scene.

    Raises: DataError where there are too few rows or columns, or the width is no multiple of the pitch.
    """
    if columns < 3 or rows < 2:
        raise DataError(
            f"The grid has {columns} columns and {rows} rows; a beam needs at least 3 columns and 2 rows. "
            "Show the whole beam to the camera or paint a finer grid."
        )
    cell, fine = scene.cell_edge, scene.refinement
    layers = 1 if scene.one_layer else round(scene.width / cell)
    if not scene.one_layer and (layers < 1 or abs(layers * cell - scene.width) > 0.02 * cell):
        raise DataError(
            f"A beam {100 * scene.width:g} cm wide cannot be cut into cells of {100 * cell:g} cm; "
            "give a width that is a multiple of the cells, or set one_layer=true."
        )
    mesh = BrickMesh(((columns - 1) * fine, layers, (rows - 1) * fine), cell)
    grid = mesh.grid
    return Body(
        points=grid.points,
        pairs=grid.pairs,
        cells=grid.cells,
        clamped=grid.points[:, 0] < 1e-9,
        mass=scene.material.density * mesh.volume,
        frame_dt=1.0 / fps,
        pitch=cell,
        gravity=np.array([0.0, 0.0, -scene.gravity]),
        material=scene.material,
    )


def thinned(grid: GridGraph, stride: int) -> GridGraph:
    """Every `stride`-th node of a grid, from the clamp and from the bottom; both edges of the face stay in.

    Raises: DataError where the grid cannot be cut like that.
    """
    if stride == 1:
        return grid
    columns, rows = grid.found.shape
    if (columns - 1) % stride or (rows - 1) % stride:
        raise DataError(
            f"A grid of {columns - 1} x {rows - 1} cells cannot be cut into cells {stride} times as long; "
            "choose finer cells."
        )
    few = replace(
        grid,
        pixels=grid.pixels[::stride, ::stride],
        found=grid.found[::stride, ::stride],
        pitch_px=stride * grid.pitch_px,
    )
    return replace(few, linked=np.ones(len(few.edges), bool))


def front_nodes_of(body: Body, side: ClampSide, refinement: int = 1) -> Int[np.ndarray, "columns rows"]:
    """Nodes of the face that the camera sees, column 0 at the clamp and row 0 at the bottom; every `refinement`-th."""
    place = np.rint(body.points / body.pitch).astype(np.int64)
    columns, layers, rows = place.max(axis=0) + 1
    layer = 0 if side.front_layer == "low_y" else layers - 1
    column, row = np.meshgrid(np.arange(0, columns, refinement), np.arange(0, rows, refinement), indexing="ij")
    return column + columns * (layer + layers * row)


def build_beam_graph(
    grid: GridGraph,
    camera: Camera,
    scene: BeamTwinScene,
    fps: float,
    depth_map: Float[np.ndarray, "height width"] | None = None,
) -> BeamGraph:
    """Body, visible nodes, placed camera and first positions from a found grid (`thinned` by the scene's stride).

    Raises: DataError where the grid is too small, its clamped column is not seen, the measured pitch contradicts the
    scene, or the camera stands on the other side of the beam than the clamp says.
    """
    columns, rows = grid.found.shape
    body = beam_body(columns, rows, scene, fps)
    side = _clamp_side(grid, scene)
    front = front_nodes_of(body, side, scene.refinement)
    placed = _posed(camera, side)
    pixels, found = grid.pixels.reshape(-1, 2), grid.found.ravel() & np.isfinite(grid.pixels).all(axis=2).ravel()
    target = body.points[front.ravel()]
    held = body.clamped[front.ravel()] & found
    if held.sum() < 2:
        raise DataError(
            "Fewer than two nodes of the clamped column were found, so the beam cannot be placed; "
            "show the clamped end to the camera."
        )
    if depth_map is None:
        positions = _on_face(placed, pixels, scene.depth, held)
    else:
        known = look_up(depth_map, np.where(found[:, None], pixels, 0.0), np.nan, scene.depth_maps).depth
        found &= np.isfinite(known)
        positions = placed.at_depth(pixels, np.where(found, known, scene.depth))
        held &= found
    pitch = _measured_pitch(positions.reshape(columns, rows, 3), found.reshape(columns, rows))
    tracked = scene.stride * scene.pitch
    _check_pitch(pitch / scene.stride, scene, scene.depth)
    depth = float(placed.depths(positions[held]).mean())
    if depth_map is None:  # the painted grid is a ruler
        depth *= tracked / pitch
        positions = _on_face(placed, pixels, depth, held)
    turn, shift, doubt = _onto_clamp(positions[held], target[held], _told_roll(camera, scene), pitch)
    placed = moved(placed, turn, shift)
    positions = positions @ turn.T + shift
    seen = np.where(found[:, None], positions, np.nan).reshape(columns, rows, 3)
    return BeamGraph(body, front, placed, depth, seen, pitch, doubt)


def moved(camera: Camera, turn: Float[np.ndarray, "3 3"], shift: Float[np.ndarray, "3"]) -> Camera:
    """The camera in the new axes X' = turn @ X + shift [m]."""
    rotation = camera.rotation @ turn.T
    return replace(camera, rotation=rotation, translation=camera.translation - rotation @ shift)


def _clamp_side(grid: GridGraph, scene: BeamTwinScene) -> ClampSide:
    """The side of the clamp; the scene's choice must not contradict the picture's columns."""
    found = grid.clamp_side
    if scene.clamp_side is not ClampChoice.auto and scene.clamp_side.value != found.value:
        raise DataError(
            f"The scene says that the beam is clamped at the {scene.clamp_side.value}, but the grid was read from a "
            f"clamp at the {found.value}; set clamp_side=auto or correct it."
        )
    return found


def _unposed(camera: Camera) -> bool:
    return bool(np.allclose(camera.rotation, np.eye(3)) and np.allclose(camera.translation, 0.0))


def _posed(camera: Camera, side: ClampSide) -> Camera:
    """A camera with a pose: one that was given none looks straight at the face."""
    if _unposed(camera):
        return replace(camera, rotation=side.axes)
    if camera.rotation[2] @ side.axes[2] < 0.5:
        raise DataError(
            f"The beam is clamped at the {side.value} of the picture, so the camera must look along "
            f"{'+y' if side is ClampSide.left else '-y'} of the beam, but its pose says otherwise; correct rotation "
            "in the camera file, leave the pose out, or flip clamp_side."
        )
    return camera


def _on_face(
    camera: Camera, pixels: Float[np.ndarray, "nodes 2"], depth: float, held: Bool[np.ndarray, " nodes"]
) -> Float[np.ndarray, "nodes 3"]:
    """Points [m] of the pixels on the plane of the face, which is `depth` [m] away at the clamped column."""
    point = camera.at_depth(pixels[held].mean(axis=0, keepdims=True), depth)[0]
    return camera.on_plane(pixels, point, np.array([0.0, 1.0, 0.0]))


def _measured_pitch(positions: Float[np.ndarray, "columns rows 3"], found: Bool[np.ndarray, "columns rows"]) -> float:
    """Mean distance [m] of neighbours; a fifth of the extremes on both sides is left out."""
    lengths = []
    for axis in (0, 1):
        both = np.take(found, range(found.shape[axis] - 1), axis) & np.take(found, range(1, found.shape[axis]), axis)
        lengths.append(np.linalg.norm(np.diff(positions, axis=axis), axis=2)[both])
    ordered = np.sort(np.concatenate(lengths))
    if len(ordered) == 0:
        raise DataError("No two neighbouring nodes of the grid were found; use a sharper picture.")
    cut = len(ordered) // 5
    return float(ordered[cut : len(ordered) - cut].mean())


def _check_pitch(pitch: float, scene: BeamTwinScene, depth: float) -> None:
    if abs(pitch / scene.pitch - 1.0) > scene.pitch_tolerance:
        raise DataError(
            f"The grid's pitch measures {100 * pitch:.2f} cm at a depth of {depth:.2f} m, but the scene says "
            f"{100 * scene.pitch:g} cm: the depth is wrong (it would have to be {depth * scene.pitch / pitch:.2f} m), "
            "or the pitch, or the camera's focal length. Correct it in the scene."
        )


def _told_roll(camera: Camera, scene: BeamTwinScene) -> float:
    """Standard deviation of the camera's roll [rad]: a pose that was told is better than none."""
    return scene.roll_doubt if not _unposed(camera) else max(scene.roll_doubt, UNTOLD_ROLL)


def _onto_clamp(
    seen: Float[np.ndarray, "nodes 3"], target: Float[np.ndarray, "nodes 3"], roll_doubt: float, pitch: float
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"], float]:
    """Turn about y and shift [m] that lay the seen clamped column on its place, and the doubt of the turn [rad].

    A column of few nodes found to a hundredth of a pitch says less of the turn than a level camera; one that
    contradicts the told roll by far is believed alone.
    """
    a, b = seen - seen.mean(axis=0), target - target.mean(axis=0)
    angle = np.arctan2((a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]).sum(), (a[:, 0] * b[:, 0] + a[:, 2] * b[:, 2]).sum())
    noise = FOUND_TO * pitch / float(np.sqrt((b[:, 2] ** 2).sum()))
    doubt = noise
    if abs(angle) < 3.0 * np.hypot(roll_doubt, noise * BADLY_FOUND):
        angle *= roll_doubt**2 / (roll_doubt**2 + noise**2)
        doubt = roll_doubt * noise / float(np.hypot(roll_doubt, noise))
    turn = turn_about_y(float(angle))
    return turn, target.mean(axis=0) - turn @ seen.mean(axis=0), doubt


def turn_about_y(angle: float) -> Float[np.ndarray, "3 3"]:
    """Rotation by `angle` [rad] about y (x towards -z)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
