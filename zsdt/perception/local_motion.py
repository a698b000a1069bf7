"""What a node's neighbours say about its motion: weighted affine fits over the grid's own neighbourhoods.

A soft body moves smoothly, so close to a node its motion is an affine map. The value of that map at the node, fitted
without the node itself, is what an honest measurement should resemble (outliers do not) and what replaces a lost one;
its slope is the deformation by which the appearance of the first frame is warped.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Float64, Int, Int64
from numba import njit
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

RING_WEIGHTS = (1.0, 0.5)  # of the neighbours and of their neighbours
QUADRATIC_REACH = 2.6  # pitches to the nodes that tell the slope
QUADRATIC_RIDGE = (1e-9, 1e-3, 1e-3, 0.01, 0.01, 0.01)  # pull to zero of value, slopes and curvatures (pitch = 1)
# Rounds; weight of the known nodes around that a node needs, halved where none has it; weight of a filled node.
FILL_ROUNDS, FILL_SUPPORT, FILL_WEIGHT = 10, 1.2, 0.3
LINK = 6  # edges along a grid line over which distances are compared
TORN = 0.5  # of the pitch by which such a distance may be unexpected
RIDGE = 0.1  # square of the local pitch: pull of the slope towards that of the whole body
_jit: Any = njit(cache=True, error_model="numpy")


@dataclass(frozen=True)
class Neighbourhoods:
    """Neighbours up to two edges away, by rows: those of node i are ``index[first[i]:first[i + 1]]``.

    pixels [nodes, 2]: the grid in the first frame. links [links, 2]: nodes of one grid line, up to `LINK` edges
    apart. pitch [nodes] px: mean length of a node's edges (of all edges where a node has none). wide [nodes, most]:
    nodes within `QUADRATIC_REACH` pitches, with the basis of a quadratic around the node and their weights, 0 for the
    node itself and where a row is not full.
    """

    pixels: Float64[np.ndarray, "nodes 2"]
    links: Int64[np.ndarray, "links 2"]
    wide: Int64[np.ndarray, "nodes most"]
    basis: Float64[np.ndarray, "nodes most 6"]
    nearness: Float64[np.ndarray, "nodes most"]
    first: Int64[np.ndarray, " rows"]
    index: Int64[np.ndarray, " entries"]
    weight: Float64[np.ndarray, " entries"]
    pitch: Float64[np.ndarray, " nodes"]


def neighbourhoods(pixels: Float[np.ndarray, "nodes 2"], edges: Int[np.ndarray, "edges 2"]) -> Neighbourhoods:
    """Neighbourhoods of the grid in the first frame; pixels [nodes, 2], edges [edges, 2] as ids of nodes."""
    count = len(pixels)
    near: list[set[int]] = [set() for _ in range(count)]
    for left, right in edges.tolist():
        near[left].add(right)
        near[right].add(left)
    first, index, weight = [0], [], []
    for node in range(count):
        second = set().union(*(near[other] for other in near[node])) - near[node] - {node}
        for ring, ids in zip(RING_WEIGHTS, (near[node], second), strict=True):
            index += sorted(ids)
            weight += [ring] * len(ids)
        first.append(len(index))
    lengths = np.linalg.norm(pixels[edges[:, 0]] - pixels[edges[:, 1]], axis=1)
    total = np.bincount(edges.reshape(-1), np.repeat(lengths, 2), count)
    degree = np.bincount(edges.reshape(-1), minlength=count)
    mean = float(lengths.mean()) if len(lengths) else float(np.ptp(pixels, axis=0).max()) or 1.0
    pitch = np.where(degree > 0, total / np.maximum(degree, 1), mean)
    wide, basis, nearness = _quadratics(pixels, pixels, pitch)
    nearness[wide == np.arange(count)[:, None]] = 0.0
    return Neighbourhoods(
        pixels=np.array(pixels, np.float64),
        links=_straight_links(pixels, near),
        first=np.array(first, np.int64),
        index=np.array(index, np.int64),
        weight=np.array(weight, np.float64),
        pitch=pitch,
        wide=wide,
        basis=basis,
        nearness=nearness,
    )


def lattice_edges(columns: int, rows: int) -> Int64[np.ndarray, "edges 2"]:
    """Edges of a full grid whose nodes are numbered column by column: [columns, rows] flattened."""
    ids = np.arange(columns * rows).reshape(columns, rows)
    along = np.stack([ids[:-1], ids[1:]], axis=-1).reshape(-1, 2)
    across = np.stack([ids[:, :-1], ids[:, 1:]], axis=-1).reshape(-1, 2)
    return np.concatenate([along, across])


def warp_operator(around: Neighbourhoods) -> Float64[np.ndarray, "5 nodes nodes"]:
    """Matrices that take a field's values at the nodes to its slopes and curvatures at each node.

    Rows: d/dx, d/dy, half of d2/dx2, d2/dxdy, half of d2/dy2, by a quadratic fit. In a bent beam slopes change from
    node to node: without curvature, those at its outline would be of half a pitch inside.
    """
    nodes = len(around.pixels)
    operator = np.zeros((5, nodes, nodes))
    wide, basis, nearness = _quadratics(around.pixels, around.pixels, around.pitch)
    weighted = np.swapaxes(basis * nearness[..., None], 1, 2)
    solved = np.linalg.solve(weighted @ basis + np.diag(QUADRATIC_RIDGE), weighted)
    for row, (power, factor) in enumerate(((1, 1.0), (1, 1.0), (2, 0.5), (2, 1.0), (2, 0.5))):
        entries = factor * solved[:, 1 + row] / around.pitch[:, None] ** power
        np.add.at(operator[row], (np.arange(nodes)[:, None], wide), entries)
    return operator


def fill(
    around: Neighbourhoods, field: Float[np.ndarray, "nodes 2"], known: Bool[np.ndarray, " nodes"]
) -> Float64[np.ndarray, "nodes 2"]:
    """The field [px] with the nodes that are not known filled in, from the known ones inwards.

    Each round fills the nodes that have enough known or filled nodes around them, by a quadratic of the departure
    from one affine map of the whole body; what no round reaches has that map.
    """
    whole = np.zeros((len(field), 2))
    if known.any():
        _affine(around.pixels, np.ascontiguousarray(field, np.float64), known.astype(np.float64), whole)
    rest = np.where(known[:, None], field - whole, 0.0)
    weight, missing = known.astype(np.float64), ~known
    enough = FILL_SUPPORT
    for _ in range(FILL_ROUNDS):
        support = (around.nearness * weight[around.wide]).sum(axis=1)
        ids = np.flatnonzero(missing & (support > enough))
        if not len(ids):
            if not missing.any() or not known.any():
                break
            enough *= 0.5
            continue
        basis = around.basis[ids]
        weighted = np.swapaxes(basis * (around.nearness[ids] * weight[around.wide[ids]])[..., None], 1, 2)
        rest[ids] = np.linalg.solve(weighted @ basis + np.diag(QUADRATIC_RIDGE), weighted @ rest[around.wide[ids]])[
            :, 0
        ]
        weight[ids], missing[ids] = FILL_WEIGHT, False
    return whole + rest


def _quadratics(
    pixels: Float[np.ndarray, "nodes 2"], places: Float[np.ndarray, "nodes 2"], pitch: Float[np.ndarray, " nodes"]
) -> tuple[Int64[np.ndarray, "nodes most"], Float64[np.ndarray, "nodes most 6"], Float64[np.ndarray, "nodes most"]]:
    """Nodes near each place, the basis of a quadratic around it at them [pitches], and weights that fall with
    distance; rows are filled up with weights of 0."""
    arm = (pixels[None] - places[:, None]) / pitch[:, None, None]
    square = (arm**2).sum(axis=2)
    most = int((square < QUADRATIC_REACH**2).sum(axis=1).max())
    wide = np.argsort(square, axis=1, kind="stable")[:, :most]
    rows = np.arange(len(places))[:, None]
    x, y = np.moveaxis(arm[rows, wide], 2, 0)
    basis = np.stack([np.ones_like(x), x, y, 0.5 * x * x, x * y, 0.5 * y * y], axis=2)
    near = square[rows, wide]
    return wide, basis, np.where(near < QUADRATIC_REACH**2, 1.0 / (1.0 + near), 0.0)


def smooth_locally(
    around: Neighbourhoods, field: Float[np.ndarray, "nodes 2"], believed: Bool[np.ndarray, " nodes"]
) -> Float64[np.ndarray, "nodes 2"]:
    """What the believed neighbours of every node say about a field [px] at it: affine fits without the node itself.

    Fits are of the departure from one affine map of the whole body, which also stands where no neighbour speaks.
    They are made twice; nodes that stand out from the first one count little in the second.
    """
    value = np.zeros((len(field), 2))
    _smooth(
        around.pixels,
        around.first,
        around.index,
        around.weight,
        around.pitch,
        np.ascontiguousarray(field, np.float64),
        believed.astype(np.float64),
        value,
    )
    return value


def torn_off(
    around: Neighbourhoods,
    pixels: Float[np.ndarray, "nodes 2"],
    expected: Float[np.ndarray, "nodes 2"],
    seen: Bool[np.ndarray, " nodes"],
) -> Bool[np.ndarray, " nodes"]:
    """Nodes of parts that would have torn off the body: crossings look alike, and a part may sit one pitch off.

    Where two seen nodes of a grid line are farther apart or nearer than expected by half a pitch, the parts of the
    grid that they belong to contradict each other; the smaller one is wrong.
    """
    left, right = around.links.T
    change = np.linalg.norm(pixels[left] - pixels[right], axis=1) - np.linalg.norm(
        expected[left] - expected[right], axis=1
    )
    both = seen[left] & seen[right]
    sound = both & (np.abs(change) < TORN * np.minimum(around.pitch[left], around.pitch[right]))
    if (sound == both).all():
        return np.zeros(len(pixels), bool)
    joined = coo_matrix((np.ones(int(sound.sum())), (left[sound], right[sound])), shape=(len(pixels),) * 2)
    part = connected_components(joined, directed=False)[1]
    size = np.bincount(part)
    broken = both & ~sound
    ends = np.stack([part[left[broken]], part[right[broken]]], axis=1)
    wrong = np.where(size[ends[:, 0]] < size[ends[:, 1]], ends[:, 0], ends[:, 1])
    return np.isin(part, wrong)


def _straight_links(pixels: Float[np.ndarray, "nodes 2"], near: list[set[int]]) -> Int64[np.ndarray, "links 2"]:
    """Pairs of nodes up to `LINK` edges apart along a grid line: from edge to edge with less than a turn of 45 deg."""
    links = set()
    for start, beside in enumerate(near):
        for after in beside:
            before, here = start, after
            for _ in range(LINK):
                links.add((min(start, here), max(start, here)))
                way = pixels[here] - pixels[before]
                ahead = [(_cosine(way, pixels[other] - pixels[here]), other) for other in near[here] - {before}]
                if not ahead or max(ahead)[0] < np.sqrt(0.5):
                    break
                before, here = here, max(ahead)[1]
    return np.array(sorted(links), np.int64).reshape(-1, 2)


def _cosine(one: Float[np.ndarray, "2"], other: Float[np.ndarray, "2"]) -> float:
    return float(one @ other) / max(float(np.linalg.norm(one) * np.linalg.norm(other)), 1e-12)


@_jit
@no_type_check
def _smooth(pixels, first, index, ring, pitch, field, weight, value):
    total = weight.sum()
    if total <= 0.0:
        return
    rest, whole = np.empty_like(field), np.empty_like(field)
    _affine(pixels, field, weight, whole)
    rest[:] = field - whole
    _fit(pixels, first, index, ring, pitch, rest, weight, value)
    apart = np.sqrt((rest[:, 0] - value[:, 0]) ** 2 + (rest[:, 1] - value[:, 1]) ** 2)
    scale = max(1.0, 1.5 * np.median(apart[weight > 0.0]))
    tempered = weight / (1.0 + (apart / scale) ** 2) ** 2
    _affine(pixels, field, tempered, whole)
    rest[:] = field - whole
    _fit(pixels, first, index, ring, pitch, rest, tempered, value)
    value += whole


@_jit
@no_type_check
def _affine(pixels, field, weight, value):
    """One affine map of all nodes; a ridge of one pixel squared per node keeps it flat across a single line."""
    total, x, y, f, g = 0.0, 0.0, 0.0, 0.0, 0.0
    for node in range(pixels.shape[0]):
        w = weight[node]
        total += w
        x += w * pixels[node, 0]
        y += w * pixels[node, 1]
        f += w * field[node, 0]
        g += w * field[node, 1]
    x, y, f, g = x / total, y / total, f / total, g / total
    xx, xy, yy, fx, fy, gx, gy = total, 0.0, total, 0.0, 0.0, 0.0, 0.0
    for node in range(pixels.shape[0]):
        w = weight[node]
        dx, dy, df, dg = pixels[node, 0] - x, pixels[node, 1] - y, field[node, 0] - f, field[node, 1] - g
        xx += w * dx * dx
        xy += w * dx * dy
        yy += w * dy * dy
        fx += w * df * dx
        fy += w * df * dy
        gx += w * dg * dx
        gy += w * dg * dy
    over = 1.0 / (xx * yy - xy * xy)
    for node in range(pixels.shape[0]):
        dx, dy = pixels[node, 0] - x, pixels[node, 1] - y
        value[node, 0] = f + ((yy * fx - xy * fy) * dx + (xx * fy - xy * fx) * dy) * over
        value[node, 1] = g + ((yy * gx - xy * gy) * dx + (xx * gy - xy * gx) * dy) * over


@_jit
@no_type_check
def _fit(pixels, first, index, ring, pitch, field, weight, value):
    """The value at each node of the affine fit to its neighbours; zero where none speaks."""
    for node in range(pixels.shape[0]):
        total, x, y, f, g = 0.0, 0.0, 0.0, 0.0, 0.0
        for entry in range(first[node], first[node + 1]):
            other = index[entry]
            w = ring[entry] * weight[other]
            total += w
            x += w * (pixels[other, 0] - pixels[node, 0])
            y += w * (pixels[other, 1] - pixels[node, 1])
            f += w * field[other, 0]
            g += w * field[other, 1]
        value[node, 0] = value[node, 1] = 0.0
        if total <= 1e-9:
            continue
        x, y, f, g = x / total, y / total, f / total, g / total
        ridge = RIDGE * pitch[node] * pitch[node]
        xx, xy, yy, fx, fy, gx, gy = ridge, 0.0, ridge, 0.0, 0.0, 0.0, 0.0
        for entry in range(first[node], first[node + 1]):
            other = index[entry]
            w = ring[entry] * weight[other]
            dx = pixels[other, 0] - pixels[node, 0] - x
            dy = pixels[other, 1] - pixels[node, 1] - y
            df, dg = field[other, 0] - f, field[other, 1] - g
            xx += w * dx * dx
            xy += w * dx * dy
            yy += w * dy * dy
            fx += w * df * dx
            fy += w * df * dy
            gx += w * dg * dx
            gy += w * dg * dy
        over = 1.0 / (xx * yy - xy * xy)
        value[node, 0] = f - ((yy * fx - xy * fy) * x + (xx * fy - xy * fx) * y) * over
        value[node, 1] = g - ((yy * gx - xy * gy) * x + (xx * gy - xy * gx) * y) * over
