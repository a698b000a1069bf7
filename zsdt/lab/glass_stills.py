"""Single painted pictures of glasses for training and judging segmentation, without any simulation."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from zsdt.errors import OptionError
from zsdt.fluid.families import draw_shape
from zsdt.lab.beam_painter import subframes
from zsdt.lab.glass_lab import between
from zsdt.lab.glass_painter import GlassPainter
from zsdt.lab.glass_shooting import GlassFrame, developed, looking_at, outline_points
from zsdt.lab.glass_styles import draw_glass_style
from zsdt.lab.glass_surface import SurfaceFunction, polar_heights
from zsdt.lab.glass_view import Glass, GlassPicture, GlassView, outer_profile
from zsdt.lab.styles import Pool
from zsdt.perception.camera import Camera
from zsdt.scene import VesselFamily, VesselShape

GAP = 0.003  # m that a surface stays away from the floor and the rim


@dataclass
class GlassStillOptions:
    """What painted stills show; ranges are [lowest, highest].

    families: of the vessels. radius (half-width), fill, freeboard, wall, floor [m]. none, two, hidden, moving, marked:
    shares of pictures without a glass, with two, with something in front of one, of a moving one, with marks printed
    on one; empty: of glasses. steep: largest slope of a surface. glass_share: height of the glass over that of the
    picture. distance [m], tilt_deg, roll_deg: of the camera. motion_px: largest blur.
    """

    families: list[VesselFamily] = field(default_factory=lambda: list(VesselFamily))
    radius: list[float] = field(default_factory=lambda: [0.02, 0.05])
    fill: list[float] = field(default_factory=lambda: [0.012, 0.09])
    freeboard: list[float] = field(default_factory=lambda: [0.01, 0.08])
    wall: list[float] = field(default_factory=lambda: [0.0012, 0.004])
    floor: list[float] = field(default_factory=lambda: [0.003, 0.012])
    none: float = 0.04
    two: float = 0.15
    empty: float = 0.12
    hidden: float = 0.08
    moving: float = 0.15
    marked: float = 0.15
    steep: float = 1.0
    glass_share: list[float] = field(default_factory=lambda: [0.3, 0.85])
    distance: list[float] = field(default_factory=lambda: [0.3, 1.0])
    tilt_deg: list[float] = field(default_factory=lambda: [0.0, 25.0])
    roll_deg: float = 3.0
    motion_px: float = 8.0

    def __post_init__(self) -> None:
        if not self.families:
            raise OptionError("Stills of glasses need a family of vessels.")
        if not all(0.0 <= s <= 1.0 for s in (self.none, self.two, self.empty, self.hidden, self.moving, self.marked)):
            raise OptionError("none, two, empty, hidden, moving and marked are shares between 0 and 1.")


@dataclass(frozen=True)
class GlassStillPlan:
    """A still to take with any camera: views at moments of its exposure, and random numbers for what comes after."""

    views: tuple[GlassView, ...]
    rng: np.random.Generator


def plan_still(
    seed: int, pool: Pool = Pool.train, size: tuple[int, int] = (384, 384), options: GlassStillOptions | None = None
) -> GlassStillPlan:
    """Random glasses in a random style of a pool, in a picture of `size` (width, height) px.

    Same seed, pool, size and options: the same.
    """
    choice = options or GlassStillOptions()
    rng = np.random.default_rng([seed, 0x61A55, list(Pool).index(pool)])
    count = int(rng.choice([0, 1, 2], p=[choice.none, 1.0 - choice.none - choice.two, choice.two]))
    glasses = _glasses(rng, choice, count)
    camera = _camera(rng, choice, glasses, size)
    style = draw_glass_style(rng, pool)
    travel = rng.uniform(0.0, choice.motion_px) if rng.random() < choice.moving else 0.0
    metre = travel / camera.matrix[0, 0] * float(camera.depths(np.zeros((1, 3)))[0])
    moments = subframes(travel)
    views = tuple(
        GlassView(tuple(_moved(g, metre * t) for g in glasses), style, camera, moments=moments)
        for t in (np.arange(moments) + 0.5) / moments - 0.5
    )
    return GlassStillPlan(views, rng)


def taken_still(plan: GlassStillPlan, picture: GlassPicture, options: GlassStillOptions | None = None) -> GlassFrame:
    """The still as a camera takes it, with its noise, perhaps something in front of a glass, perhaps compressed."""
    choice, rng, view = options or GlassStillOptions(), plan.rng, plan.views[0]
    frame = developed([picture(v) for v in plan.views], view.style, 1.0, 0)
    if view.glasses and rng.random() < choice.marked:
        frame = frame._replace(image=_with_marks(rng, frame.image, view.glasses[0], view.camera))
    if view.glasses and rng.random() < choice.hidden:
        frame = _with_something_in_front(rng, frame, view.camera.project(outline_points(view.glasses[0])))
    if rng.random() < 0.3:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(55, 95))]
        packed = cv2.imencode(".jpg", frame.image, quality)[1]
        frame = frame._replace(image=np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR), np.uint8))
    return frame


def painted_glass(
    seed: int, pool: Pool = Pool.train, size: tuple[int, int] = (384, 384), options: GlassStillOptions | None = None
) -> GlassFrame:
    """A painted picture (BGR) of random glasses in a random style of a pool, with its masks.

    size: (width, height) px. Same seed, pool, size and options: same bytes.
    """
    return taken_still(plan_still(seed, pool, size, options), GlassPainter(), options)


def _moved(glass: Glass, along: float) -> Glass:
    return replace(glass, origin=np.asarray(glass.origin) + np.array([along, 0.0, 0.0])) if along else glass


def random_surface(
    rng: np.random.Generator, vessel: VesselShape, level: float, steep: float
) -> Float[np.ndarray, "rings angles"]:
    """A level surface, a tilted one, or one with waves, that stays between floor and rim; steep: largest slope."""
    reach = max(vessel.radii) * max(1.0, vessel.aspect)
    kind = rng.random()
    slope = 0.0 if kind < 0.25 else steep * rng.uniform(0.0, 1.0) ** 2
    heading = rng.choice([0.0, np.pi]) + rng.normal(0.0, 0.5)
    waves = rng.normal(0.0, 0.12, 3) if kind > 0.6 else np.zeros(3)

    def shape(places: np.ndarray) -> np.ndarray:
        x, y = places[:, 0] / reach, places[:, 1] / reach
        u, v = x * np.cos(heading) + y * np.sin(heading), y * np.cos(heading) - x * np.sin(heading)
        return slope * u + waves[0] * (u * u - v * v) + waves[1] * (u * u + v * v - 0.5) + waves[2] * (u**3 - u * 0.5)

    # Not higher than the room between floor and rim allows, over the disc that holds the vessel.
    turn = np.linspace(0.0, 2.0 * np.pi, 48)
    disc = reach * np.concatenate([s * np.stack([np.cos(turn), np.sin(turn)], axis=1) for s in (0.0, 0.5, 1.0)])
    swing = shape(disc)
    room = min((level - GAP) / max(-swing.min(), 1e-9), (vessel.rim - GAP - level) / max(swing.max(), 1e-9))
    scale = min(reach, max(room, 0.0))
    surface: SurfaceFunction = lambda places: level + scale * shape(places)  # noqa: E731
    return polar_heights(vessel, surface)


def _vessel(rng: np.random.Generator, choice: GlassStillOptions) -> tuple[VesselShape, float]:
    """A random vessel and its fill level [m].

    Raises: OptionError where the ranges hold no vessel of a family (a bowl wider than it is high has no rim).
    """
    family = choice.families[int(rng.integers(len(choice.families)))]
    for _ in range(100):
        level, freeboard = between(choice.fill, rng), between(choice.freeboard, rng)
        radius = between(choice.radius, rng)
        curved = family in (VesselFamily.bowl, VesselFamily.flask)
        if not curved or (level + freeboard > 1.1 * radius and freeboard > 0.3 * level):
            return draw_shape(family, radius, level, freeboard, rng), level
    raise OptionError(f"No {family.value} fits the ranges of radius, fill and freeboard; widen them.")


def _glasses(rng: np.random.Generator, choice: GlassStillOptions, count: int) -> tuple[Glass, ...]:
    """Glasses beside each other, the first at the origin."""
    glasses: list[Glass] = []
    for _ in range(count):
        vessel, level = _vessel(rng, choice)
        height = None if rng.random() < choice.empty else random_surface(rng, vessel, level, choice.steep)
        wall, floor = between(choice.wall, rng), between(choice.floor, rng)
        x = 0.0
        if glasses:
            first = glasses[0]
            beside = max(first.vessel.radii) + max(vessel.radii) + 2.0 * max(wall, first.wall)
            x = rng.choice([-1.0, 1.0]) * (beside * 1.1 + rng.uniform(0.004, 0.05))
        origin = np.array([x, 0.0 if not glasses else rng.uniform(-0.015, 0.015), floor])
        glasses.append(Glass(vessel, wall, floor, origin, height, rng.uniform(1.46, 1.55), rng.uniform(1.33, 1.48)))
    return tuple(glasses)


def _camera(
    rng: np.random.Generator, choice: GlassStillOptions, glasses: tuple[Glass, ...], size: tuple[int, int]
) -> Camera:
    """A camera that sees the glasses, most often all of them."""
    points = np.concatenate([outline_points(g) for g in glasses]) if glasses else np.eye(3) * 0.05
    low, high = points.min(axis=0), points.max(axis=0)
    distance = between(choice.distance, rng)
    fit = min(size[1] / (high[2] - low[2]), size[0] / (high[0] - low[0])) * between(choice.glass_share, rng)
    # Off the middle by as much as leaves the glasses in the picture, sometimes by more.
    free = 0.5 * (np.array(size) - fit * np.array([high[0] - low[0], high[2] - low[2]])) / fit
    shift = np.clip(rng.normal(0.0, 0.5, 2), -1.0, 1.0) * free * (1.5 if rng.random() < 0.1 else 0.9)
    target = np.array([0.5 * (low[0] + high[0]) + shift[0], 0.0, 0.5 * (low[2] + high[2]) + shift[1]])
    return looking_at(
        target,
        distance=distance,
        tilt=np.radians(between(choice.tilt_deg, rng)),
        roll=np.radians(choice.roll_deg) * rng.uniform(-1.0, 1.0),
        focal=fit * distance,
        size=size,
        distortion=rng.uniform(-0.08, 0.03),
    )


def _with_marks(
    rng: np.random.Generator, image: UInt8[np.ndarray, "height width 3"], glass: Glass, camera: Camera
) -> UInt8[np.ndarray, "height width 3"]:
    """A scale and a badge printed on the side of a glass that faces the camera."""
    heights, radii = outer_profile(glass.vessel, glass.wall, glass.floor)
    middle, rim = rng.uniform(-0.9, 0.9), glass.vessel.rim

    def pixels(turn: np.ndarray, height: np.ndarray) -> np.ndarray:
        radius = np.interp(height, heights, radii)
        deep = radius + (glass.vessel.aspect - 1.0) * glass.vessel.radii[0]
        points = np.stack([radius * np.sin(turn), -deep * np.cos(turn), height], axis=1) + glass.origin
        return np.rint(camera.project(points)).astype(np.int32)

    cover: np.ndarray = np.zeros(image.shape[:2], np.uint8)
    wide = rng.uniform(0.15, 0.5)
    for k, height in enumerate(np.arange(0.1 * rim, 0.85 * rim, rim * rng.uniform(0.06, 0.14))):
        turn = middle + np.linspace(0.0, wide * (1.0 if k % 2 else 0.6), 5)
        cv2.polylines(cover, [pixels(turn, np.full(5, height))], False, 255, 1, cv2.LINE_AA)
    low, high = np.sort(rng.uniform(0.15, 0.8, 2)) * rim
    corners = middle - np.array([0.2, 0.2, 0.5, 0.5]) * rng.uniform(0.6, 1.4)
    cv2.fillPoly(cover, [pixels(corners, np.array([low, high, high, low]))], 255, cv2.LINE_AA)
    share = (cv2.GaussianBlur(cover, (0, 0), 0.6) / 255.0 * rng.uniform(0.3, 0.9))[..., None]
    ink = rng.uniform(170.0, 245.0, 3) if rng.random() < 0.8 else rng.uniform(10.0, 230.0, 3)
    return np.clip(image * (1.0 - share) + share * ink, 0, 255).astype(np.uint8)


def _with_something_in_front(
    rng: np.random.Generator, frame: GlassFrame, outline: Float[np.ndarray, "points 2"]
) -> GlassFrame:
    """A finger, a pen, a sleeve before a glass: what it hides belongs to no mask."""
    low, high = outline.min(axis=0), outline.max(axis=0)
    start = low + rng.uniform(0.1, 0.9, 2) * (high - low)
    turn, reach = rng.uniform(0, 2 * np.pi), 2.0 * float(np.max(high - low))
    end = start + reach * np.array([np.cos(turn), np.sin(turn)])
    thick = int(max(2, rng.uniform(0.03, 0.22) * (high - low).min()))
    cover: np.ndarray = np.zeros(frame.image.shape[:2], np.uint8)
    cv2.line(cover, tuple(map(int, start)), tuple(map(int, end)), 255, thick, cv2.LINE_AA)
    cover = cv2.GaussianBlur(cover, (0, 0), 0.7)
    skin = np.array([120.0, 150.0, 205.0]) * rng.uniform(0.4, 1.15)
    colour = skin if rng.random() < 0.6 else rng.uniform(10.0, 230.0, 3)
    away = cv2.distanceTransform((cover > 128).astype(np.uint8), cv2.DIST_L2, 3)
    shade = (0.6 + 0.4 * np.clip(away / max(0.5 * thick, 1.0), 0.0, 1.0))[..., None]
    part = (cover / 255.0)[..., None]
    image = frame.image * (1.0 - part) + part * shade * colour
    keep = 1.0 - part[..., 0]
    return GlassFrame(
        np.clip(image, 0, 255).astype(np.uint8),
        np.rint(frame.container_mask * keep).astype(np.uint8),
        np.rint(frame.liquid_mask * keep).astype(np.uint8),
    )
