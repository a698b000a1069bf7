"""Single painted pictures for training and judging vision: beams bent by beam theory, without any simulation."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, UInt8

from zsdt.errors import OptionError
from zsdt.lab.beam_painter import BeamPainter, subframes
from zsdt.lab.styles import Pool, draw_style
from zsdt.perception.camera import Camera, ClampSide

# First two bending modes of a cantilever: roots of 1 + cos cosh = 0 and the weights of their shapes.
MODES = ((1.8751041, 0.7340955), (4.6940911, 1.0184673))


@dataclass
class StillOptions:
    """What a painted still shows.

    width, height [px]. length_cm, height_cm, depth_cm: ranges of the beam in multiples of pitch_cm (height is
    vertical, depth into the picture). fill: range of the part of the picture that the beam spans. tilt_deg: largest
    yaw and pitch of the camera, roll is a third of it. focal: range over the picture's width. strain: largest bending
    strain. motion_px: largest blur of a moving beam. distortion: largest |k1|.
    """

    width: int = 960
    height: int = 540
    length_cm: list[float] = field(default_factory=lambda: [35.0, 80.0])
    height_cm: list[float] = field(default_factory=lambda: [10.0, 40.0])
    depth_cm: list[float] = field(default_factory=lambda: [10.0, 40.0])
    pitch_cm: float = 5.0
    fill: list[float] = field(default_factory=lambda: [0.55, 0.88])
    tilt_deg: float = 10.0
    focal: list[float] = field(default_factory=lambda: [0.75, 1.4])
    strain: float = 0.22
    motion_px: float = 3.0
    distortion: float = 0.12

    def __post_init__(self) -> None:
        if self.width < 64 or self.height < 64 or self.pitch_cm <= 0:
            raise OptionError("A still needs at least 64 x 64 px and a positive pitch.")
        for name in ("length_cm", "height_cm", "depth_cm", "fill", "focal"):
            limits = getattr(self, name)
            if len(limits) != 2 or not 0 < limits[0] <= limits[1]:
                raise OptionError(f"{name} must be [smallest, largest], both positive, not {list(limits)}.")
        if self.fill[1] > 1 or not 0 <= self.tilt_deg <= 30 or not 0 <= self.strain < 0.5:
            raise OptionError("fill must stay below 1, tilt_deg within 0 to 30 and strain within 0 to 0.5.")


@dataclass(frozen=True)
class Still:
    """A painted picture (BGR) with its truth.

    grid_mask, beam_mask [height, width]: cover of the painted lines and of the visible face, 0 to 255, without noise.
    node_pixels [columns, rows, 2]: exact pixels of the crossings, column 0 at the clamp, row 0 at the bottom. pitch,
    beam_width [m].
    """

    image: UInt8[np.ndarray, "height width 3"]
    grid_mask: UInt8[np.ndarray, "height width"]
    beam_mask: UInt8[np.ndarray, "height width"]
    node_pixels: Float[np.ndarray, "columns rows 2"]
    camera: Camera
    clamp_side: ClampSide
    pitch: float
    beam_width: float


def painted_still(seed: int, pool: Pool = Pool.train, options: StillOptions | None = None) -> Still:
    """A painted picture of a random beam in a random style of a pool. Same seed, pool and options: same bytes."""
    choice = options or StillOptions()
    rng = np.random.default_rng([seed, 0x571, list(Pool).index(pool)])
    pitch = choice.pitch_cm / 100.0
    columns, rows, deep = (
        int(rng.integers(max(round(low / choice.pitch_cm), 1), max(round(high / choice.pitch_cm), 1) + 1)) + extra
        for (low, high), extra in ((choice.length_cm, 1), (choice.height_cm, 1), (choice.depth_cm, 0))
    )
    beam_width = deep * pitch
    side = ClampSide.left if rng.random() < 0.5 else ClampSide.right
    near, far = bent_faces(rng, columns, rows, pitch, beam_width, side, choice.strain)
    camera = view_of(rng, near, side, choice)
    style = draw_style(rng, pool)
    painter = BeamPainter(
        style, camera, columns=columns, rows=rows, pitch=pitch, beam_width=beam_width, clamp_side=side
    )
    # A beam on the move swings about its clamp: its nodes move with their distance from it.
    travel = rng.uniform(0.0, choice.motion_px) if rng.random() < 0.4 else 0.0
    count = subframes(travel)
    swing = np.linspace(0, 1, columns)[:, None, None] ** 2 * np.array([0.0, 0.0, 1.0])
    metre = travel / (camera.matrix[0, 0] / camera.depths(near.reshape(-1, 3)).mean())
    moments = [(near + swing * metre * k, far + swing * metre * k) for k in (np.arange(count) + 0.5) / count - 0.5]
    painted = painter.paint(moments)
    return Still(
        painted.image, painted.grid_mask, painted.beam_mask, painter.node_pixels(near), camera, side, pitch, beam_width
    )


def bent_faces(
    rng: np.random.Generator,
    columns: int,
    rows: int,
    pitch: float,
    beam_width: float,
    side: ClampSide,
    strain: float,
) -> tuple[Float[np.ndarray, "columns rows 3"], Float[np.ndarray, "columns rows 3"]]:
    """Visible and far face [columns, rows, 3] m of a beam bent by a random sum of two modes, sections kept plane.

    The axis keeps its length, its curvature stays below that of the given bending strain, and the beam also bends a
    little out of the picture.
    """
    long, high = (columns - 1) * pitch, (rows - 1) * pitch
    x = np.linspace(0.0, long, 20 * (columns - 1) + 1)
    weights = np.array([rng.uniform(-0.6, 1.0), rng.normal(0.0, 0.12)])
    bend = weights @ np.array([_curvature(k, w, x / long) for k, w in MODES])
    bend *= min(strain / (0.5 * high), 1.4 / long) * rng.random() / max(np.abs(bend).max(), 1e-9)
    turn = -np.concatenate([[0.0], np.cumsum(0.5 * (bend[1:] + bend[:-1]) * np.diff(x))])  # positive: tip up
    axis_x = np.concatenate([[0.0], np.cumsum(np.cos(0.5 * (turn[1:] + turn[:-1])) * np.diff(x))])
    axis_z = np.concatenate([[0.0], np.cumsum(np.sin(0.5 * (turn[1:] + turn[:-1])) * np.diff(x))])
    turn, axis_x, axis_z = turn[::20], axis_x[::20], axis_z[::20]
    up = (np.arange(rows) - 0.5 * (rows - 1)) * pitch
    sideways = rng.uniform(-0.03, 0.03) * (np.linspace(0, 1, columns) ** 2) * long
    faces = []
    for y in (0.0, beam_width):
        faces.append(
            np.stack(
                [
                    axis_x[:, None] - up * np.sin(turn)[:, None],
                    np.broadcast_to(y + sideways[:, None], (columns, rows)),
                    0.5 * high + axis_z[:, None] + up * np.cos(turn)[:, None],
                ],
                axis=2,
            )
        )
    low_y, high_y = faces
    return (low_y, high_y) if side is ClampSide.left else (high_y, low_y)


def _curvature(root: float, weight: float, part: Float[np.ndarray, " x"]) -> Float[np.ndarray, " x"]:
    """Second derivative of a cantilever's mode at x / L, 1 at the clamp."""
    k = root * part
    return 0.5 * (np.cosh(k) + np.cos(k) - weight * (np.sinh(k) + np.sin(k)))


