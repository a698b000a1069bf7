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
QUADRATIC_RIDGE = (1e-9, 1e-3, 1e-3, 0.02, 0.02, 0.02)  # pull to zero of value, slopes and curvatures (pitch = 1)
FILL_ROUNDS, FILL_SUPPORT, FILL_WEIGHT = 6, 1.2, 0.3  # rounds; weight of known nodes needed; of a filled one
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


@dataclass
class LocalFit:
    """Affine fits around every node: value [nodes, 2] at the node, slope [nodes, 2, 2] (d value / d pixel of the
    first frame), support [nodes] (sum of the weights of the neighbours that spoke)."""

    value: Float64[np.ndarray, "nodes 2"]
    slope: Float64[np.ndarray, "nodes 2 2"]
    support: Float64[np.ndarray, " nodes"]


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


def slope_operator(
    around: Neighbourhoods, places: Float[np.ndarray, "nodes 2"]
) -> Float64[np.ndarray, "2 nodes nodes"]:
    """Matrices that take a field's values at the nodes to its slopes (d/dx, d/dy) at a place near each node.

    places [nodes, 2] px in the first frame: the middles of the windows, which at the silhouette lie off the node.
    Slopes are those of a quadratic fit: in a bent beam they change from node to node, and at its end a fit of one
    side would give those of half a pitch away.
    """
    nodes = len(places)
    operator = np.zeros((2, nodes, nodes))
    wide, basis, nearness = _quadratics(around.pixels, places, around.pitch)
    weighted = np.swapaxes(basis * nearness[..., None], 1, 2)
    solved = np.linalg.solve(weighted @ basis + np.diag(QUADRATIC_RIDGE), weighted)
    for axis in (0, 1):
        np.add.at(operator[axis], (np.arange(nodes)[:, None], wide), solved[:, 1 + axis] / around.pitch[:, None])
    return operator


def fill(
    around: Neighbourhoods, field: Float[np.ndarray, "nodes 2"], known: Bool[np.ndarray, " nodes"]
) -> Float64[np.ndarray, "nodes 2"]:
    """The field [px] with the nodes that are not known filled in, from the known ones inwards.

    Each round fills the nodes that have enough known or filled nodes around them, by a quadratic of the departure
    from one affine map of the whole body; what no round reaches has that map.
    """
    offset, slope = _whole(around.pixels, field, known.astype(np.float64))
    whole = offset + around.pixels @ slope.T
    rest = np.where(known[:, None], field - whole, 0.0)
    weight, missing = known.astype(np.float64), ~known
    for _ in range(FILL_ROUNDS):
        support = (around.nearness * weight[around.wide]).sum(axis=1)
        ids = np.flatnonzero(missing & (support > FILL_SUPPORT))
        if not len(ids):
            break
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


def fit_locally(
    around: Neighbourhoods,
    field: Float[np.ndarray, "nodes 2"],
    weight: Float[np.ndarray, " nodes"],
    own: float = 0.0,
) -> LocalFit:
    """Affine fit of a field [px] around every node, as the departure from one affine map of the whole body.

    weight [nodes]: how far each node is believed (0: not at all). own: what a node counts in its own fit; 0 keeps its
    measurement out of what is expected of it. Where no neighbour speaks, the body's map stands.
    """
    offset, slope = _whole(around.pixels, field, weight)
    rest = field - offset - around.pixels @ slope.T
    value, departure, support = (np.zeros((len(field), *shape)) for shape in ((2,), (2, 2), ()))
    _fit(
        around.pixels,
        around.first,
        around.index,
        around.weight,
        around.pitch,
        np.ascontiguousarray(rest),
        np.ascontiguousarray(weight, np.float64),
        own,
        value,
        departure,
        support,
    )
    return LocalFit(value + offset + around.pixels @ slope.T, departure + slope, support)


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


def _whole(
    pixels: Float[np.ndarray, "nodes 2"], field: Float[np.ndarray, "nodes 2"], weight: Float[np.ndarray, " nodes"]
) -> tuple[Float64[np.ndarray, "2"], Float64[np.ndarray, "2 2"]]:
    """One affine map ``offset + slope x`` of all believed nodes; still where nobody is believed."""
    total = float(weight.sum())
    if total <= 0.0:
        return np.zeros(2), np.zeros((2, 2))
    centre, mean = weight @ pixels / total, weight @ field / total
    arm = pixels - centre
    scatter = (arm * weight[:, None]).T @ arm
    # A ridge of one pixel squared per node: nodes on one line, or a single node, give no slope across.
    slope = ((field - mean) * weight[:, None]).T @ arm @ np.linalg.inv(scatter + (total + 1e-9) * np.eye(2))
    return mean - slope @ centre, slope


@_jit
@no_type_check
def _fit(pixels, first, index, ring, pitch, field, weight, own, value, slope, support):
    for node in range(pixels.shape[0]):
        total = own * weight[node]
        x, y = 0.0, 0.0
        f, g = total * field[node, 0], total * field[node, 1]
        heard = 0.0
        for entry in range(first[node], first[node + 1]):
            other = index[entry]
            w = ring[entry] * weight[other]
            heard += w
            total += w
            x += w * (pixels[other, 0] - pixels[node, 0])
            y += w * (pixels[other, 1] - pixels[node, 1])
            f += w * field[other, 0]
            g += w * field[other, 1]
        support[node] = heard
        if total <= 0.0:
            continue
        x, y, f, g = x / total, y / total, f / total, g / total
        ridge = RIDGE * pitch[node] * pitch[node]
        w = own * weight[node]
        xx, xy, yy = w * x * x + ridge, w * x * y, w * y * y + ridge
        fx, fy = -w * (field[node, 0] - f) * x, -w * (field[node, 0] - f) * y
        gx, gy = -w * (field[node, 1] - g) * x, -w * (field[node, 1] - g) * y
        for entry in range(first[node], first[node + 1]):
            other = index[entry]
            w = ring[entry] * weight[other]
            dx = pixels[other, 0] - pixels[node, 0] - x
            dy = pixels[other, 1] - pixels[node, 1] - y
            xx += w * dx * dx
            xy += w * dx * dy
            yy += w * dy * dy
            fx += w * (field[other, 0] - f) * dx
            fy += w * (field[other, 0] - f) * dy
            gx += w * (field[other, 1] - g) * dx
            gy += w * (field[other, 1] - g) * dy
        over = 1.0 / (xx * yy - xy * xy)
        slope[node, 0, 0] = (yy * fx - xy * fy) * over
        slope[node, 0, 1] = (xx * fy - xy * fx) * over
        slope[node, 1, 0] = (yy * gx - xy * gy) * over
        slope[node, 1, 1] = (xx * gy - xy * gx) * over
        value[node, 0] = f - slope[node, 0, 0] * x - slope[node, 0, 1] * y
        value[node, 1] = g - slope[node, 1, 0] * x - slope[node, 1, 1] * y
