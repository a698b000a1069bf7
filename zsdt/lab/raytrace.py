"""The physically based camera of the virtual laboratory for glasses: rays through glass and liquid with Mitsuba.

Optional: needs the extra ``zsdt[raytrace]``. The glass is a set of nested dielectrics (`zsdt.lab.glass_mesh`), light
is followed through it in linear units (`zsdt.lab.raytrace_light`), the room is that of the painter, which is faster
and knows fewer reflections.
"""

from __future__ import annotations

import math
from typing import no_type_check

import cv2
import numpy as np
from jaxtyping import Bool, Float
from numba import njit

from zsdt.lab.beam_painter import shaken
from zsdt.lab.glass_mesh import GlassMesher, Mesh
from zsdt.lab.glass_painter import without_slivers
from zsdt.lab.glass_rays import Room, see
from zsdt.lab.glass_scenery import light_of, room_of, with_feet
from zsdt.lab.glass_styles import GlassStyle
from zsdt.lab.glass_view import Glass, GlassView, Shot
from zsdt.lab.raytrace_caster import MitsubaCaster
from zsdt.lab.raytrace_light import AIR, Interface, Medium, follow, joined_surfaces
from zsdt.lab.raytrace_options import RaytraceOptions
from zsdt.perception.camera import Camera

GAMMA = 2.2  # between radiance and what is displayed
PER_CM = 100.0


def sample_places(samples: int) -> Float[np.ndarray, "samples 2"]:
    """Places within a pixel, from -0.5 to 0.5 around its centre: the first points of the R2 sequence, spread evenly."""
    if samples == 1:
        return np.zeros((1, 2))
    turn = (np.arange(samples)[:, None] + 0.5) * [0.7548776662466927, 0.5698402909980532] % 1.0
    return turn - turn.mean(axis=0)


def to_radiance(display: np.ndarray) -> np.ndarray:
    """Linear radiance, 1 for white, of colours as displayed (0 to 255, lights may exceed it)."""
    return (np.asarray(display, np.float32) / np.float32(255.0)) ** np.float32(GAMMA)


