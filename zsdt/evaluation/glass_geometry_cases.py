"""Glasses of known shape with known surfaces, seen by the virtual lab's cameras, and how well they are read.

A case is some pictures of a glass that moves evenly with its liquid level, and one at t0 with a surface that is askew.
Its cavity, its axis and the seen surface are reconstructed from masks and held against the truth; the same without the
refraction of the wall and without the correction of the silhouette tells what these bring.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from zsdt.evaluation.glass_scenes import outline_mask
from zsdt.fluid.vessel import Vessel
from zsdt.lab.glass_clips import GlassClip
from zsdt.lab.glass_lab import GlassLabOptions, GlassPlan, draw_glass_case
from zsdt.lab.glass_shooting import GlassShooting, developed
from zsdt.lab.glass_surface import VolumeBelow, polar_heights, wall_radius
from zsdt.lab.glass_view import GlassPicture, GlassView
from zsdt.perception.camera import Camera
from zsdt.perception.free_surface import SurfaceProfile, observe_surface
from zsdt.perception.glass_geometry import ToldGlass, VesselFit, axis_of, fit_vessel
from zsdt.perception.mask_edges import MaskEdges, read_edges
from zsdt.perception.vessel_track import RestDetector, VesselTracker
from zsdt.scene import VesselFamily, VesselShape
from zsdt.twin.glass_graph import rest_volume, surface_of_volume, volume_below

MOVING, AFTER = 3, 3  # pictures before the excitation, and at rest before the one that is read
COMPARED = 0.9  # of the half-width at the level: where heights are compared
Image = UInt8[np.ndarray, "height width 3"]
Masks = tuple[np.ndarray, np.ndarray]
Segment = Callable[[Image], Masks]
STOP_NOISE = 0.3  # px: of an edge in a row, beside the shaking of the camera that the lab adds


@dataclass(frozen=True)
class GlassCase:
    """Pictures with exact masks (container, liquid), the last at t0, and the truth.

    camera: as told. height [rings, angles] m: of the surface in the last picture (see `zsdt.lab.glass_view.Glass`).
    moving: how many pictures are from before the excitation.
    """

    name: str
    family: VesselFamily
    shape: VesselShape
    told: ToldGlass
    camera: Camera
    images: list[Image]
    masks: list[Masks]
    height: Float[np.ndarray, "rings angles"]
    moving: int = MOVING

    @property
    def fill(self) -> float:
        """Height [m] at which the liquid would stand at rest."""
        return Vessel(self.shape).level(VolumeBelow(self.shape)(self.height))


@dataclass(frozen=True)
class Reading:
    """What was read from a case: the glass, its surface at t0, and errors by name."""

    fit: VesselFit
    profile: SurfaceProfile
    figures: dict[str, float]


def told_glass(shape: VesselShape, wall: float, floor: float, index: float) -> ToldGlass:
    """What a scene says of a glass."""
    return ToldGlass(wall, floor, shape.aspect, shape.exponent, index)


def lab_case(number: int, options: GlassLabOptions, picture: GlassPicture) -> GlassCase:
    """A glass of the lab with a random surface, without a simulation; families take turns with the number."""
    plan = GlassPlan(number, options.families[number % len(options.families)])
    drawn = draw_glass_case(plan, options, 0)
    shooting = GlassShooting(plan, options, drawn)
    rng = plan.rng(options, 9)
    askew = polar_heights(drawn.shape, random_waves(drawn.shape, drawn.fill, rng))
    rest = Vessel(drawn.shape).level(VolumeBelow(drawn.shape)(askew))
    level = polar_heights(drawn.shape, lambda places: np.full(len(places), rest))
    first, last = _frames(drawn.t0_frame)
    images, masks = [], []
    for frame, height in [*((k, level) for k in first), *((k, askew) for k in last)]:
        glass = shooting.glass(drawn.path[frame], height)
        shot = picture(GlassView((glass,), shooting.style, shooting.camera, shooting.shake[frame]))
        taken = developed([shot], shooting.style, float(shooting.exposure[frame]), frame)
        images.append(taken.image)
        masks.append((taken.container_mask, taken.liquid_mask))
    told = told_glass(drawn.shape, drawn.wall, drawn.floor, options.glass_index)
    return GlassCase(
        f"{plan.family.value}_{number:03d}", plan.family, drawn.shape, told, shooting.nominal_camera, images, masks,
        askew,
    )  # fmt: skip


def _frames(t0_frame: int) -> tuple[list[int], list[int]]:
    """Frames of a clip that are looked at: some before the excitation, and from t0 on as long as rest is waited for."""
    return list(range(0, 4 * MOVING, 4)), list(range(t0_frame, t0_frame + AFTER + 1))


def random_waves(
    shape: VesselShape, level: float, rng: np.random.Generator
) -> Callable[[Float[np.ndarray, "places 2"]], Float[np.ndarray, " places"]]:
    """A surface as the lab's liquids have it where a glass stops: piled up at one side, hollow in the middle, more so
    along the motion than across."""
    reach = float(np.interp(level, shape.heights, shape.radii))
    askew = min(0.25 * level, 0.5 * (shape.rim - level)) * rng.uniform(0.2, 1.0) * rng.choice([-1.0, 1.0])
    along, across = abs(askew) * rng.uniform(0.15, 0.7), abs(askew) * rng.uniform(0.05, 0.3)

    def height(places: Float[np.ndarray, "places 2"]) -> Float[np.ndarray, " places"]:
        x, y = places[:, 0] / reach, places[:, 1] / (reach * shape.aspect)
        return level + askew * x + along * (x * x - 0.25) + across * (y * y - 0.25)

    return height


def clip_case(clip: GlassClip) -> GlassCase:
    """Frames of a clip of the lab before and at t0; the one at t0 is the last, those after it (which the twin knows by
    the time that it is sure of the rest) are before it."""
    first, rest = _frames(clip.t0_frame)
    wanted = [*first, *rest[1:], rest[0]]
    images = {f.index: f.image for f in clip.source() if f.index in wanted and f.image is not None}
    shape = clip.truth.body.vessel
    assert shape is not None
    told = told_glass(shape, clip.scene.wall, clip.scene.floor, clip.scene.glass_index)
    return GlassCase(
        clip.name, shape.family, shape, told, clip.camera, [images[k] for k in wanted],
        [clip.masks(k) for k in wanted], clip.surface[rest[0]],
    )  # fmt: skip


def read_case(case: GlassCase, segment: Segment | None = None) -> Reading:
    """Reconstruction of a case from its exact masks, or from what a network says of its pictures.

    Raises: DataError where the glass is not found.
    """
    masks = case.masks if segment is None else [segment(image) for image in case.images]
    edges = [read_edges(*pair) for pair in masks]
    fit = fit_vessel(edges, case.camera, case.told)
    profile = observe_surface(edges[-1], fit, fit.x)
    rest = rest_volume(fit, [(e, axis_of(e, fit.camera)) for e in edges[: case.moving]])
    figures = {**geometry_errors(case, fit), **surface_errors(case, fit, profile, rest), **biases(case, fit, edges[-1])}
    return Reading(fit, profile, figures)


def geometry_errors(case: GlassCase, fit: VesselFit) -> dict[str, float]:
    """Errors of the cavity below the level: radius [mm], rim [mm], volume below the true level [%]."""
    found, true = Vessel(fit.shape), Vessel(case.shape)
    z = np.linspace(0.05, 1.0, 40) * case.fill
    off = np.asarray(found.radius(z)) - np.asarray(true.radius(z))
    return {
        "radius_mm": 1e3 * float(np.sqrt(np.mean(off**2))),
        "rim_mm": 1e3 * (fit.shape.rim - case.shape.rim),
        "cavity_pct": 100.0 * (found.volume(case.fill) / true.volume(case.fill) - 1.0),
    }


def true_contact(
    case: GlassCase, far: bool = True
) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"]]:
    """x and height [m] of the contact line on the far or near half of the wall, x rising."""
    angles = case.height.shape[1]
    angle = 2.0 * np.pi * np.arange(angles) / angles
    x = wall_radius(case.shape, angle, case.height[-1]) * np.cos(angle)
    half = np.sin(angle) > -1e-9 if far else np.sin(angle) < 1e-9
    order = np.argsort(x[half])
    return x[half][order], case.height[-1][half][order]


def surface_errors(
    case: GlassCase, fit: VesselFit, profile: SurfaceProfile, rest: float | None = None
) -> dict[str, float]:
    """Errors of the profile on the wall [% of the fill], of its mean [mm], of the whole surface [%] and of the volume
    [%]; these with the volume at rest [m3] and as if the surface were level into the depth."""
    if not profile.known:
        return {"profile_pct": float("nan"), "volume_pct": float("nan")}
    far = bool(fit.camera.center[2] > fit.told.floor + case.fill)
    x, height = true_contact(case, far)
    across = COMPARED * np.clip(profile.scale * np.linspace(-1.0, 1.0, 61), x[0], x[-1])  # a neck ends it earlier
    off = profile.at(across) - np.interp(across, x, height)
    rings, angles = case.height.shape
    angle = 2.0 * np.pi * np.arange(angles) / angles
    share = np.linspace(0.0, 1.0, rings)[:, None]
    radius = share * wall_radius(case.shape, angle, case.height[-1])
    places = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1).reshape(-1, 2)
    weight = np.broadcast_to(share, case.height.shape).ravel()
    true = VolumeBelow(case.shape)(case.height)
    figures = {
        "profile_pct": 100.0 * float(np.sqrt(np.mean(off**2))) / case.fill,
        "profile_worst_pct": 100.0 * float(np.abs(off).max()) / case.fill,
        "level_mm": 1e3 * float(off.mean()),
        "columns": float(profile.seen.sum()),
    }
    for name, known in (("", rest), ("_level", None)):
        surface = surface_of_volume(profile, fit.shape, known)
        error = surface.height(places) - case.height.ravel()
        figures[f"surface{name}_pct"] = 100.0 * float(np.sqrt(np.average(error**2, weights=weight))) / case.fill
        volume = volume_below(surface, fit.shape, surface.highest(Vessel(fit.shape)))
        figures[f"volume{name}_pct"] = 100.0 * (volume / true - 1.0)
    return figures


def biases(case: GlassCase, fit: VesselFit, edges: MaskEdges) -> dict[str, float]:
    """The same figures without a correction: level and profile without refraction, the cavity read off in the plane of
    the axis."""
    straight = observe_surface(edges, replace(fit, walls=replace(fit.walls, index=1.0)), fit.x)
    plain = {k: v for k, v in surface_errors(case, fit, straight).items() if k in ("profile_pct", "level_mm")}
    return {f"{k}_unrefracted": v for k, v in plain.items()} | {"cavity_pct_flat": _flat_cavity(case, edges)}


def _flat_cavity(case: GlassCase, edges: MaskEdges) -> float:
    """Error [%] of the cavity whose profile is the silhouette laid into the plane y = 0, less the told wall."""
    both = np.isfinite(edges.left) & np.isfinite(edges.right)
    ends = [
        case.camera.on_plane(np.column_stack([side[both], edges.rows[both]]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
        for side in (edges.left, edges.right)
    ]
    z = 0.5 * (ends[0][:, 2] + ends[1][:, 2]) - case.told.floor
    r = 0.5 * (ends[1][:, 0] - ends[0][:, 0]) - case.told.wall
    order = np.argsort(z)
    level = np.linspace(0.0, case.fill, 200)
    found = np.trapezoid(np.interp(level, z[order], r[order]) ** 2, level)
    radius = np.asarray(Vessel(case.shape).radius(level))
    return 100.0 * float(found / np.trapezoid(radius**2, level) - 1.0)


def drawn_stop(number: int, options: GlassLabOptions) -> dict[str, Any]:
    """t0 of a clip of the lab of which only the outlines are drawn, with noise on their edges: error in frames."""
    plan = GlassPlan(number, options.families[number % len(options.families)])
    case = draw_glass_case(plan, options, 0)
    shooting = GlassShooting(plan, options, case)
    rng = plan.rng(options, 11)
    edges = []
    for frame in range(min(case.frames, case.t0_frame + 16)):
        ends = case.places(case.times[frame] + shooting.shutter * np.array([-1 / 3, 0.0, 1 / 3]))
        cover = np.mean([outline_mask(case.shape, case.wall, case.floor, place, shooting.camera,
                                      shooting.shake[frame]) for place in ends], axis=0)  # fmt: skip
        seen = read_edges(np.rint(cover).astype(np.uint8), np.zeros(cover.shape, np.uint8))
        noise = STOP_NOISE * rng.normal(size=(2, len(seen.rows)))
        edges.append(replace(seen, left=seen.left + noise[0], right=seen.right + noise[1]))
    figures = stop_errors(edges, shooting.nominal_camera, 1.0 / options.fps, case.t0_frame,
                          case.lead + case.excitation.duration)  # fmt: skip
    return {"clip": plan.name, "family": plan.family.value, "kind": _kind(len(case.excitation.changes)), **figures}


def _kind(changes: int) -> str:
    return "pulse and stop" if changes > 1 else "stop"


def stop_errors(edges: Sequence[MaskEdges], camera: Camera, step: float, t0_frame: int, t0: float) -> dict[str, float]:
    """t0 as it is told when rest is first announced: error in frames, of the instant [ms], and how many frames after t0
    that is. NaN where no rest was announced."""
    tracker, detector, told = VesselTracker(camera), RestDetector(), None
    for frame, seen in enumerate(edges):
        detector.update(frame * step, tracker.update(seen))
        if detector.t0 is not None and detector.moved_before:
            told = frame
            break
    if told is None or detector.t0 is None or detector.stop is None:
        return {"frames_off": float("nan"), "instant_ms": float("nan"), "told_after": float("nan")}
    return {
        "frames_off": float(round(detector.t0 / step) - t0_frame),
        "instant_ms": 1e3 * (detector.stop.time - t0),
        "told_after": float(told - t0_frame),
    }


def clip_stop(clip: GlassClip, segment: Segment | None = None) -> dict[str, Any]:
    """t0 of a clip of the lab, from exact masks or from a network's."""
    edges = []
    for frame in clip.source():
        if frame.image is None:
            continue
        edges.append(read_edges(*(clip.masks(frame.index) if segment is None else segment(frame.image))))
    figures = stop_errors(edges, clip.camera, 1.0 / clip.scene.fps, clip.t0_frame, float(clip.hidden["t0_s"]))
    return {"clip": clip.name, "family": clip.hidden["family"], "kind": clip.hidden["regime"], **figures}
