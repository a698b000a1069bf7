"""What stands behind the beam: a wall or a curtain, and clutter with grids and writing of its own."""

from __future__ import annotations

import string
from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from zsdt.errors import OptionError
from zsdt.lab.foam_texture import value_noise
from zsdt.lab.styles import Style

Picture = np.ndarray  # [height, width, 3] float32 while it is painted
FONTS = {
    "capitals": (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_PLAIN),
    "sentence": (cv2.FONT_HERSHEY_COMPLEX, cv2.FONT_HERSHEY_SCRIPT_SIMPLEX, cv2.FONT_HERSHEY_TRIPLEX),
}


def paint_backdrop(style: Style, width: int, height: int) -> Float[np.ndarray, "height width 3"]:
    """The empty scene of a style: float32, brightness 0 to 255, without light and noise."""
    rng = np.random.default_rng([style.seed, 1])
    picture = BACKDROPS[style.backdrop](rng, width, height)
    for _ in range(style.pieces):
        kind = str(rng.choice(style.clutter))
        if kind not in CLUTTER:
            raise OptionError(f"There is no clutter of the kind '{kind}'; choose among {', '.join(CLUTTER)}.")
        canvas = np.clip(picture, 0, 255).astype(np.uint8)
        CLUTTER[kind](rng, canvas)
        picture = canvas.astype(np.float32)
    return cv2.GaussianBlur(picture, (0, 0), rng.uniform(0.5, 2.5))


def muted_tone(rng: np.random.Generator, low: float = 40.0, high: float = 215.0) -> Float[np.ndarray, "3"]:
    """A muted colour: grey with a cast."""
    return np.clip(rng.uniform(low, high) + rng.normal(0.0, 16.0, 3), 8.0, 250.0).astype(np.float32)


def _plaster(rng: np.random.Generator, width: int, height: int) -> Picture:
    grain = 0.07 * value_noise(rng, height, width, (4, 9)) + 0.05 * value_noise(rng, height, width, (60, 130))
    return muted_tone(rng) * (1.0 + grain)[..., None]


def _gradient(rng: np.random.Generator, width: int, height: int) -> Picture:
    x, y = np.meshgrid(np.linspace(0, 1, width, dtype=np.float32), np.linspace(0, 1, height, dtype=np.float32))
    turn = rng.uniform(0, 2 * np.pi)
    part = np.clip(0.5 + (x - 0.5) * np.cos(turn) + (y - 0.5) * np.sin(turn), 0, 1)[..., None].astype(np.float32)
    return muted_tone(rng) * (1 - part) + muted_tone(rng) * part