def view_of(
    rng: np.random.Generator,
    face: Float[np.ndarray, "columns rows 3"],
    side: ClampSide,
    options: StillOptions,
) -> Camera:
    """A camera in front of a face that sees all of it, by rejection of views that cut it off.

    Raises: OptionError where no view of the given ranges does.
    """
    points = face.reshape(-1, 3)
    low, high = points.min(axis=0), points.max(axis=0)
    spans = np.array([high[0] - low[0] + 0.03, high[2] - low[2] + 0.04])
    size = np.array([options.width, options.height], float)
    for attempt in range(200):
        focal = options.width * rng.uniform(options.focal[0], options.focal[1])
        # Later attempts step back, so that long beams in small pictures find a view as well.
        distance = float((focal * spans / size).max() / rng.uniform(options.fill[0], options.fill[1])) * (
            1.0 + 0.01 * attempt
        )
        yaw, pitch = np.radians(rng.uniform(-options.tilt_deg, options.tilt_deg, 2))
        roll = np.radians(rng.uniform(-options.tilt_deg, options.tilt_deg)) / 3.0
        k1 = rng.uniform(-options.distortion, 0.4 * options.distortion)
        offset = rng.uniform(-0.08, 0.08, 2) * spans
        center = (0.5 * (low[0] + high[0]) + offset[0], 0.5 * (low[2] + high[2]) + offset[1])
        camera = tilted_view(
            look_at=center,
            front_y=float(points[:, 1].mean()),
            side=side,
            distance=distance,
            focal=focal,
            tilt=(yaw, pitch, roll),
            size=(options.width, options.height),
            distortion=np.array([k1, -0.3 * k1 * rng.random(), 0.0, 0.0, 0.0]),
        )
        pixels = camera.project(points)
        if np.isfinite(pixels).all() and (pixels > 6).all() and (pixels < size - 7).all():
            return camera
    raise OptionError("No camera of the given fill, focal and tilt sees the whole beam; lower fill or tilt_deg.")


def tilted_view(
    *,
    look_at: tuple[float, float],
    front_y: float,
    side: ClampSide,
    distance: float,
    focal: float,
    tilt: tuple[float, float, float],
    size: tuple[int, int],
    distortion: Float[np.ndarray, "5"],
) -> Camera:
    """A camera that looks at (x, z) = `look_at` of the plane y = `front_y` from `distance` [m], turned about that
    point by yaw, pitch and roll [rad]."""
    yaw, pitch, roll = tilt
    turns = [
        np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]]),
        np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]]),
        np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]]),
    ]
    rotation = turns[2] @ turns[1] @ turns[0] @ side.axes
    target = np.array([look_at[0], front_y, look_at[1]])
    straight = Camera.facing(
        distance=distance,
        look_at=look_at,
        focal=focal,
        beam_width=front_y,
        clamp_side=side,
        size=size,
        distortion=distortion,
    )
    translation = np.array([0.0, 0.0, distance]) - rotation @ target
    return Camera(straight.matrix, distortion, rotation, translation, *size)
