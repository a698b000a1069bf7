"""The beginning of a glass twin: from what the frames around t0 showed to a vessel, its liquid and a twin."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float

from zsdt.errors import DataError
from zsdt.perception.camera import Camera
from zsdt.perception.free_surface import SurfaceOptions, SurfaceProfile, observe_surface, project_surface, seen_wall
from zsdt.perception.glass_geometry import VesselFit, fit_vessel
from zsdt.perception.mask_edges import MaskEdges
from zsdt.perception.vessel_track import RestDetector, told_motion
from zsdt.tignn.engine import Engine
from zsdt.trajectory import VesselMotion
from zsdt.twin.glass_graph import GlassGraph, build_glass_graph, carried_evenly, mean_volume, rest_volume, sight_of
from zsdt.twin.glass_scene import GlassTwinScene
from zsdt.twin.glass_twin import GlassTwin
from zsdt.twin.glass_watch import GlassWatch, Sighting
from zsdt.twin.liquid_history import CarriedLiquid, FirstState, carried_liquid
from zsdt.twin.loop_common import Clock

if TYPE_CHECKING:
    from zsdt.twin.glass_loop import GlassTwinOptions

log = logging.getLogger(__name__)

COLUMNS, REACH = 33, 0.92  # of the profile in the log, and how far out in half-widths
PICTURES = 10  # in which the vessel is fitted
CALM_PICTURES = 8  # of the first ones, in which the liquid may stand level and tell its volume
MOST_PLACES = 48  # of a profile that the twin takes


@dataclass(frozen=True)
class SightedProfile:
    """See `zsdt.twin.seen_surface.Profile`."""

    places: Float[np.ndarray, "c 2"]
    height: Float[np.ndarray, " c"]
    seen: Bool[np.ndarray, " c"]
    climb: Float[np.ndarray, " c"]


@dataclass
class Beginning:
    """A vessel, a liquid and a twin at t0.

    offset [m]: x of the fitted vessel less that of the tracker; places [columns, 2] m: where the surface's profile is
    told; px_per_m: at the vessel; start_ms: what the beginning took.
    """

    fit: VesselFit
    twin: GlassTwin
    offset: float
    places: Float[np.ndarray, "columns 2"]
    px_per_m: float
    options: SurfaceOptions
    start_ms: dict[str, float]

    def surface(self) -> Float[np.ndarray, " columns"]:
        """Heights [m] of the twin's surface at `places`."""
        return self.twin.surface(self.places)

    def observe(self, edges: MaskEdges, x: float) -> SurfaceProfile:
        """The surface in a picture, with the vessel's axis at x [m]."""
        return observe_surface(edges, self.fit, x, self.options)

    def thinned(self, profile: SurfaceProfile) -> SightedProfile:
        """The believed places of a profile, no more than the twin needs, with the slopes of their lines of sight."""
        known = np.flatnonzero(profile.seen)
        if len(known) > MOST_PLACES:
            known = known[np.unique(np.linspace(0, len(known) - 1, MOST_PLACES).round().astype(np.int64))]
        places, height = profile.places[known], profile.height[known]
        eye = self.fit.camera.center - self.fit.origin()
        climb = (height - eye[2]) / (places[:, 1] - eye[1])
        return SightedProfile(places, height, profile.seen[known], climb)

    def along(
        self, profile: SurfaceProfile | None, x: float
    ) -> tuple[Float[np.ndarray, " columns"], Float[np.ndarray, "columns 2"]]:
        """Seen heights [m] at `places` and where they are in the picture [px]; NaN where nothing was seen near by.

        Where the liquid in front hides the wall, heights are less what it stands out by in the twin."""
        nothing = np.full(len(self.places), np.nan)
        if profile is None or not profile.known:
            return nothing, np.full((len(nothing), 2), np.nan)
        across = self.places[:, 0]
        near = np.abs(across[:, None] - profile.places[profile.seen, 0]).min(axis=1) <= across[1] - across[0]
        seen = np.where(near, profile.at(across), np.nan)
        pixels = project_surface(self.fit, x, self.places, seen)
        eye = self.fit.camera.center - self.fit.origin()
        climb = (np.where(near, seen, self.twin.still) - eye[2]) / (self.places[:, 1] - eye[1])
        hidden = self.twin.shown(SightedProfile(self.places, seen, near, climb))[0] - self.surface()
        return seen - hidden, pixels


