"""Follows one line of sight through glasses: refraction at every surface, mirror images of the room, no chance.

The way of the light that is refracted (or reflected where it must be) is followed to its end; at surfaces that are met
from the air the mirror image of the room is added with Fresnel's share. That is what a physically based camera finds
with many random samples, without its noise and without its finer reflections.
"""

from __future__ import annotations

import math
from typing import NamedTuple, no_type_check

import numpy as np
from numba import njit

from zsdt.lab.glass_solid import (
    AIR,
    BASE,
    FLOOR,
    GLASS,
    INNER,
    LIQUID,
    MOUTH,
    NOTHING,
    OUT,
    SURFACE,
    look_up,
    next_surface,
    normal_at,
)

SURFACES = 6  # within which a line of sight must meet liquid to count as liquid
MOST = 12  # surfaces that are followed
UNDER = 0.6  # light that comes from the table under a glass
SHADE = 2.7  # radii of a foot beyond which its shadow is not seen
SOFT = 0.03  # rad: edge of a window


class Room(NamedTuple):
    """The surroundings as arrays, for compiled code; see `zsdt.lab.glass_styles.GlassStyle`.

    backdrop, table [height, width, 3] uint8: pictures, the first row of the backdrop is at its top, of the table at
    its back. backdrop_scale, table_scale: pixels per metre. distance [m]. ambient [3]. windows [windows, 5]. shadow;
    feet [glasses, 3]: x, y, radius [m] of what stands on the table. liquid_tint, glass_tint [3]: per centimetre.
    """

    backdrop: np.ndarray
    table: np.ndarray
    backdrop_scale: float
    table_scale: float
    distance: float
    ambient: np.ndarray
    windows: np.ndarray
    shadow: float
    feet: np.ndarray
    liquid_tint: np.ndarray
    glass_tint: np.ndarray


@njit(cache=True, error_model="numpy")
@no_type_check
def _sample(picture, u, v, share, weight, out):
    """Adds the picture at (u, v), mirrored beyond its edges, to `out`."""
    height, width = picture.shape[0], picture.shape[1]
    u, v = abs(u) % (2.0 * (width - 1)), abs(v) % (2.0 * (height - 1))
    u, v = min(u, 2.0 * (width - 1) - u), min(v, 2.0 * (height - 1) - v)
    i, j = min(int(u), width - 2), min(int(v), height - 2)
    a, b = u - i, v - j
    for c in range(3):
        upper = picture[j, i, c] * (1.0 - a) + picture[j, i + 1, c] * a
        lower = picture[j + 1, i, c] * (1.0 - a) + picture[j + 1, i + 1, c] * a
        out[c] += share * weight[c] * (upper * (1.0 - b) + lower * b)


@njit(cache=True, error_model="numpy")
@no_type_check
def _lit(room, x, y):
    """Light that the table gets at a place: less around what stands on it."""
    light = 1.0
    for k in range(len(room.feet)):
        away = ((x - room.feet[k, 0]) ** 2 + (y - room.feet[k, 1]) ** 2) / room.feet[k, 2] ** 2
        light *= 1.0 - room.shadow * math.exp(-0.8 * away)
    return light


@njit(cache=True, error_model="numpy")
@no_type_check
def see(room, px, py, pz, dx, dy, dz, share, weight, out):
    """Adds `share * weight` times the colour of the room that a ray sees to `out`; places and directions are the
    room's."""
    to_table = -pz / dz if dz < -1e-9 else 1e9
    to_back = (room.distance - py) / dy if dy > 1e-9 else 1e9
    if to_table < to_back:
        x, y = px + to_table * dx, py + to_table * dy
        height, width = room.table.shape[0], room.table.shape[1]
        u, v = 0.5 * width + x * room.table_scale, 0.5 * height - y * room.table_scale
        _sample(room.table, u, v, share * _lit(room, x, y), weight, out)
    elif to_back < 1e8:
        x, z = px + to_back * dx, pz + to_back * dz
        height, width = room.backdrop.shape[0], room.backdrop.shape[1]
        u, v = 0.5 * width + x * room.backdrop_scale, (height - 1) - z * room.backdrop_scale
        _sample(room.backdrop, u, v, share, weight, out)
    else:
        light = 0.0
        azimuth, elevation = math.atan2(dx, dy), math.asin(min(max(dz, -1.0), 1.0))
        for k in range(len(room.windows)):
            turn = abs(azimuth - room.windows[k, 0])
            turn = min(turn, 2.0 * math.pi - turn)
            inside = min(room.windows[k, 2] - turn, room.windows[k, 3] - abs(elevation - room.windows[k, 1]))
            light += room.windows[k, 4] * min(max(0.5 + inside / SOFT, 0.0), 1.0)
        for c in range(3):
            out[c] += share * weight[c] * (room.ambient[c] * (0.75 + 0.25 * dz) + light)


@njit(cache=True, error_model="numpy")
@no_type_check
def _reflectance(cos_in, cos_out, n_in, n_out):
    """Fresnel's share of unpolarised light that is reflected."""
    s = (n_in * cos_in - n_out * cos_out) / (n_in * cos_in + n_out * cos_out)
    p = (n_in * cos_out - n_out * cos_in) / (n_in * cos_out + n_out * cos_in)
    return 0.5 * (s * s + p * p)


