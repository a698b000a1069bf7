"""From a glass and its seen surface to the body that the engine computes: particles under a surface that is not level.

The seed's three steps: a cloud of Poisson-disk points in the cavity up to the highest point of the surface; points
above the surface seen in their column are cut off; what is left is packed evenly under the surface. The profile that is
seen from the front is extended over the depth by symmetry about the plane of motion. What no profile on the wall shows
is how far the middle lies above or below it; the volume that stood level in the glass before it was pushed tells.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from zsdt.errors import DataError, OptionError, RunRejected
from zsdt.fluid.kernel import plane_area
from zsdt.fluid.sampling import CLEAR, DISK_SHARE, SMOOTHING, Packer, poisson_disk, spacing_of
from zsdt.fluid.vessel import Vessel
from zsdt.fluid.wall_tables import WallTables
from zsdt.perception.free_surface import SurfaceOptions, SurfaceProfile, observe_surface
from zsdt.perception.glass_geometry import VesselFit
from zsdt.perception.mask_edges import MaskEdges
from zsdt.scene import Liquid, VesselShape
from zsdt.trajectory import Body, VesselMotion

SAMPLES = 201  # places over the width at which a surface is kept
LAYERS, SLICES = 100, 80  # of the integration of a volume
SHARES = (0.125, 0.375, 0.625, 0.875)  # of the half-depth at which it looks
FINENESS = 3.0  # of the wall tables: coarser than a solver's, for particles are only laid out by them
AROUND = 64  # angles of the contact line
ENOUGH_LEVEL, ENOUGH_FOR_MEDIAN = 2, 5  # pictures
INNER = 0.85  # of the half-width, between which a seen surface tells its mean height
FLAT = 0.06  # largest height over the half-width of a surface that counts as level
EVEN, STRAY = 0.5, 2e-3  # m/s2 and m: a glass that accelerates less and strays less from that is carried evenly
DEEPEST = 0.12  # of the level: farther the middle does not lie below or above the wall


@dataclass
class GlassGraphOptions:
    """particles: about how many (within some 10 %). packing: steps. least_level [m]: a liquid lower than that is none.
    seed: of the random points."""

    particles: int = 700
    packing: int = 120
    least_level: float = 0.01
    seed: int = 0

    def __post_init__(self) -> None:
        if self.particles < 50 or self.packing < 1 or self.least_level <= 0:
            raise OptionError("A liquid needs 50 particles at least, a step of packing and a positive least_level.")


class LiquidSurface:
    """Height over (x, y) [m] of a surface that is seen from the front, in the axes of the vessel.

    hollow [m]: how far its middle lies below what the profile on the wall says; a paraboloid that ends at the wall.
    """

    def __init__(self, profile: SurfaceProfile, shape: VesselShape, hollow: float = 0.0):
        self.scale, self.hollow = profile.scale, hollow
        self._shape = shape
        self._x = np.linspace(-1.3, 1.3, SAMPLES) * self.scale
        self._z = profile.at(self._x)

    def height(self, places: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, " points"]:
        """Height [m] of the surface at places (x, y) [m]."""
        height = np.interp(places[:, 0], self._x, self._z)
        if self.hollow == 0.0:
            return np.asarray(height)
        n = self._shape.exponent
        across = np.abs(places / (self.scale * np.array([1.0, self._shape.aspect]))) ** n
        return np.asarray(height - self.hollow * np.maximum(1.0 - across.sum(1) ** (2.0 / n), 0.0))

    def slope(self, places: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "points 2"]:
        """Gradient [-] of the height."""
        e = 1e-2 * self.scale
        sides = [(self.height(places + d) - self.height(places - d)) / (2.0 * e) for d in e * np.eye(2)]
        return np.stack(sides, axis=1)

    def highest(self, vessel: Vessel) -> float:
        """Highest point [m] over the cavity."""
        angle = 2.0 * np.pi * np.arange(AROUND) / AROUND
        rim = self.scale * np.stack([np.cos(angle), vessel.shape.aspect * np.sin(angle)], axis=1)
        places = np.concatenate([s * rim for s in (0.0, 0.25, 0.5, 0.75, 1.0)])
        return float(self.height(places).max())


def surface_of_volume(profile: SurfaceProfile, shape: VesselShape, volume: float | None) -> LiquidSurface:
    """The surface behind a profile under which the cavity holds a volume [m3]; level into the depth where it is None.

    The middle is lowered or raised as far as the volume asks, but by no more than `DEEPEST` of the level.
    """
    surface, vessel = LiquidSurface(profile, shape), Vessel(shape)
    if volume is None:
        return surface
    limit = DEEPEST * profile.level
    step = 0.25 * limit
    for _ in range(4):
        held = volume_below(surface, shape, surface.highest(vessel))
        lower = LiquidSurface(profile, shape, surface.hollow + step)
        slope = (volume_below(lower, shape, lower.highest(vessel)) - held) / step
        hollow = float(np.clip(surface.hollow + (volume - held) / slope, -limit, limit))
        surface = LiquidSurface(profile, shape, hollow)
    return surface


def rest_volume(
    fit: VesselFit,
    seen: Iterable[tuple[MaskEdges, float]],
    options: SurfaceOptions | None = None,
    even: bool = False,
) -> float | None:
    """Volume [m3] of the liquid, from pictures in which its surface was level; None where it was in too few.

    seen: edges and x [m] of the axis, of the pictures before t0: a glass that is carried evenly, or that still stands,
    holds its liquid level. Where too few are level by themselves, their median is looked at. even: the glass itself was
    seen to be carried evenly (see `carried_evenly`): then a surface that looks bent is bent by the masks, and its mean
    height tells the volume as well as they can.
    """
    shapes, scales = [], []
    for edges, x in seen:
        profile = observe_surface(edges, fit, x, options)
        if profile.known:
            shapes.append(_inner_line(profile))
            scales.append(profile.scale)
    level = [shape for shape, scale in zip(shapes, scales, strict=True) if np.ptp(shape) < FLAT * scale]
    if len(level) >= ENOUGH_LEVEL:
        return Vessel(fit.shape).volume(float(np.median(np.mean(level, axis=1))))
    # Masks that err in every picture may be right in their median; a tilt that is there in all of them stays.
    usual = np.median(shapes, axis=0) if len(shapes) >= ENOUGH_FOR_MEDIAN else None
    if usual is None or (not even and np.ptp(usual) >= FLAT * float(np.median(scales))):
        return None
    return Vessel(fit.shape).volume(float(np.mean(usual)))


def mean_volume(
    fit: VesselFit, seen: Iterable[tuple[MaskEdges, float]], options: SurfaceOptions | None = None
) -> float:
    """Volume [m3] below the mean height of the surface, in the middle one of the pictures.

    A liquid that swings from side to side keeps its mean height, so pictures of the motion tell the volume as well as
    those of the rest; and what masks make of a surface changes with what stands behind the glass, so many places tell
    it better than the first few. seen: as in `rest_volume`. Raises: DataError where no picture shows a surface.
    """
    heights = []
    for edges, x in seen:
        profile = observe_surface(edges, fit, x, options)
        if profile.known:
            heights.append(float(np.mean(_inner_line(profile))))
    if not heights:
        raise DataError("No picture shows the surface of the liquid, so its volume is not known.")
    return Vessel(fit.shape).volume(float(np.median(heights)))


def _inner_line(profile: SurfaceProfile) -> Float[np.ndarray, " places"]:
    """Heights [m] of a seen surface between the parts nearest to the wall."""
    return profile.at(np.linspace(-INNER, INNER, 35) * profile.scale)


def carried_evenly(times: Float[np.ndarray, " pictures"], places: Float[np.ndarray, " pictures"]) -> bool:
    """Whether a glass seen at places [m] at times [s] was carried evenly, or stood: so that its liquid stays level."""
    known = np.isfinite(places)
    if known.sum() < ENOUGH_FOR_MEDIAN:
        return False
    t, x = times[known] - times[known].mean(), places[known]
    bend, speed, place = np.polyfit(t, x, 2)
    stray = float(np.abs(x - np.polyval([bend, speed, place], t)).max())
    return 2.0 * abs(float(bend)) < EVEN and stray < STRAY


def sight_of(fit: VesselFit, seen: Iterable[tuple[MaskEdges, float]], options: SurfaceOptions | None = None) -> float:
    """By how much a level liquid looks bent [m], root mean square: what masks and refraction do to a seen surface.

    seen: as in `rest_volume`; 0 where no surface was seen.
    """
    squares = []
    for edges, x in seen:
        profile = observe_surface(edges, fit, x, options)
        if profile.known:
            squares.append(float(np.var(profile.height[profile.seen])))
    return float(np.sqrt(np.mean(squares))) if squares else 0.0


def volume_below(surface: LiquidSurface, shape: VesselShape, top: float) -> float:
    """Volume [m3] of the cavity below a surface whose highest point is at `top` [m]: slices across, layer by layer."""
    z = (np.arange(LAYERS) + 0.5) * top / LAYERS
    half = np.interp(z, shape.heights, shape.radii)[:, None]
    u = (np.arange(SLICES) + 0.5) / SLICES * 2.0 - 1.0
    deep = shape.aspect * half * (1.0 - np.abs(u) ** shape.exponent) ** (1.0 / shape.exponent)
    x = np.broadcast_to(u * half, deep.shape)
    below = np.zeros(deep.shape)
    for share in SHARES:  # symmetric about the plane of motion
        height = surface.height(np.column_stack([x.ravel(), share * deep.ravel()])).reshape(deep.shape)
        below += np.clip(0.5 + (height - z[:, None]) * LAYERS / top, 0.0, 1.0) / len(SHARES)
    return float((2.0 * deep * below * half).sum()) * 2.0 / SLICES * top / LAYERS


class LidPacker(Packer):
    """`Packer` under a surface that is not level: the lid is the plane that touches the surface over each particle."""

    def __init__(self, vessel: Vessel, surface: LiquidSurface, spacing: float):
        tables = WallTables(vessel, SMOOTHING * spacing, FINENESS, gamma_only=True)
        super().__init__(vessel, surface.highest(vessel), spacing, tables)
        self.surface = surface

    def _lid(self, points: Float[np.ndarray, "points 3"]) -> tuple[np.ndarray, np.ndarray]:
        """Distance [m] to the surface and its unit normal, upwards."""
        slope = self.surface.slope(points[:, :2])
        normal = np.column_stack([-slope, np.ones(len(points))])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        return (self.surface.height(points[:, :2]) - points[:, 2]) * normal[:, 2], normal

    def unevenness(self, points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
        """See `Packer.unevenness`."""
        distance, normal = self._lid(points)
        total = super().unevenness(points)
        total[:, 2] -= plane_area(self.level - points[:, 2], self.h)
        return np.asarray(total + plane_area(distance, self.h)[:, None] * normal)

    def _keep_clear(self, points: Float[np.ndarray, "points 3"]) -> None:
        distance, normal = self.vessel.distance_and_normal(points)
        points += np.maximum(CLEAR * self.spacing - distance, 0.0)[:, None] * normal
        high, lid = self._lid(points)
        points -= np.maximum(CLEAR * self.spacing - high, 0.0)[:, None] * lid


@dataclass(frozen=True)
class GlassGraph:
    """The liquid at t0: body (positions are `body.points`), its volume [m3], the height [m] at which it would stand at
    rest, and its surface."""

    body: Body
    volume: float
    level: float
    surface: LiquidSurface


def build_glass_graph(
    fit: VesselFit,
    profile: SurfaceProfile,
    *,
    liquid: Liquid,
    motion: VesselMotion,
    fps: float,
    gravity: float,
    options: GlassGraphOptions | None = None,
    volume: float | None = None,
) -> GlassGraph:
    """Particles under the seen surface. gravity [m/s2] downwards; volume [m3]: of the liquid where it is known (see
    `rest_volume`), else the surface is taken as level into the depth.

    Raises: DataError where no surface is seen or there is no liquid; RunRejected ("packing") where the liquid is too
    thin for its particles, ("overflow") where the surface is above the rim.
    """
    chosen = options or GlassGraphOptions()
    if not profile.known:
        raise DataError("No free surface is seen in the glass at t0; light it better or clean the glass.")
    surface = surface_of_volume(profile, fit.shape, volume)
    return fill_below(fit.shape, surface, liquid=liquid, motion=motion, fps=fps, gravity=gravity, options=chosen)


def fill_below(
    shape: VesselShape,
    surface: LiquidSurface,
    *,
    liquid: Liquid,
    motion: VesselMotion,
    fps: float,
    gravity: float,
    options: GlassGraphOptions,
) -> GlassGraph:
    """The same from a cavity and a surface."""
    vessel = Vessel(shape)
    top = surface.highest(vessel)
    if top < options.least_level:
        raise DataError(f"The liquid stands {1000 * top:.1f} mm high, which is too little to compute; pour in more.")
    if top > shape.rim:
        raise RunRejected("overflow", "The liquid stands above the rim of the glass; film a glass that is less full.")
    volume = volume_below(surface, shape, top)
    wanted = spacing_of(volume, options.particles)
    rng = np.random.default_rng([options.seed, 0x61A5])
    points = poisson_disk(vessel, top, DISK_SHARE * wanted, 0.25 * wanted, rng)
    points = points[points[:, 2] < surface.height(points[:, :2]) - 0.25 * wanted]
    if len(points) < 0.5 * options.particles:
        raise RunRejected(
            "packing",
            f"Only {len(points)} of {options.particles} particles find a place in the liquid; ask for another number.",
        )
    spacing = spacing_of(volume, len(points))
    points = LidPacker(vessel, surface, spacing).pack(points, options.packing)
    body = Body(
        points=points,
        pairs=np.zeros((0, 2), np.int64),
        clamped=np.zeros(len(points), bool),
        mass=np.full(len(points), liquid.density * spacing**3),
        frame_dt=1.0 / fps,
        pitch=spacing,
        gravity=np.array([0.0, 0.0, -gravity]),
        liquid=liquid,
        vessel=shape,
        motion=motion,
    )
    return GlassGraph(body, volume, vessel.level(volume), surface)
