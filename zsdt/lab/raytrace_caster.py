"""Where rays meet triangles first: Mitsuba's intersector (Embree), with LLVM or without.

Mitsuba is an optional extra and imported here alone, when the first ray is cast.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from zsdt.errors import OptionError
from zsdt.lab.glass_mesh import Mesh
from zsdt.lab.raytrace_options import RayVariant

MISSED = -1
CRASHING_LLVM = (15, 16)  # major versions whose code for AVX-512 ends the process


class Hits(NamedTuple):
    """First triangle that each ray meets: face (MISSED: none), and the weights u, v of its second and third corner."""

    face: Int[np.ndarray, " rays"]
    u: Float[np.ndarray, " rays"]
    v: Float[np.ndarray, " rays"]


def load_mitsuba(variant: RayVariant = RayVariant.auto) -> ModuleType:
    """Mitsuba with one thread and a variant chosen.

    Raises: OptionError where the extra is not installed, or LLVM is asked for and not found.
    """
    try:
        import drjit as dr
        import mitsuba as mi
    except ImportError as error:
        raise OptionError(
            "The ray-traced camera needs Mitsuba, which is not installed: install the extra 'zsdt[raytrace]', or film "
            "with lab.camera=painter."
        ) from error
    if variant is not RayVariant.scalar:
        has_llvm = dr.has_backend(dr.JitBackend.LLVM) and dr.detail.llvm_version()[0] not in CRASHING_LLVM
        if not has_llvm and variant is RayVariant.llvm:
            raise OptionError(
                "Mitsuba found no usable LLVM library for the variant 'llvm': install LLVM 17 or newer (on Debian the "
                "package libllvm19), name its file in DRJIT_LIBLLVM_PATH, or choose the variant 'scalar'."
            )
        variant = RayVariant.llvm if has_llvm else RayVariant.scalar
    wanted = "llvm_ad_rgb" if variant is RayVariant.llvm else "scalar_rgb"
    if mi.variant() != wanted:
        mi.set_variant(wanted)
    dr.set_thread_count(1)  # jobs run side by side, one thread each
    return mi


class MitsubaCaster:
    """Casts rays at one surface of triangles. Raises: OptionError as `load_mitsuba`."""

    def __init__(self, surface: Mesh, variant: RayVariant = RayVariant.auto):
        self._mi = mi = load_mitsuba(variant)
        self.is_vectorised = mi.variant().startswith("llvm")
        mesh = mi.Mesh("glass", len(surface.vertices), len(surface.faces))
        values = mi.traverse(mesh)
        values["vertex_positions"] = np.ascontiguousarray(surface.vertices, np.float32).ravel()
        values["faces"] = np.ascontiguousarray(surface.faces, np.uint32).ravel()
        values.update()
        self._scene = mi.load_dict({"type": "scene", "glass": mesh})

    def cast(self, origins: Float[np.ndarray, "rays 3"], directions: Float[np.ndarray, "rays 3"]) -> Hits:
        """First hits of rays from `origins` [m] along unit `directions`."""
        origins, directions = np.asarray(origins, np.float32), np.asarray(directions, np.float32)
        return (self._cast_all if self.is_vectorised else self._cast_singly)(origins, directions)

    def _cast_all(self, origins: np.ndarray, directions: np.ndarray) -> Hits:
        import drjit as dr

        mi = self._mi
        starts, ways = (
            [mi.Float(np.ascontiguousarray(part[:, k])) for k in range(3)] for part in (origins, directions)
        )
        found = self._scene.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(*starts), mi.Vector3f(*ways)), coherent=False)
        hit = found.is_valid()
        face = dr.select(hit, mi.Int32(found.prim_index), MISSED)
        dr.eval(face, found.prim_uv)
        return Hits(face.numpy(), found.prim_uv.x.numpy(), found.prim_uv.y.numpy())

    def _cast_singly(self, origins: np.ndarray, directions: np.ndarray) -> Hits:
        mi, count = self._mi, len(origins)
        face, u, v = np.full(count, MISSED, np.int32), np.zeros(count, np.float32), np.zeros(count, np.float32)
        starts, ways = origins.tolist(), directions.tolist()
        cast: Any = self._scene.ray_intersect_preliminary
        for k in range(count):
            found = cast(mi.Ray3f(starts[k], ways[k]), coherent=False)
            if found.is_valid():
                face[k], (u[k], v[k]) = found.prim_index, found.prim_uv
        return Hits(face, u, v)
