"""What stands around a glass: the picture behind it, the table under it, and the light of all the rest."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from zsdt.errors import OptionError
from zsdt.lab.backdrop import BACKDROPS, CLUTTER, muted_tone
from zsdt.lab.foam_texture import value_noise
from zsdt.lab.glass_rays import SOFT, Room
from zsdt.lab.glass_styles import GlassStyle
from zsdt.lab.glass_view import Glass, outer_profile

BACKDROP_PX, TABLE_PX = (960, 540), (900, 900)  # width, height of the pictures
Picture = np.ndarray  # [height, width, 3] float32 while it is painted


def backdrop_texture(style: GlassStyle) -> UInt8[np.ndarray, "height width 3"]:
    """The upright picture behind the glass, BGR: `style.backdrop_width` metres wide, its last row on the table."""
    rng = np.random.default_rng([style.seed, 1])
    picture = _kinds(BACKDROPS, OWN_BACKDROPS, style.backdrop)(rng, *BACKDROP_PX)
    for _ in range(style.pieces):
        canvas = np.clip(picture, 0, 255).astype(np.uint8)
        _kinds(CLUTTER, OWN_CLUTTER, str(rng.choice(style.clutter)))(rng, canvas)
        picture = canvas.astype(np.float32)
    picture = cv2.GaussianBlur(picture, (0, 0), rng.uniform(0.6, 3.5))  # out of focus behind the glass
    return np.clip(picture, 0, 255).astype(np.uint8)


def table_texture(style: GlassStyle) -> UInt8[np.ndarray, "height width 3"]:
    """The table from above, BGR: `style.table_size` metres about the origin, its first row at the back."""
    rng = np.random.default_rng([style.seed, 2])
    picture = _kinds(BACKDROPS, TABLES, style.table)(rng, *TABLE_PX)
    return np.clip(cv2.GaussianBlur(picture, (0, 0), 0.7), 0, 255).astype(np.uint8)


def environment(style: GlassStyle, directions: Float[np.ndarray, "rays 3"]) -> Float[np.ndarray, "rays 3"]:
    """Colour, BGR as displayed (above 255 in a window), of all that is neither backdrop nor table, by unit
    directions."""
    azimuth = np.arctan2(directions[:, 0], directions[:, 1])
    elevation = np.arcsin(np.clip(directions[:, 2], -1.0, 1.0))
    light = np.zeros(len(directions))
    for middle, height, half_width, half_height, brightness in style.windows:
        turn = np.abs(azimuth - middle)
        turn = np.minimum(turn, 2.0 * np.pi - turn)
        inside = np.minimum(half_width - turn, half_height - np.abs(elevation - height))
        light += brightness * np.clip(0.5 + inside / SOFT, 0.0, 1.0)
    return style.ambient * (0.75 + 0.25 * directions[:, 2:]) + light[:, None]


def room_of(style: GlassStyle, glasses: Sequence[Glass] = ()) -> Room:
    """The surroundings of glasses as arrays. Its pictures take a while: keep it and use `with_feet`."""
    backdrop, table = backdrop_texture(style), table_texture(style)
    room = Room(
        backdrop=backdrop,
        table=table,
        backdrop_scale=backdrop.shape[1] / style.backdrop_width,
        table_scale=table.shape[1] / style.table_size[0],
        distance=style.distance,
        ambient=np.asarray(style.ambient, np.float64),
        windows=np.asarray(style.windows, np.float64),
        shadow=style.shadow,
        feet=np.zeros((0, 3)),
        liquid_tint=np.asarray(style.liquid_tint, np.float64),
        glass_tint=np.asarray(style.glass_tint, np.float64),
    )
    return with_feet(room, glasses)


def with_feet(room: Room, glasses: Sequence[Glass]) -> Room:
    """The room with the soft shadows of these glasses."""
    feet = [[*g.origin[:2], outer_profile(g.vessel, g.wall, g.floor)[1][0]] for g in glasses]
    return room._replace(feet=np.array(feet, np.float64).reshape(-1, 3))


def light_of(style: GlassStyle, width: int, height: int) -> Float[np.ndarray, "height width 1"]:
    """Brightness over the picture: a gradient."""
    x, y = np.meshgrid(np.linspace(-1, 1, width), np.linspace(-1, 1, height))
    return np.maximum(1.0 + style.gradient[0] * x + style.gradient[1] * y, 0.15)[..., None]


def _kinds(known: dict[str, Callable], own: dict[str, Callable], name: str) -> Callable:
    """The painter of a kind. Raises: OptionError where there is none of the name."""
    found = own.get(name) or known.get(name)
    if found is None:
        raise OptionError(f"There is no scenery of the kind '{name}'; choose among {', '.join({**known, **own})}.")
    return found


def _bright(rng: np.random.Generator) -> tuple[float, ...]:
    return tuple(float(c) for c in rng.uniform(15, 235, 3))


def _books(rng: np.random.Generator, width: int, height: int) -> Picture:
    picture = np.broadcast_to(muted_tone(rng, 20.0, 80.0), (height, width, 3)).copy()
    shelf = int(rng.integers(170, 260))
    for bottom in range(height, 0, -shelf):
        left = 0
        while left < width:
            wide, high = int(rng.integers(16, 60)), int(rng.uniform(0.6, 0.9) * shelf)
            spine = _bright(rng)
            cv2.rectangle(picture, (left, bottom - high), (left + wide - 3, bottom - 8), spine, -1)
            band = bottom - int(rng.uniform(0.3, 0.9) * high)
            cv2.rectangle(picture, (left + 2, band), (left + wide - 5, band + high // 12), _bright(rng), -1)
            left += wide
        cv2.rectangle(picture, (0, bottom - 8), (width, bottom), (60.0, 90.0, 120.0), -1)
    return picture


def _checks(rng: np.random.Generator, width: int, height: int) -> Picture:
    size = int(rng.integers(30, 110))
    y, x = np.mgrid[:height, :width] // size
    colours = np.stack([muted_tone(rng), muted_tone(rng)])
    return colours[(y + x) % 2] * (1.0 + 0.03 * value_noise(rng, height, width, (40,)))[..., None]


def _shelves(rng: np.random.Generator, width: int, height: int) -> Picture:
    picture = np.broadcast_to(muted_tone(rng, 90.0, 220.0), (height, width, 3)).copy()
    step = int(rng.integers(130, 240))
    board = tuple(float(c) for c in muted_tone(rng, 50.0, 200.0))
    for bottom in range(height, 0, -step):
        for _ in range(int(rng.integers(3, 9))):
            middle, wide = int(rng.integers(0, width)), int(rng.integers(20, 90))
            high = int(rng.uniform(0.3, 0.85) * step)
            cv2.rectangle(picture, (middle - wide // 2, bottom - high), (middle + wide // 2, bottom), _bright(rng), -1)
            if rng.random() < 0.5:
                cv2.ellipse(picture, (middle, bottom - high), (wide // 2, wide // 5), 0, 0, 360, _bright(rng), -1)
        cv2.rectangle(picture, (0, bottom - 12), (width, bottom), board, -1)
    return picture


def _cloth(rng: np.random.Generator, width: int, height: int) -> Picture:
    """A chequered tablecloth: two sets of stripes that darken each other."""
    picture = np.full((height, width, 3), 225.0, np.float32) * (muted_tone(rng, 200.0, 240.0) / 225.0)
    step = int(rng.integers(24, 70))
    ink = (muted_tone(rng, 40.0, 160.0) / 255.0) ** 0.5
    columns, rows = (np.arange(width) // step) % 2 == 0, (np.arange(height) // step) % 2 == 0
    picture[:, columns] *= ink
    picture[rows] *= ink
    return picture * (1.0 + 0.03 * value_noise(rng, height, width, (200,)))[..., None]


def _marble(rng: np.random.Generator, width: int, height: int) -> Picture:
    vein = np.abs(value_noise(rng, height, width, (4, 9, 18, 40)))
    light = muted_tone(rng, 150.0, 235.0) * np.ones((height, width, 1), np.float32)
    return light * (1.0 - 0.35 * np.exp(-((vein / 0.12) ** 2)))[..., None]


def _steel(rng: np.random.Generator, width: int, height: int) -> Picture:
    grain = cv2.GaussianBlur(rng.standard_normal((height, width)).astype(np.float32), (0, 0), 20.0, sigmaY=0.6)
    return muted_tone(rng, 100.0, 190.0) * (1.0 + 0.5 * grain)[..., None]


def _velvet(rng: np.random.Generator, width: int, height: int) -> Picture:
    """Dark cloth, as it hangs behind glassware that is photographed."""
    return muted_tone(rng, 14.0, 40.0) * (1.0 + 0.2 * value_noise(rng, height, width, (3, 60, 180)))[..., None]


def _standing(rng: np.random.Generator, canvas: np.ndarray, profile: np.ndarray, see_through: bool) -> None:
    """Something round and upright on the table: profile [points, 2] of (height, half width) as shares of its height."""
    height, width = canvas.shape[:2]
    high, middle = rng.uniform(0.2, 0.6) * height, rng.uniform(0.1, 0.9) * width
    half = profile[:, 1] * high
    left, right = int(max(middle - half.max() - 2, 0)), int(min(middle + half.max() + 3, width))
    top = int(height - high - 2)
    part = canvas[top:, left:right]
    sides = [np.column_stack([middle + s * half - left, height - top - profile[:, 0] * high]) for s in (-1.0, 1.0)]
    mask: np.ndarray = np.zeros(part.shape[:2], np.float32)
    cv2.fillPoly(mask, [np.round(np.concatenate([sides[0], sides[1][::-1]])).astype(np.int32)], 1.0)
    x = (np.arange(left, right) - middle) / half.max()
    round_off = np.sqrt(np.clip(1.0 - x**2, 0.05, 1.0))
    shine = np.exp(-(((x + 0.45) / 0.08) ** 2))
    paint = np.array(_bright(rng)) * (0.4 + 0.6 * round_off)[:, None] + 110.0 * shine[:, None]
    cover = mask[..., None] * (rng.uniform(0.35, 0.7) if see_through else 1.0)
    part[:] = np.clip(part * (1.0 - cover) + cover * paint, 0, 255).astype(np.uint8)


def _bottles(rng: np.random.Generator, canvas: UInt8[np.ndarray, "height width 3"]) -> None:
    neck = rng.uniform(0.35, 0.6)
    profile = [[0, 1], [0.6, 1], [0.75, 0.9], [0.82, neck], [1.0, neck]]
    shape = np.array(profile) * [1.0, rng.uniform(0.11, 0.17)]
    _standing(rng, canvas, shape, bool(rng.random() < 0.7))


def _cans(rng: np.random.Generator, canvas: UInt8[np.ndarray, "height width 3"]) -> None:
    profile = np.array([[0, 0.9], [0.05, 1], [0.9, 1], [1.0, rng.uniform(0.8, 1.1)]]) * [1.0, rng.uniform(0.2, 0.35)]
    _standing(rng, canvas, profile, bool(rng.random() < 0.3))


OWN_BACKDROPS: dict[str, Callable[[np.random.Generator, int, int], Picture]] = {
    "books": _books,
    "checks": _checks,
    "shelves": _shelves,
    "velvet": _velvet,
}
TABLES: dict[str, Callable[[np.random.Generator, int, int], Picture]] = {
    "cloth": _cloth,
    "velvet": _velvet,
    "marble": _marble,
    "steel": _steel,
}
OWN_CLUTTER: dict[str, Callable[[np.random.Generator, np.ndarray], None]] = {"bottles": _bottles, "cans": _cans}