@njit(inline="always", error_model="numpy")
@no_type_check
def _behind(ray, kind, medium, solid):
    """The medium on the other side of a surface."""
    if kind == SURFACE:
        return AIR if medium == LIQUID else LIQUID
    if medium != GLASS:
        return GLASS
    if kind in (INNER, FLOOR):
        return LIQUID if ray[2] < look_up(solid, 0, ray[0], ray[1]) else AIR
    return OUT


@njit(inline="always", error_model="numpy")
@no_type_check
def _index(medium, solid):
    """Index of refraction of a medium."""
    if medium == GLASS:
        return solid.glass
    return solid.liquid if medium == LIQUID else 1.0


@njit(inline="always", error_model="numpy")
@no_type_check
def _cross(ray, medium, beyond, normal, solid, room, origin, through, out):
    """Turns the ray at a surface, adds what is mirrored in it; gives back the medium in which it goes on."""
    cos = ray[3] * normal[0] + ray[4] * normal[1] + ray[5] * normal[2]
    if cos > 0.0:  # the normal against the ray
        normal[0], normal[1], normal[2] = -normal[0], -normal[1], -normal[2]
    cos = abs(cos)
    n_in, n_out = _index(medium, solid), _index(beyond, solid)
    ratio = n_in / n_out
    square = 1.0 - ratio * ratio * (1.0 - cos * cos)
    mx, my, mz = ray[3] + 2.0 * cos * normal[0], ray[4] + 2.0 * cos * normal[1], ray[5] + 2.0 * cos * normal[2]
    if square <= 0.0:
        ray[3], ray[4], ray[5] = mx, my, mz
        return medium
    cos_out = math.sqrt(square)
    share = _reflectance(cos, cos_out, n_in, n_out)
    if n_in == 1.0 and share > 0.002:
        see(room, ray[0] + origin[0], ray[1] + origin[1], ray[2] + origin[2], mx, my, mz, share, through, out)
    for c in range(3):
        through[c] *= 1.0 - share
        ray[3 + c] = ratio * ray[3 + c] + (ratio * cos - cos_out) * normal[c]
    return beyond


@njit(inline="always", error_model="numpy")
@no_type_check
def follow(ray, solid, room, origin, fade, normal, through, out):
    """Follows a ray that begins outside of a glass, in the vessel's axes, and adds the colour that it sees to `out`.

    fade [2, 3]: logarithms of the light that passes a metre of liquid and of glass.
    What is mirrored in the base of the glass, through which no eye sees the liquid itself, does not count as liquid.
    Gives back 0 where it misses the glass (nothing is added then), 1 for the container, 2 for the liquid.
    """
    medium, label, direct = OUT, 0, True
    for count in range(MOST):
        far, kind, piece = next_surface(ray, medium, solid)
        if kind == NOTHING:
            break
        label = max(label, 1)
        if medium in (LIQUID, GLASS):
            for c in range(3):
                through[c] *= math.exp(fade[0 if medium == LIQUID else 1, c] * far)
        for c in range(3):
            ray[c] += far * ray[3 + c]
        if kind == MOUTH:
            if medium != OUT:
                medium = OUT
                break
            medium = AIR
            continue
        if kind == BASE:
            if ray[5] < -math.sqrt(1.0 - 1.0 / solid.glass**2):  # steep enough to leave the glass for the table
                see(room, ray[0] + origin[0], ray[1] + origin[1], 0.0, 0.0, 0.0, -1.0, UNDER, through, out)
                return label
            ray[5] = -ray[5]  # mirrored by the film of air under the foot
            direct = False
            continue
        normal_at(ray, kind, piece, solid, normal)
        medium = _cross(ray, medium, _behind(ray, kind, medium, solid), normal, solid, room, origin, through, out)
        if medium == LIQUID and direct and count < SURFACES:
            label = 2
        if medium == OUT:
            break
        if count == MOST - 1:
            for c in range(3):
                out[c] += 0.5 * through[c] * room.ambient[c]
            return label
    if label:
        px, py, pz = ray[0] + origin[0], ray[1] + origin[1], ray[2] + origin[2]
        see(room, px, py, pz, ray[3], ray[4], ray[5], 1.0, through, out)
    return label


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def paint_room(rays, centre, room, out):
    """Paints the room without glasses: rays [pixels, 3] are directions from `centre`, out [pixels, 3]."""
    one = np.ones(3)
    for k in range(len(rays)):
        see(room, centre[0], centre[1], centre[2], rays[k, 0], rays[k, 1], rays[k, 2], 1.0, one, out[k])


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def paint_glass(rays, centre, solid, room, origin, out, labels):
    """Paints a glass where rays [pixels, 3] (unit length, from `centre`, all in the room) meet it; other pixels stay.

    labels [pixels]: 1 container, 2 liquid, 0 where the glass is missed.
    """
    ray, normal, through, colour = np.empty(6), np.empty(3), np.empty(3), np.empty(3)
    fade = np.empty((2, 3))
    for c in range(3):
        fade[0, c] = 100.0 * math.log(max(room.liquid_tint[c], 1e-6))
        fade[1, c] = 100.0 * math.log(max(room.glass_tint[c], 1e-6))
    for k in range(len(rays)):
        for c in range(3):
            ray[c], ray[3 + c] = centre[c] - origin[c], rays[k, c]
            through[c], colour[c] = 1.0, 0.0
        labels[k] = follow(ray, solid, room, origin, fade, normal, through, colour)
        if labels[k] > 0:
            for c in range(3):
                out[k, c] = colour[c]