def begin_glass(
    sightings: Sequence[Sighting],
    row: int,
    rest: RestDetector,
    camera: Camera,
    scene: GlassTwinScene,
    fps: float,
    engine: Engine,
    psi_ini: Any | None,
    options: GlassTwinOptions,
    clock: Clock,
) -> Beginning:
    """A twin at the frame `row`, from all that was seen until now.

    Raises: DataError where no whole glass or no surface was seen; RunRejected where no particles can be made of it.
    """
    times = [clock.now()]
    fit = fit_vessel(_fair(sightings, row), camera, scene.told())
    now = sightings[row]
    assert now.edges is not None
    tracked = [s.x for s in sightings[row:] if np.isfinite(s.x)]
    offset = fit.x - float(np.median(tracked)) if tracked else 0.0
    profile = observe_surface(now.edges, fit, fit.x, options.surface)
    for later in sightings[row + 1 :]:  # a flash over the surface at t0 itself: the next frame is nearly as good
        if profile.known or later.edges is None:
            break
        profile = observe_surface(later.edges, fit, fit.x, options.surface)
    calm = [(s.edges, s.x + offset) for s in sightings[:row] if s.edges is not None and np.isfinite(s.x)]
    volume = rest_volume(fit, calm[:CALM_PICTURES], options.surface, _evenly(sightings[:row]))
    if volume is not None:  # it was seen level, so it is carried; how much it is, all pictures tell
        every = [(s.edges, s.x + offset) for s in sightings if s.edges is not None and np.isfinite(s.x)]
        volume = mean_volume(fit, every, options.surface)
    times.append(clock.now())
    motion = told_motion(rest.times, rest.places, rest.stop, now.time, scene.gravity)
    carried = _history(engine, fit, motion, volume, scene, fps, options)
    body = carried.body if carried is not None else _graph(fit, profile, motion, volume, scene, fps, options).body
    times.append(clock.now())
    trust = options.assimilation
    if trust.sight is None:
        trust = replace(trust, sight=sight_of(fit, calm[:CALM_PICTURES], options.surface))
    twin = GlassTwin(engine, psi_ini, body, trust)
    twin.prepare()
    times.append(clock.now())
    twin.begin(None if carried is None else carried.fields)
    times.append(clock.now())
    across = np.linspace(-REACH, REACH, COLUMNS) * profile.scale
    places = seen_wall(fit, fit.x, across, profile.at(across))
    parts = dict(zip(("fit", "graph", "prepare", "begin"), 1e3 * np.diff(times), strict=True))
    depth = float(fit.camera.depths(fit.origin()[None])[0])
    return Beginning(
        fit, twin, offset, places, float(fit.camera.matrix[0, 0]) / depth, options.surface,
        {name: float(ms) for name, ms in parts.items()},
    )  # fmt: skip


def _graph(
    fit: VesselFit, profile: SurfaceProfile, motion: VesselMotion, volume: float | None, scene: GlassTwinScene,
    fps: float, options: GlassTwinOptions,
) -> GlassGraph:  # fmt: skip
    """Particles under the surface that was seen at t0."""
    return build_glass_graph(
        fit, profile, liquid=scene.liquid, motion=motion, fps=fps, gravity=scene.gravity, volume=volume,
        options=replace(options.graph, particles=scene.particles),
    )  # fmt: skip


def _history(
    engine: Engine, fit: VesselFit, motion: VesselMotion, volume: float | None, scene: GlassTwinScene,
    fps: float, options: GlassTwinOptions,
) -> CarriedLiquid | None:  # fmt: skip
    """The liquid carried from its rest before, if that is wanted and was seen."""
    if options.first_state is not FirstState.history:
        return None
    if volume is None:
        log.warning("The liquid was never seen level before the stop; Psi_ini says what it does at t0.")
        return None
    return carried_liquid(
        engine, fit.shape, volume, motion, liquid=scene.liquid, fps=fps, gravity=scene.gravity,
        options=replace(options.graph, particles=scene.particles),
    )  # fmt: skip


def _evenly(before: Sequence[Sighting]) -> bool:
    """Whether the glass was carried evenly in the pictures that tell the volume."""
    seen = [s for s in before if s.edges is not None and np.isfinite(s.x)][:CALM_PICTURES]
    return carried_evenly(np.array([s.time for s in seen]), np.array([s.x for s in seen]))


def _fair(sightings: Sequence[Sighting], row: int) -> list[MaskEdges]:
    """Edges for the fit: of frames in which the vessel stands, the last one last, and some before."""
    still = [s.edges for s in sightings[row:] if s.edges is not None]
    before = [s.edges for s in sightings[:row] if s.edges is not None]
    few = max(PICTURES - len(still), 0)
    spread = np.unique(np.linspace(0, len(before) - 1, few).astype(int)).tolist() if before and few else []
    return [before[int(k)] for k in spread] + still[-PICTURES:]


def no_beginning(name: str, frames: int, watch: GlassWatch) -> DataError:
    """Why a twin never began, in words."""
    if frames == 0:
        return DataError(f"{name} holds no frame; check the file.")
    if watch.seen == 0:
        return DataError(
            f"No glass was seen in any of the {frames} frames of {name}; show it whole and well lit, or train the "
            "segmentation on pictures of it."
        )
    if watch.wet == 0:
        return DataError(f"The glass in {name} is empty: no liquid was seen in {watch.seen} frames. Pour some in.")
    if not watch.rest.moved_before:
        return DataError(
            f"The glass in {name} is never moved, so nothing makes its liquid slosh. Move it along the picture and "
            "stop it, or set still_start for a liquid that begins at rest."
        )
    return DataError(
        f"The glass in {name} never comes to rest within {frames} frames; film on for some frames after it stops."
    )
