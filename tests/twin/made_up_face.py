"""A bent face in front of a made-up picture: enough of a beam to draw on."""

import cv2
import numpy as np

COLUMNS, ROWS = 13, 4


def bent_face(drop=0.18, columns=COLUMNS, rows=ROWS, pitch=52.0, left=110.0, middle=235.0):
    """Pixels [columns, rows, 2] of a cantilever clamped at the left, whose tip hangs `drop` of its length lower."""
    x = np.arange(columns, dtype=float) / (columns - 1)
    sag = drop * (1.5 * x**2 - 0.5 * x**3)
    slope = np.arctan(drop * (3.0 * x - 1.5 * x**2))
    length = pitch * (columns - 1)
    up = (np.arange(rows) - (rows - 1) / 2) * pitch
    u = left + length * x[:, None] + up * np.sin(slope)[:, None] - 0.3 * length * (drop * x[:, None]) ** 2
    v = middle + length * sag[:, None] - up * np.cos(slope)[:, None]
    return np.stack([u, v], axis=2)


def bending_stress(columns=COLUMNS, rows=ROWS, top=3.2e3):
    """Von Mises stress [Pa] on the face: most at the clamp and away from the neutral line."""
    x = np.arange(columns) / (columns - 1)
    z = np.linspace(-1.0, 1.0, rows)
    return top * np.hypot((1.0 - x[:, None]) ** 2 * z, 0.08 * np.ones((columns, rows)))


def picture(pixels, height=540, width=960, seed=0):
    """Foam with a painted grid in front of a plain wall, lit from the left [height, width, 3] BGR."""
    random = np.random.default_rng(seed)
    image = np.empty((height, width, 3), np.float32)
    image[...] = (150, 142, 132)
    image *= np.linspace(1.1, 0.75, width, dtype=np.float32)[None, :, None]
    rim = np.concatenate([pixels[:, 0], pixels[-1, 1:], pixels[-2::-1, -1], pixels[0, -2::-1]])
    outline = np.rint(rim * 16).astype(np.int32)
    shadow = np.zeros((height, width), np.float32)
    cv2.fillPoly(shadow, [outline + 16 * np.array([10, 22], np.int32)], 1.0, cv2.LINE_AA, 4)
    image *= 1.0 - 0.35 * cv2.blur(shadow, (31, 31))[..., None]
    foam = cv2.GaussianBlur(random.normal(size=(height, width)).astype(np.float32), (0, 0), 1.6)
    body = np.zeros((height, width), np.float32)
    cv2.fillPoly(body, [outline], 1.0, cv2.LINE_AA, 4)
    coloured = np.float32([172, 188, 196]) * (1.0 + 0.45 * foam[..., None])
    image += body[..., None] * (coloured - image)
    lines = [*pixels, *pixels.transpose(1, 0, 2)]
    image = np.clip(image, 0, 255).astype(np.uint8)
    cv2.polylines(
        image, [np.rint(16 * line).astype(np.int32) for line in lines], False, (45, 40, 38), 4, cv2.LINE_AA, 4
    )
    block = [(0, 120), (int(pixels[0, 0, 0]) - 2, 120), (int(pixels[0, 0, 0]) - 2, 350), (0, 350)]
    cv2.fillPoly(image, [np.array(block, np.int32)], (62, 58, 55), cv2.LINE_AA)
    noise = random.normal(scale=3.0, size=image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)
