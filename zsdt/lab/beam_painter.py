"""Paints a foam beam as a camera would see it, from the places of its surface nodes alone, with exact masks.

The texture lives in material coordinates: every pixel of the beam is looked up on the undeformed face (inverse
mapping), so that what a tracker follows moves as the material does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import scipy.interpolate
from jaxtyping import Float, UInt8

from zsdt.lab.backdrop import paint_backdrop
from zsdt.lab.foam_texture import MARGIN, FaceTexture, face_texture, plain_texture, value_noise
from zsdt.lab.raster import OUTSIDE, bounding_box, surface_map
from zsdt.lab.styles import Style
from zsdt.perception.camera import Camera, ClampSide

Face = Float[np.ndarray, "columns rows 3"]
REFINE = 3  # cells of the painted lattice per cell of the node grid, along each axis
BLUR_STEP = 0.8  # px that a node may move between two sub-frames of an exposure
MAX_SUBFRAMES = 6


@dataclass(frozen=True)
class Painted:
    """A painted picture: image (BGR), cover of the grid lines and of the visible face (0 to 255, without noise)."""

    image: UInt8[np.ndarray, "height width 3"]
    grid_mask: UInt8[np.ndarray, "height width"]
    beam_mask: UInt8[np.ndarray, "height width"]


def spline_matrix(nodes: int, places: Float[np.ndarray, " places"]) -> Float[np.ndarray, "places nodes"]:
    """Matrix that evaluates the natural cubic spline through values at 0, 1, .. nodes - 1 at `places`."""
    if nodes == 2:
        return np.column_stack([1.0 - places, places])
    spline = scipy.interpolate.CubicSpline(np.arange(nodes), np.eye(nodes), bc_type="natural")
    inside = np.clip(places, 0, nodes - 1)
    # Beyond the ends it goes on along its tangent.
    return spline(inside) + (places - inside)[:, None] * spline(inside, 1)


class BeamPainter:
    """One beam in front of one camera in one style.

    columns, rows: nodes of the visible face (column 0 at the clamp, row 0 at the bottom), pitch [m] of its grid,
    beam_width [m] into the picture. `detail`: texture pixels per picture pixel.
    """

    def __init__(
        self,
        style: Style,
        camera: Camera,
        *,
        columns: int,
        rows: int,
        pitch: float,
        beam_width: float,
        clamp_side: ClampSide,
        detail: float = 1.25,
    ):
        self.style, self.camera, self.pitch, self.beam_width = style, camera, pitch, beam_width
        self.columns, self.rows, self.side = columns, rows, ClampSide(clamp_side)
        self.long, self.high = (columns - 1) * pitch, (rows - 1) * pitch
        self._front_y = 0.0 if self.side is ClampSide.left else beam_width
        distance = float(camera.depths(np.array([[0.5 * self.long, self._front_y, 0.5 * self.high]]))[0])
        scale = max(round(pitch * detail * camera.matrix[0, 0] / distance), 8) / pitch  # crossings on texture pixels
        rng = np.random.default_rng([style.seed, 2])
        self._texture = face_texture(rng, style, columns, rows, pitch, scale)
        self._plain = plain_texture(rng, style, self.long, max(self.beam_width, self.high), scale)
        reach = (MARGIN - 1.0) / (scale * pitch)  # the lattice goes on a little over the transparent margin
        self._u = np.concatenate(
            [[-reach], np.linspace(0, columns - 1, REFINE * (columns - 1) + 1), [columns - 1 + reach]]
        )
        self._v = np.concatenate([[-reach], np.linspace(0, rows - 1, REFINE * (rows - 1) + 1), [rows - 1 + reach]])
        self._along, self._up = spline_matrix(columns, self._u), spline_matrix(rows, self._v)
        self._lamp = camera.rotation.T @ style.light  # direction to the lamp in the world
        size = (camera.width, camera.height)
        self._light = _light_field(rng, style, *size)
        self._noise = style.noise * rng.standard_normal((size[1] + 24, size[0] + 24, 3), dtype=np.float32)

    @cached_property
    def _scenery(self) -> Float[np.ndarray, "height width 3"]:
        """Backdrop and clamp, lit and blurred: everything that stands still."""
        picture = paint_backdrop(self.style, self.camera.width, self.camera.height)
        self._paint_clamp(picture)
        return cv2.GaussianBlur(picture * self._light, (0, 0), self.style.blur)

    # ---- a frame ----------------------------------------------------------------------------------------------

    def paint(
        self,
        faces: Sequence[tuple[Face, Face]],
        *,
        exposure: float = 1.0,
        shake: Float[np.ndarray, "3"] | None = None,
        noise_seed: int = 0,
    ) -> Painted:
        """A picture of the beam.

        faces: (visible face, far face) [columns, rows, 3] m at one or more moments of the exposure; more than one
        give motion blur. exposure: factor on brightness. shake [3] rad: small rotation of the camera in this frame.
        """
        camera = shaken(self.camera, shake)
        picture = self._backdrop(camera)
        outline = np.concatenate([face.reshape(-1, 3) for pair in faces for face in pair])
        box = bounding_box(camera.project(outline), (camera.width, camera.height), 8)
        part = np.s_[box[1] : box[3], box[0] : box[2]]
        grid_mask = np.zeros(picture.shape[:2], np.uint8)
        beam_mask = np.zeros_like(grid_mask)
        middle = faces[len(faces) // 2]
        if box[2] > box[0] and box[3] > box[1]:
            self._cast_shadow(picture, camera, middle[0])
            layers = [self._layer(picture[part], camera, face, far, box) for face, far in faces]
            colour, lines, cover = (np.mean(parts, axis=0) for parts in zip(*layers, strict=True))
            grid_mask[part], beam_mask[part] = np.rint(lines), np.rint(cover)
            picture[part] = cv2.GaussianBlur(colour, (0, 0), self.style.blur) if self.style.blur > 0.2 else colour
        return Painted(self._expose(picture, exposure, noise_seed), grid_mask, beam_mask)

    def node_pixels(
        self, face: Face, shake: Float[np.ndarray, "3"] | None = None
    ) -> Float[np.ndarray, "columns rows 2"]:
        """Exact pixels of the nodes of a face."""
        return shaken(self.camera, shake).project(face.reshape(-1, 3)).reshape(self.columns, self.rows, 2)

    def depth_map(
        self, face: Face, far: Face, shake: Float[np.ndarray, "3"] | None = None
    ) -> Float[np.ndarray, "height width"]:
        """Depth [m] along the optical axis of the beam and the wall behind it, as a perfect depth camera sees them."""
        camera = shaken(self.camera, shake)
        depth = self._wall_depth.copy()
        lattices = [lattice for lattice, _ in self._sides(face, far)]
        front = np.einsum("ac,crk,br->abk", self._along[1:-1], face, self._up[1:-1])
        for lattice in [*lattices, front if self.side is ClampSide.left else front[::-1]]:
            flat = lattice.reshape(-1, 3)
            pixels = camera.project(flat).reshape((*lattice.shape[:2], 2))
            box = bounding_box(pixels, (camera.width, camera.height), 2)
            # Over a triangle the inverse of the depth is linear in the picture, not the depth.
            inverse = 1.0 / camera.depths(flat).reshape((*lattice.shape[:2], 1))
            found = surface_map(pixels, inverse, box)
            if found is not None:
                part = depth[box[1] : box[3], box[0] : box[2]]
                hit = found[..., 0] != OUTSIDE
                part[hit] = 1.0 / found[..., 0][hit]
        return depth

    @cached_property
    def _wall_depth(self) -> Float[np.ndarray, "height width"]:
        """Depth of the wall; smooth, so that every eighth pixel is enough."""
        camera, step = self.camera, 8
        u, v = np.arange(0, camera.width + step, step), np.arange(0, camera.height + step, step)
        pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2).astype(np.float64)
        inward = 1.0 if self.side is ClampSide.left else -1.0
        behind = np.array([0.0, self._front_y + inward * (self.beam_width + self.style.wall), 0.0])
        points = camera.on_plane(pixels, behind, np.array([0.0, 1.0, 0.0]))
        coarse = np.nan_to_num(camera.depths(points)).reshape(len(v), len(u)).astype(np.float32)
        x, y = np.meshgrid(np.arange(camera.width, dtype=np.float32), np.arange(camera.height, dtype=np.float32))
        return cv2.remap(coarse, x / step, y / step, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    def _backdrop(self, camera: Camera) -> Float[np.ndarray, "height width 3"]:
        """The scenery as the shaken camera sees it: a rotation moves the picture by a homography."""
        if camera is self.camera:
            return self._scenery.copy()
        turn = camera.rotation @ self.camera.rotation.T
        moved = camera.matrix @ turn @ np.linalg.inv(camera.matrix)
        size = (camera.width, camera.height)
        return cv2.warpPerspective(self._scenery, moved, size, borderMode=cv2.BORDER_REPLICATE)

    def _expose(self, picture: np.ndarray, exposure: float, noise_seed: int) -> UInt8[np.ndarray, "height width 3"]:
        """Exposure, shot and reading noise, and the camera's eight bits. Changes `picture`."""
        rng = np.random.default_rng([self.style.seed, 3, noise_seed])
        y, x = rng.integers(0, 24, 2)
        noise = self._noise[y : y + picture.shape[0], x : x + picture.shape[1]]
        picture *= np.float32(self.style.exposure * exposure)
        # Shot noise grows with the root of brightness; its straight line through mid grey does as well here.
        strength = cv2.addWeighted(picture, 0.5 / 128.0, picture, 0.0, 0.5)
        cv2.multiply(noise, strength, strength)
        cv2.add(picture, strength, picture)
        return np.clip(picture, 0.0, 255.0, out=picture).astype(np.uint8)

    # ---- its parts --------------------------------------------------------------------------------------------

    def _layer(
        self, behind: np.ndarray, camera: Camera, face: Face, far: Face, box: tuple[int, int, int, int]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Colour, cover of lines and of the face in a part of the picture, at one moment."""
        colour = behind.copy()
        light = self._light[box[1] : box[3], box[0] : box[2]]
        for lattice, places in self._sides(face, far):
            self._lay(colour, light, camera, lattice, places, self._plain, box)
        lattice = np.einsum("ac,crk,br->abk", self._along, face, self._up)
        places = np.stack(np.meshgrid(self._u, self._v, indexing="ij"), axis=-1) * self.pitch
        if self.side is ClampSide.right:  # so that (along a) x (along b) points at the camera
            lattice, places = lattice[::-1], places[::-1]
        found = self._lay(colour, light, camera, lattice, places, self._texture, box)
        if found is None:  # the whole face is seen from behind
            nothing = np.zeros(colour.shape[:2], np.float32)
            return colour, nothing, nothing
        cover, u, v = found
        lines = cv2.remap(self._texture.lines, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        return colour, lines * (cover * np.float32(1 / 255)), cover

    def _lay(
        self,
        colour: np.ndarray,
        light: np.ndarray,
        camera: Camera,
        lattice: Float[np.ndarray, "a b 3"],
        places: Float[np.ndarray, "a b 2"],
        texture: FaceTexture,
        box: tuple[int, int, int, int],
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Paints a surface with outward normal (along a) x (along b) over `colour`, a part of the picture.

        Gives back its cover, 0 to 255, and for each pixel the coordinates on the texture; None where nothing of it is
        seen.
        """
        pixels = camera.project(lattice.reshape(-1, 3)).reshape((*lattice.shape[:2], 2))
        attributes = np.concatenate([places * texture.scale + MARGIN, self._lambert(lattice)[..., None]], axis=2)
        found = surface_map(pixels, attributes, box)
        if found is None:
            return None
        u, v, bright = cv2.split(found)
        looked_up = cv2.remap(texture.colour, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        cover = looked_up[..., 3].astype(np.float32)
        bright[bright == OUTSIDE] = 0.0
        paint = cv2.cvtColor(looked_up, cv2.COLOR_BGRA2BGR).astype(np.float32)
        paint *= (bright * light[..., 0])[..., None]
        paint -= colour
        paint *= (cover * np.float32(1 / 255))[..., None]
        colour += paint
        return cover, u, v

    def _lambert(self, lattice: Float[np.ndarray, "a b 3"]) -> Float[np.ndarray, "a b"]:
        """Brightness of a matt surface: light without direction and the lamp's."""
        normal = np.cross(np.gradient(lattice, axis=0), np.gradient(lattice, axis=1))
        length = np.maximum(np.linalg.norm(normal, axis=2), 1e-12)
        facing = np.maximum((normal @ self._lamp) / length, 0.0)
        return self.style.ambient + (1.0 - self.style.ambient) * 1.35 * facing

    def _sides(self, face: Face, far: Face) -> list[tuple[np.ndarray, np.ndarray]]:
        """Top, bottom and tip as lattices [a, 3, 3] with the places of their points on the plain texture [m]."""
        across = np.linspace(0.0, self.beam_width, 3)
        result = []
        for near, back, outline, places, turned in (
            (face[:, -1], far[:, -1], self._along[1:-1], self._u[1:-1], False),
            (face[:, 0], far[:, 0], self._along[1:-1], self._u[1:-1], True),
            (face[-1], far[-1], self._up[1:-1], self._v[1:-1], True),
        ):
            edge, rear = outline @ near, outline @ back
            lattice = np.stack([edge, 0.5 * (edge + rear), rear], axis=1)
            # The far face is away from the camera for either clamp side, so the sense of the normal only depends on
            # which way the first axis runs in the picture.
            if turned != (self.side is ClampSide.right):
                lattice, places = lattice[::-1], places[::-1]
            on = np.stack(np.meshgrid(places * self.pitch, across, indexing="ij"), axis=-1)
            result.append((lattice, on))
        return result

    def _cast_shadow(self, picture: np.ndarray, camera: Camera, face: Face) -> None:
        """The soft shadow of the beam on the wall behind it."""
        inward = 1.0 if self.side is ClampSide.left else -1.0
        ring = np.concatenate([face[:, 0], face[-1, 1:], face[::-1, -1][1:], face[0, ::-1][1:]])
        behind = self._front_y + inward * (self.beam_width + self.style.wall)
        toward = -self._lamp * inward
        if toward[1] < 0.2:
            return
        fallen = ring - self._lamp * (((behind - ring[:, 1]) / -self._lamp[1])[:, None])
        pixels = camera.project(fallen)
        if not np.isfinite(pixels).all():
            return
        small: np.ndarray = np.ones((-(-camera.height // 4), -(-camera.width // 4)), np.float32)
        cv2.fillPoly(
            small,
            [np.round(np.clip(pixels, -1e4, 1e4) / 4.0).astype(np.int32)],
            1.0 - 0.5 * (1.0 - self.style.ambient) - 0.15,
        )
        shadow = cv2.resize(cv2.blur(small, (9, 9)) - 1.0, (camera.width, camera.height))
        shadow *= self._wall  # the clamp stands before the wall
        picture *= (shadow + 1.0)[..., None]

    @cached_property
    def _wall(self) -> Float[np.ndarray, "height width"]:
        """1 where the wall is seen, 0 on the clamp."""
        seen: np.ndarray = np.ones((self.camera.height, self.camera.width), np.float32)
        for pixels, _ in self._clamp_faces():
            cv2.fillPoly(seen, [np.round(pixels * 16).astype(np.int32)], 0.0, cv2.LINE_AA, 4)
        return seen

    def _paint_clamp(self, picture: np.ndarray) -> None:
        """A block that holds the beam."""
        for pixels, colour in self._clamp_faces():
            corners = [np.round(pixels * 16).astype(np.int32)]
            cv2.fillPoly(picture, corners, tuple(float(c) for c in colour), cv2.LINE_AA, 4)

    def _clamp_faces(self) -> list[tuple[Float[np.ndarray, "4 2"], Float[np.ndarray, "3"]]]:
        """Corners [px] and colour of those faces of the clamp that the camera sees, the front last."""
        above, below, outward, forward = self.style.clamp_reach
        sign = -1.0 if self.side is ClampSide.left else 1.0  # towards the camera
        near, rear = self._front_y + sign * forward, self._front_y - sign * (self.beam_width + forward)
        low, high = -below, self.high + above
        corner = {
            (a, b, c): np.array([x, y, z])
            for a, x in enumerate((-outward, 0.0))
            for b, y in enumerate((near, rear))
            for c, z in enumerate((low, high))
        }
        rings = {
            "top": ([(0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)], 1.15),
            "bottom": ([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], 0.6),
            "cheek": ([(1, 0, 0), (1, 0, 1), (1, 1, 1), (1, 1, 0)], 0.75),
            "back": ([(0, 0, 0), (0, 0, 1), (0, 1, 1), (0, 1, 0)], 0.7),
            "front": ([(0, 0, 0), (1, 0, 0), (1, 0, 1), (0, 0, 1)], 1.0),
        }
        middle = np.mean(list(corner.values()), axis=0)
        faces = []
        for ring, bright in rings.values():
            points = np.stack([corner[key] for key in ring])
            out = points.mean(axis=0) - middle
            if (self.camera.center - points.mean(axis=0)) @ out <= 0:  # an axis-aligned box: out is along its normal
                continue
            pixels = np.clip(self.camera.project(points), -4e3, 8e3)
            faces.append((pixels, np.minimum(bright * self.style.clamp, 255.0)))
        return faces


def subframes(motion_px: float) -> int:
    """Moments per exposure for a largest motion [px] of a node during it."""
    return int(np.clip(np.ceil(motion_px / BLUR_STEP), 1, MAX_SUBFRAMES))


def shaken(camera: Camera, shake: Float[np.ndarray, "3"] | None) -> Camera:
    """The camera turned about itself by a small rotation vector [rad]; its place stays."""
    if shake is None or not np.any(shake):
        return camera
    turn = cv2.Rodrigues(np.asarray(shake, np.float64))[0]
    return replace(camera, rotation=turn @ camera.rotation, translation=turn @ camera.translation)


def _light_field(
    rng: np.random.Generator, style: Style, width: int, height: int
) -> Float[np.ndarray, "height width 1"]:
    """Brightness over the picture: a gradient and perhaps a soft shadow of something outside of it."""
    x, y = np.meshgrid(np.linspace(-1, 1, width, dtype=np.float32), np.linspace(-1, 1, height, dtype=np.float32))
    light = 1.0 + np.float32(style.gradient[0]) * x + np.float32(style.gradient[1]) * y
    light *= 1.0 + 0.02 * value_noise(rng, height, width, (2, 4))
    if style.shade > 0:
        mask: np.ndarray = np.zeros((height // 4, width // 4), np.float32)
        corners = rng.uniform(0, 1, (4, 2)) * [width // 4, height // 4]
        cv2.fillConvexPoly(mask, cv2.convexHull(np.round(corners).astype(np.int32)), 1.0)
        mask = cv2.GaussianBlur(mask, (0, 0), rng.uniform(2.0, 8.0))
        light *= 1.0 - np.float32(style.shade) * cv2.resize(mask, (width, height))
    return np.maximum(light, 0.15)[..., None]