def _planks(rng: np.random.Generator, width: int, height: int) -> Picture:
    tone = np.array([70, 110, 160], np.float32) * np.float32(rng.uniform(0.5, 1.3))
    grain = cv2.resize(value_noise(rng, height, max(width // 24, 8), (40, 80)), (width, height))
    picture = tone * (1.0 + 0.12 * grain)[..., None]
    step = int(rng.integers(50, 130))
    for top in range(0, height, step):
        picture[top : top + step] *= np.float32(rng.uniform(0.8, 1.15))
        picture[top : top + 3] *= np.float32(0.45)
    return picture


def _tiles(rng: np.random.Generator, width: int, height: int) -> Picture:
    picture = np.broadcast_to(muted_tone(rng), (height, width, 3)).copy()
    step, joint = int(rng.integers(45, 140)), int(rng.integers(2, 6))
    first, second = rng.integers(0, step, 2)
    dark = np.float32(rng.uniform(0.5, 0.8))
    for k in range(joint):
        picture[(first + k) % step :: step] *= dark
        picture[:, (second + k) % step :: step] *= dark
    return picture * (1.0 + 0.04 * value_noise(rng, height, width, (6, 12)))[..., None]


def _bricks(rng: np.random.Generator, width: int, height: int) -> Picture:
    picture = np.broadcast_to(muted_tone(rng, 130.0, 200.0), (height, width, 3)).copy()
    high, joint = int(rng.integers(26, 60)), int(rng.integers(3, 7))
    long = int(2.3 * high)
    tone = np.array([60, 75, 150], np.float32) * np.float32(rng.uniform(0.6, 1.3))
    for row, top in enumerate(range(0, height, high)):
        for left in range(-long + (row % 2) * long // 2, width, long):
            picture[top + joint : top + high, max(left + joint, 0) : max(left + long, 0)] = tone * rng.uniform(
                0.75, 1.2
            )
    return picture * (1.0 + 0.06 * value_noise(rng, height, width, (30, 70)))[..., None]


def _curtain(rng: np.random.Generator, width: int, height: int) -> Picture:
    x = np.linspace(0, 1, width, dtype=np.float32)
    fold = sum(np.sin(2 * np.pi * (rng.uniform(3, 25) * x + rng.random())) / (k + 1) for k in range(4))
    picture = np.broadcast_to(muted_tone(rng, 60.0, 190.0) * (1.0 + 0.18 * fold)[:, None], (height, width, 3))
    return np.asarray(picture * (1.0 + 0.03 * value_noise(rng, height, width, (90,)))[..., None], np.float32)


def _cork(rng: np.random.Generator, width: int, height: int) -> Picture:
    spots = value_noise(rng, height, width, (50, 110, 160))
    tone = np.array([75, 125, 175], np.float32) * np.float32(rng.uniform(0.7, 1.2))
    return tone * (1.0 + 0.13 * spots - 0.25 * (spots > 1.2))[..., None]


def _place(rng: np.random.Generator, canvas: UInt8[np.ndarray, "height width 3"]) -> np.ndarray:
    return rng.uniform(0, 1, 2) * [canvas.shape[1], canvas.shape[0]]


def _ink(rng: np.random.Generator) -> tuple[float, ...]:
    return tuple(float(c) for c in rng.uniform(10, 240, 3))


def _integers(points: np.ndarray) -> np.ndarray:
    return np.round(points).astype(np.int32)


def _rectangles(rng: np.random.Generator, canvas: np.ndarray) -> None:
    corner = _place(rng, canvas)
    other = corner + rng.uniform(25, 220, 2)
    cv2.rectangle(canvas, tuple(map(int, corner)), tuple(map(int, other)), _ink(rng), -1)


def _discs(rng: np.random.Generator, canvas: np.ndarray) -> None:
    cv2.circle(canvas, tuple(map(int, _place(rng, canvas))), int(rng.uniform(10, 80)), _ink(rng), -1, cv2.LINE_AA)


def _lines(rng: np.random.Generator, canvas: np.ndarray) -> None:
    ends = (tuple(map(int, _place(rng, canvas))), tuple(map(int, _place(rng, canvas))))
    cv2.line(canvas, *ends, _ink(rng), int(rng.integers(1, 9)), cv2.LINE_AA)


def _square_grid(rng: np.random.Generator, canvas: np.ndarray) -> None:
    """A grid of somebody else: squared paper, a shelf, a mesh."""
    corner, step, turn = _place(rng, canvas), rng.uniform(12, 55), rng.normal(0, 0.15)
    columns, rows = rng.integers(3, 9, 2)
    axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]) * step
    ink, thick = _ink(rng), int(rng.integers(1, 5))
    for k in range(columns + 1):
        ends = _integers(np.stack([corner + k * axes[0], corner + k * axes[0] + rows * axes[1]]))
        cv2.line(canvas, tuple(map(int, ends[0])), tuple(map(int, ends[1])), ink, thick, cv2.LINE_AA)
    for k in range(rows + 1):
        ends = _integers(np.stack([corner + k * axes[1], corner + k * axes[1] + columns * axes[0]]))
        cv2.line(canvas, tuple(map(int, ends[0])), tuple(map(int, ends[1])), ink, thick, cv2.LINE_AA)


def _write(rng: np.random.Generator, canvas: np.ndarray, text: str, kind: str) -> None:
    font = FONTS[kind][rng.integers(len(FONTS[kind]))]
    place = tuple(map(int, _place(rng, canvas) - [60, 0]))
    cv2.putText(
        canvas, text, place, font, float(rng.uniform(0.6, 2.2)), _ink(rng), int(rng.integers(1, 4)), cv2.LINE_AA
    )


def _capitals(rng: np.random.Generator, canvas: np.ndarray) -> None:
    _write(rng, canvas, "".join(rng.choice(list(string.ascii_uppercase + string.digits), 7)), "capitals")


def _sentence(rng: np.random.Generator, canvas: np.ndarray) -> None:
    words = ["".join(rng.choice(list(string.ascii_lowercase), int(rng.integers(2, 8)))) for _ in range(4)]
    _write(rng, canvas, " ".join(words) + ".", "sentence")


def _polygons(rng: np.random.Generator, canvas: np.ndarray) -> None:
    count = int(rng.integers(3, 8))
    turn = np.sort(rng.uniform(0, 2 * np.pi, count))
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1) * rng.uniform(20, 110, (count, 1))
    cv2.fillPoly(canvas, [_integers(_place(rng, canvas) + ring)], _ink(rng), cv2.LINE_AA)


def _cables(rng: np.random.Generator, canvas: np.ndarray) -> None:
    a, b, c, d = (_place(rng, canvas) for _ in range(4))
    t = np.linspace(0, 1, 40)[:, None]
    curve = (1 - t) ** 3 * a + 3 * t * (1 - t) ** 2 * b + 3 * t**2 * (1 - t) * c + t**3 * d
    cv2.polylines(canvas, [_integers(curve)], False, _ink(rng), int(rng.integers(2, 9)), cv2.LINE_AA)


def _diamond_lattice(rng: np.random.Generator, canvas: np.ndarray) -> None:
    """A fence: lines at two slopes."""
    center, reach, step = _place(rng, canvas), rng.uniform(60, 170), rng.uniform(14, 50)
    ink, thick, slope = _ink(rng), int(rng.integers(1, 5)), rng.uniform(0.5, 1.6)
    for sign in (-1, 1):
        axis = np.array([1.0, sign * slope]) / np.hypot(1.0, slope)
        across = np.array([-axis[1], axis[0]])
        for k in range(-int(reach / step), int(reach / step) + 1):
            ends = _integers(
                np.stack([center + k * step * across - reach * axis, center + k * step * across + reach * axis])
            )
            cv2.line(canvas, tuple(map(int, ends[0])), tuple(map(int, ends[1])), ink, thick, cv2.LINE_AA)


def _window(rng: np.random.Generator, canvas: np.ndarray) -> None:
    """A bright window with bars."""
    corner = _place(rng, canvas) - 60
    size = rng.uniform(90, 260, 2)
    low, high = tuple(map(int, corner)), tuple(map(int, corner + size))
    cv2.rectangle(canvas, low, high, tuple(float(c) for c in rng.uniform(190, 250, 3)), -1)
    bars, thick, ink = int(rng.integers(2, 5)), int(rng.integers(3, 10)), _ink(rng)
    for k in range(bars + 1):
        x, y = (int(corner[axis] + k * size[axis] / bars) for axis in (0, 1))
        cv2.line(canvas, (x, low[1]), (x, high[1]), ink, thick)
        cv2.line(canvas, (low[0], y), (high[0], y), ink, thick)


BACKDROPS: dict[str, Callable[[np.random.Generator, int, int], Picture]] = {
    "plaster": _plaster,
    "gradient": _gradient,
    "planks": _planks,
    "tiles": _tiles,
    "bricks": _bricks,
    "curtain": _curtain,
    "cork": _cork,
}
CLUTTER: dict[str, Callable[[np.random.Generator, np.ndarray], None]] = {
    "rectangles": _rectangles,
    "discs": _discs,
    "lines": _lines,
    "square_grid": _square_grid,
    "capitals": _capitals,
    "polygons": _polygons,
    "cables": _cables,
    "diamond_lattice": _diamond_lattice,
    "window": _window,
    "sentence": _sentence,
}
