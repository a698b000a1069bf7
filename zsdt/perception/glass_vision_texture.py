"""Strange patterns laid over a labelled glass and what is behind it, so that no backdrop is learned by heart.

A pattern of random grain, veins, stripes or checks multiplies the picture. Behind liquid it is looked up mirrored and
enlarged, as a vessel full of liquid shows what is behind it (a cylindrical lens), behind empty glass pushed together
towards the rims: crude optics, but the pattern breaks where real backdrops break.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from zsdt.perception.glass_window import box_of


def retextured(
    image: UInt8[np.ndarray, "size size 3"],
    container: UInt8[np.ndarray, "size size"],
    liquid: UInt8[np.ndarray, "size size"],
    rng: np.random.Generator,
) -> UInt8[np.ndarray, "size size 3"]:
    """The window with a random pattern over it; masks stay."""
    size = len(container)
    pattern = _pattern(size // 2, rng)
    across, down = _lookup(container, liquid, rng)
    seen = cv2.remap(pattern, 0.5 * across, 0.5 * down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    colour = rng.uniform(0.3, 1.0, 3) * rng.choice([-1, 1], 3, p=[0.2, 0.8])
    strength = rng.uniform(0.05, 0.45)
    # The factor at 256 levels of the pattern, looked up.
    level = np.rint(np.clip(seen * 51 + 127.5, 0, 255)).astype(np.uint8)
    curve = np.exp(strength * ((np.arange(256) - 127.5) / 51)[:, None] * colour).astype(np.float32)
    factor = cv2.LUT(cv2.merge([level] * 3), curve[None])
    return np.asarray(cv2.multiply(image, factor, dtype=cv2.CV_8U), np.uint8)


def _pattern(size: int, rng: np.random.Generator) -> Float[np.ndarray, "size size"]:
    """Random grey levels of mean 0 and deviation 1."""
    total = np.zeros((size, size), np.float32)
    stretch = np.exp(rng.uniform(-1.8, 1.8)) if rng.random() < 0.6 else 1.0
    flat = cv2.INTER_NEAREST if rng.random() < 0.3 else cv2.INTER_CUBIC
    for cells in np.exp(rng.uniform(np.log(2), np.log(60), int(rng.integers(1, 4)))):
        rows, columns = (int(np.clip(cells * s, 2, size)) for s in (stretch, 1 / stretch))
        grain = rng.standard_normal((rows, columns), dtype=np.float32)
        total += cv2.resize(grain, (size, size), interpolation=flat) * np.float32(rng.uniform(0.3, 1) / cells**0.3)
    kind = rng.random()
    if kind < 0.25:  # veins: narrow lines where the grain passes levels
        total = np.exp(-(np.sin(total * rng.uniform(2, 8)) ** 2) * rng.uniform(4, 40)).astype(np.float32)
    elif kind < 0.5:  # patches with sharp borders
        total = np.sign(total - np.float32(rng.normal(0, 0.5) * total.std())).astype(np.float32)
    if rng.random() < 0.25:  # a lattice
        v, u = np.mgrid[:size, :size].astype(np.float32) / size
        turn, count = rng.uniform(0, np.pi), rng.uniform(3, 25)
        along = np.cos(turn) * u + np.sin(turn) * v
        across = np.cos(turn) * v - np.sin(turn) * u
        total += np.where(np.minimum(along * count % 1, across * count % 1) < rng.uniform(0.05, 0.2), 1.5, 0)
    return (total - total.mean()) / max(float(total.std()), 1e-6)


def _lookup(
    container: UInt8[np.ndarray, "size size"], liquid: UInt8[np.ndarray, "size size"], rng: np.random.Generator
) -> tuple[Float[np.ndarray, "size size"], Float[np.ndarray, "size size"]]:
    """Columns and rows at which each pixel sees the pattern."""
    size = len(container)
    v, u = np.mgrid[:size, :size].astype(np.float32)
    box = box_of(container > 127)
    if box is None:
        return u, v
    middle, half = box.middle[0], max(1.0, 0.5 * (box.right - box.left))
    off = (u - np.float32(middle)) / np.float32(half)
    rim = off + np.sign(off) * np.float32(rng.uniform(0.05, 0.5)) * np.clip(np.abs(off), 0, 1.2) ** 6
    lens = -np.float32(rng.uniform(0.8, 2.2)) * off * (1 + np.float32(rng.uniform(0, 0.8)) * off**4)
    turned = np.where(liquid > 127, lens, np.where(container > 127, rim, off))
    lift = np.where(liquid > 127, np.float32(rng.uniform(-0.2, 0.2) * size) * off**2, np.float32(0))
    return turned.clip(-8, 8) * np.float32(half) + np.float32(middle), v + lift