class RayTracer:
    """A `zsdt.lab.glass_view.GlassPicture`. Raises: OptionError without Mitsuba (see `load_mitsuba`)."""

    def __init__(self, options: RaytraceOptions | None = None):
        self.options = options or RaytraceOptions()
        self._meshers: list[GlassMesher] = []
        self._lens: tuple[Camera, np.ndarray] | None = None
        self._room: tuple[GlassStyle, Room] | None = None

    def __call__(self, view: GlassView) -> Shot:
        """The picture of a view and its masks."""
        camera = shaken(view.camera, view.shake)
        room = self._room_of(view)
        lines = self._lines_of_sight(view.camera)
        colours = np.zeros((camera.height * camera.width, 3))
        ways = directions_of(camera, lines.reshape(-1, 2), np.zeros((1, 2)))
        _see_all(np.array([camera.center]), ways, room, colours)
        picture = colours.reshape(camera.height, camera.width, 3)
        container, liquid = np.zeros(picture.shape[:2], np.uint8), np.zeros(picture.shape[:2], np.uint8)
        interfaces, outline = self._interfaces(view, camera)
        if outline.any():
            pixels = np.nonzero(outline)
            picture[pixels], container[pixels], liquid[pixels] = self._trace(
                interfaces, room, camera, lines[pixels], -(-self.options.samples // view.moments)
            )
            liquid = without_slivers(liquid)
        display = (255.0 * np.minimum(picture, 1.0) ** (1.0 / GAMMA)).astype(np.float32)
        display *= light_of(view.style, camera.width, camera.height)
        blurred = cv2.GaussianBlur(display, (0, 0), view.style.blur) if view.style.blur > 0.2 else display
        return Shot(np.clip(blurred, 0.0, 255.0).astype(np.float32), container, liquid)

    def _trace(
        self,
        interfaces: list[Interface],
        room: Room,
        camera: Camera,
        centres: Float[np.ndarray, "pixels 2"],
        samples: int,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Radiance [pixels, 3] and covers [pixels] of container and liquid of pixels."""
        count = len(centres)
        offsets = sample_places(samples) / np.diag(camera.matrix)[:2]
        directions = directions_of(camera, centres, offsets)
        mesh, surfaces = joined_surfaces(interfaces)

        def light(origins: np.ndarray, ways: np.ndarray) -> np.ndarray:
            found = np.zeros((len(ways), 3))
            _see_all(origins, ways, room, found)
            return found

        seen = follow(
            surfaces,
            MitsubaCaster(mesh, self.options.variant).cast,
            light,
            np.broadcast_to(camera.center, directions.shape),
            directions,
            turn=np.tile(np.arange(samples), count),
            turns=samples,
            depth=self.options.depth,
            dim=0.5 * room.ambient,
        )
        radiance = seen.radiance.reshape(count, samples, 3).mean(axis=1)
        covers = [part.reshape(count, samples).mean(axis=1) for part in (seen.container, seen.liquid)]
        container, liquid = (np.rint(255.0 * cover).astype(np.uint8) for cover in covers)
        return radiance, container, liquid

    def _interfaces(self, view: GlassView, camera: Camera) -> tuple[list[Interface], Bool[np.ndarray, "height width"]]:
        """The surfaces of all glasses in the room, and the pixels in which they may be seen."""
        interfaces: list[Interface] = []
        outline: np.ndarray = np.zeros((camera.height, camera.width), np.uint8)
        glass_loss, liquid_loss = (
            -PER_CM * np.log(np.maximum(to_radiance(255.0 * tint), 1e-3))
            for tint in (view.style.glass_tint, view.style.liquid_tint)
        )
        for glass in view.glasses:
            found = self._of_glass(glass, glass_loss, liquid_loss)
            pixels = camera.project(found[0].mesh.vertices)
            pixels = np.clip(pixels[np.isfinite(pixels).all(axis=1)], -4e3, 8e3)
            if len(pixels):
                hull = cv2.convexHull(np.rint(pixels).astype(np.int32))
                cv2.fillConvexPoly(outline, hull, 1)
                cv2.polylines(outline, [hull], True, 1, 4)
            interfaces += found
        return interfaces, outline > 0

    def _of_glass(self, glass: Glass, glass_loss: np.ndarray, liquid_loss: np.ndarray) -> list[Interface]:
        meshes = self._mesher_of(glass).meshes(glass.height)
        solid, liquid = Medium(glass.glass_index, glass_loss), Medium(glass.liquid_index, liquid_loss)
        found = [Interface(_moved(meshes.glass_air, glass.origin), solid, AIR, False)]
        if meshes.glass_liquid is not None and meshes.liquid_air is not None:
            found += [
                Interface(_moved(meshes.glass_liquid, glass.origin), liquid, solid, True),
                Interface(_moved(meshes.liquid_air, glass.origin), liquid, AIR, True),
            ]
        return found

    def _lines_of_sight(self, camera: Camera) -> Float[np.ndarray, "height width 2"]:
        """Undistorted places at depth 1 of all pixels; kept while the camera stays."""
        if self._lens is None or self._lens[0] is not camera:
            u, v = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
            lines = camera.normalise(np.stack([u, v], axis=-1).reshape(-1, 2))
            self._lens = camera, lines.reshape(camera.height, camera.width, 2)
        return self._lens[1]

    def _room_of(self, view: GlassView) -> Room:
        """The room in linear light; its pictures are kept while the style stays."""
        if self._room is None or self._room[0] is not view.style:
            self._room = view.style, linear_room(view.style)
        return with_feet(self._room[1], view.glasses)

    def _mesher_of(self, glass: Glass) -> GlassMesher:
        """What makes the meshes of a glass; kept for the glasses of the last views."""
        for mesher in self._meshers:
            if mesher.made_for(glass.vessel, glass.wall, glass.floor):
                return mesher
        self._meshers = [*self._meshers[-3:], GlassMesher(glass.vessel, glass.wall, glass.floor, self.options.angles)]
        return self._meshers[-1]


def linear_room(style: GlassStyle) -> Room:
    """The surroundings of a style in linear light, 1 for white, with nothing on the table."""
    room, levels = room_of(style), to_radiance(np.arange(256))
    windows = room.windows.copy()
    windows[:, 4] = to_radiance(windows[:, 4])
    return room._replace(
        backdrop=levels[room.backdrop],
        table=levels[room.table],
        ambient=to_radiance(room.ambient).astype(np.float64),
        windows=windows,
    )


def _moved(mesh: Mesh, origin: Float[np.ndarray, "3"]) -> Mesh:
    return Mesh(mesh.vertices + origin, mesh.normals, mesh.faces)


def directions_of(
    camera: Camera, lines: Float[np.ndarray, "pixels 2"], offsets: Float[np.ndarray, "samples 2"]
) -> Float[np.ndarray, "rays 3"]:
    """Unit directions in the room through places at depth 1, `samples` for each pixel, one pixel after the other."""
    found = np.empty((len(lines) * len(offsets), 3), np.float32)
    _direct(np.ascontiguousarray(lines), np.ascontiguousarray(offsets), camera.rotation, found)
    return found


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def _direct(lines, offsets, rotation, out):
    """Fills the unit directions of `directions_of`."""
    for i in range(len(lines)):
        for k in range(len(offsets)):
            x, y = lines[i, 0] + offsets[k, 0], lines[i, 1] + offsets[k, 1]
            length = math.sqrt(x * x + y * y + 1.0)
            for c in range(3):
                turned = x * rotation[0, c] + y * rotation[1, c] + rotation[2, c]
                out[i * len(offsets) + k, c] = turned / length


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def _see_all(origins, directions, room, out):
    """Colours [rays, 3] of the room without glasses, from one origin or one for each ray."""
    one, last = np.ones(3), len(origins) - 1
    for k in range(len(directions)):
        o = origins[min(k, last)]
        see(room, o[0], o[1], o[2], directions[k, 0], directions[k, 1], directions[k, 2], 1.0, one, out[k])
