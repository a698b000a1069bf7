"""Writes `element_kernels.py`: straight-line numba code for the two hexahedra of the solid solver.

A kernel treats a tile of `LANES` elements that follow each other along x, one element per vector lane. All that it
reads and writes are rows of one small array `tile`: with constant offsets in one array the compiler sees that lanes do
not touch each other, and the lane loop vectorises (with several arrays it would need too many checks and gives up).
Run ``python -m zsdt.solid.codegen`` after a change here; a test holds the committed file against this generator.

The element. The displacement gradient of a brick with edge h is a sum of seven amplitudes per component c,
``a_x, a_y, a_z`` (constant part) and ``a_yz, a_xz, a_xy, a_xyz`` (hourglass part), with xi, eta, zeta in [-1, 1]::

    H_c1 = a_x + eta a_xy + zeta a_xz + eta zeta a_xyz        (likewise H_c2, H_c3)

`full` integrates the Green-Lagrange strain at 8 Gauss points. `stabilised` integrates it at the centre and adds the
energy of an assumed strain that is linear in xi, eta, zeta: with ``Q_i = F_ci a_c`` (F at the centre) the normal
strains along each direction keep the two components that the amplitudes give and choose the third for zero stress
(no locking in bending), shear strains keep the part that is not parasitic, the last mode gets the uniaxial modulus.
Belytschko and Bindeman (1993) and Puso (2000) describe such elements. Every mode has its own viscous memory.

Material (seed, Eq. 9): ``S = K tr E + 2 mu (1 - g1) dev E + q`` and ``q+ = keep q + m_vis (dev E+ - dev E)``. Memory
rows come in pairs, q and dev E after the last step. Dissipation is summed at the middle of each step,
``|q + q+|^2 / 4``: with the trapezoid ``(|q|^2 + |q+|^2) / 2`` the account would be off by ``|q+ - q|^2 / 4`` a step,
always with the same sign.
"""

from __future__ import annotations

from pathlib import Path

from zsdt.solid.kernel_parts import (
    BASIS,
    CONSTANTS,
    CORNER,
    DECORATORS,
    DISP,
    LANES,
    MEMORY,
    MODES,
    OUT,
    PAIRS,
    ROW,
    VOIGT,
    WORK,
    Code,
    Material,
    amplitudes,
    nodal_forces,
    out_row,
    row,
    strain,
    watch,
)

HEADER = f'''"""Written by zsdt/solid/codegen.py; change that file and run ``python -m zsdt.solid.codegen``."""

# ruff: noqa
# fmt: off
# mypy: ignore-errors
import math
from typing import no_type_check  # keeps the checks of the tests out of compiled code

from numba import njit

LANES = {LANES}
ROW = {ROW}
# No assumption on NaN: a run that leaves the numbers must be seen.
FAST = {{"contract", "reassoc", "nsz", "arcp"}}
'''


# Normal strains that vary along one direction: the two that the hourglass amplitudes give, as (amplitude, component).
NORMAL = {"y": (("xy", 0), ("yz", 2)), "x": (("xy", 1), ("xz", 2)), "z": (("xz", 0), ("yz", 1))}
# Shear strains that are not parasitic: stress component -> (direction, its two contributions).
SHEAR = {
    3: ("z", (("yz", 0), ("xz", 1))),
    4: ("y", (("yz", 0), ("xy", 2))),
    5: ("x", (("xz", 1), ("xy", 2))),
}


def stabilised_stress(code: Code, store: bool) -> tuple[list[str], dict[tuple[int, str], str], Material]:
    """Stress at the centre and of every assumed-strain mode, keyed by (stress component, basis function)."""
    for c in range(3):
        amplitudes(code, c)
    material = Material(code, store)
    strains = strain(code, [[f"a{c}_{m}" for m in "xyz"] for c in range(3)])
    centre = material.centre(strains, "c")
    for mode in MODES[3:]:
        for i in range(3):
            turned = " + ".join(f"a{c}_{'xyz'[i]} * a{c}_{mode}" for c in range(3))
            code.let(f"q{mode}_{i}", f"a{i}_{mode} + {turned}")
    modes: dict[tuple[int, str], str] = {}
    for direction, ((m1, i), (m2, j)) in NORMAL.items():
        s = material.normal_mode(f"q{m1}_{i}", f"q{m2}_{j}", f"n{direction}")
        modes[i, direction], modes[j, direction] = s
    for k, (direction, ((m1, i), (m2, j))) in SHEAR.items():
        e = code.let(f"w{k}", f"0.5 * (q{m1}_{i} + q{m2}_{j})")
        modes[k, direction] = material.scalar_mode(e, f"w{k}", "(2.0 / 3.0)")
    for i, basis in enumerate(("yz", "xz", "xy")):
        modes[i, basis] = material.scalar_mode(f"qxyz_{i}", f"t{i}", "m_last")
    return centre, modes, material


def conjugates(modes: dict[tuple[int, str], str]) -> dict[tuple[str, int], str]:
    """Energy derivatives with respect to Q_i of every hourglass amplitude: (amplitude, component) -> expression."""
    found: dict[tuple[str, int], list[str]] = {}
    for direction, parts in NORMAL.items():
        for mode, i in parts:
            found.setdefault((mode, i), []).append(modes[i, direction])
    for k, (direction, parts) in SHEAR.items():
        for mode, i in parts:
            found.setdefault((mode, i), []).append(modes[k, direction])
    result = {key: f"(1.0 / 3.0) * ({' + '.join(terms)})" for key, terms in found.items()}
    for i, basis in enumerate(("yz", "xz", "xy")):
        result["xyz", i] = f"m_last * {modes[i, basis]}"
    return result


def stabilised_force() -> str:
    """Kernel: nodal forces, memory one step on, and the watch of the stabilised element."""
    code = Code()
    code.let("weight", f"tile[{DISP + 12 * ROW} + l]")
    s, modes, material = stabilised_stress(code, store=True)
    margin = watch(code, [[f"a{c}_{m}" for m in "xyz"] for c in range(3)], [f"e{k}" for k in range(6)])
    code.let(out_row(24), margin)
    total = f"tile[{MEMORY + 42 * LANES} + l]"
    code.let(total, f"{total} + 0.25 * ({' + '.join(material.norm)})")
    t = {key: code.let(f"t_{key[0]}_{key[1]}", value) for key, value in conjugates(modes).items()}
    for c in range(3):
        p = {}
        for j, axis in enumerate("xyz"):  # F S, and the hourglass energy's dependence on F
            terms = [s[VOIGT[c, j]]] + [f"a{c}_{m} * {s[VOIGT[k, j]]}" for k, m in enumerate("xyz")]
            terms += [f"a{c}_{m} * {t[m, j]}" for m in MODES[3:]]
            p[axis] = code.let(f"p{c}_{axis}", " + ".join(terms))
        for m in MODES[3:]:
            terms = [t[m, c]] + [f"a{c}_{axis} * {t[m, i]}" for i, axis in enumerate("xyz")]
            p[m] = code.let(f"p{c}_{m}", " + ".join(terms))
        nodal_forces(code, c, p)
    return code.function("stabilised_force", f"tile, {CONSTANTS}")


def put_modes(code: Code, base: int) -> None:
    """Writes the amplitudes into 21 rows from `base` on."""
    for c in range(3):
        for k, mode in enumerate(MODES):
            code.let(row(base, c * 7 + k), f"a{c}_{mode}")


def stabilised_fields() -> str:
    """Kernel: amplitudes, stress coefficients and energies of the stabilised element; changes nothing."""
    code = Code()
    s, modes, material = stabilised_stress(code, store=False)
    put_modes(code, OUT)
    for k in range(6):
        for b, basis in enumerate(BASIS):
            value = s[k] if b == 0 else modes.get((k, basis), "0.0")
            if k < 3 and len(basis) == 2 and value != "0.0":
                value = f"9.0 * m_last * {value}"
            code.let(out_row(21 + k * 8 + b), value)
    energy = f"{' + '.join(material.stored)} + per_q * ({' + '.join(material.norm)})"
    code.let(out_row(69), energy)
    return code.function("stabilised_fields", f"tile, {CONSTANTS}")


GAUSS = "        x = g if point & 1 else -g\n        y = g if point & 2 else -g\n        z = g if point & 4 else -g\n"


def gauss_point(code: Code, store: bool) -> tuple[list[str], list[list[str]], Material]:
    """Stress at the Gauss point (x, y, z) from the amplitudes in `WORK`."""
    h: list[list[str]] = []
    for c in range(3):
        for k, mode in enumerate(MODES):
            code.let(f"a{c}_{mode}", row(WORK, c * 7 + k))
        h.append(
            [
                code.let(f"h{c}0", f"a{c}_x + y * a{c}_xy + z * a{c}_xz + y * z * a{c}_xyz"),
                code.let(f"h{c}1", f"a{c}_y + x * a{c}_xy + z * a{c}_yz + x * z * a{c}_xyz"),
                code.let(f"h{c}2", f"a{c}_z + x * a{c}_xz + y * a{c}_yz + x * y * a{c}_xyz"),
            ]
        )
    material = Material(code, store)
    return material.centre(strain(code, h), "c"), h, material


def full_amplitudes() -> str:
    """Kernel: amplitudes of a tile into `WORK`."""
    code = Code()
    for c in range(3):
        amplitudes(code, c)
    put_modes(code, WORK)
    return code.function("full_amplitudes", "tile, ih")


def full_point_force() -> str:
    """Kernel: adds one Gauss point's share to the conjugate forces, rows 21 to 41 of `WORK`."""
    code = Code()
    s, h, material = gauss_point(code, store=True)
    margin = watch(code, h, [f"e{k}" for k in range(6)])
    code.let(out_row(24), f"min({margin}, {out_row(24)})")
    total = row(MEMORY, 12)
    code.let(total, f"{total} + (0.25 / 8.0) * ({material.norm[0]})")
    shape = {"x": "1.0 0 0", "y": "0 1.0 0", "z": "0 0 1.0", "yz": "0 z y", "xz": "z 0 x", "xy": "y x 0"}
    shape["xyz"] = "y*z x*z x*y"
    for c in range(3):
        for j in range(3):
            code.let(f"p{j}", " + ".join([s[VOIGT[c, j]]] + [f"{h[c][k]} * {s[VOIGT[k, j]]}" for k in range(3)]))
        for k, mode in enumerate(MODES):
            factors = [f if "*" not in f else f"({f})" for f in shape[mode].split()]
            total = " + ".join(f"{f} * p{j}" for j, f in enumerate(factors) if f != "0")
            place = row(WORK, 21 + c * 7 + k)
            code.let(place, f"{place} + 0.125 * ({total})")
    return code.function("full_point_force", f"tile, x, y, z, {CONSTANTS}")


def full_assemble() -> str:
    """Kernel: nodal forces from the conjugate forces in `WORK`."""
    code = Code()
    code.let("weight", f"tile[{DISP + 12 * ROW} + l]")
    for c in range(3):
        names = {m: code.let(f"p{c}_{m}", row(WORK, 21 + c * 7 + k)) for k, m in enumerate(MODES)}
        nodal_forces(code, c, names)
    return code.function("full_assemble", "tile")


def full_point_fields() -> str:
    """Kernel: adds one Gauss point's share to stress coefficients and energies in `OUT`."""
    code = Code()
    s, _, material = gauss_point(code, store=False)
    shape = ("1.0", "3.0 * x", "3.0 * y", "3.0 * z", "9.0 * y * z", "9.0 * x * z", "9.0 * x * y", "27.0 * x * y * z")
    for k in range(6):
        for b in range(8):
            place = out_row(21 + k * 8 + b)
            code.let(place, f"{place} + 0.125 * {shape[b]} * {s[k]}")
    energy = out_row(69)
    code.let(energy, f"{energy} + 0.125 * ({material.stored[0]} + per_q * ({material.norm[0]}))")
    return code.function("full_point_fields", f"tile, x, y, z, {CONSTANTS}")


def corner_stress() -> str:
    """Kernel: Cauchy stress at the element corner (x, y, z) = (+-1, +-1, +-1) from the rows of a fields kernel."""
    code = Code()
    shape = ("", "x * ", "y * ", "z * ", "y * z * ", "x * z * ", "x * y * ", "x * y * z * ")
    for c in range(3):
        a = [code.let(f"a{c}_{mode}", out_row(c * 7 + k)) for k, mode in enumerate(MODES)]
        code.let(f"f{c}0", f"{'1.0 + ' if c == 0 else ''}{a[0]} + y * {a[5]} + z * {a[4]} + y * z * {a[6]}")
        code.let(f"f{c}1", f"{'1.0 + ' if c == 1 else ''}{a[1]} + x * {a[5]} + z * {a[3]} + x * z * {a[6]}")
        code.let(f"f{c}2", f"{'1.0 + ' if c == 2 else ''}{a[2]} + x * {a[4]} + y * {a[3]} + x * y * {a[6]}")
    for k in range(6):
        terms = [f"{shape[b]}{out_row(21 + k * 8 + b)}" for b in range(8)]
        code.let(f"s{k}", " + ".join(terms))
    minors = [f"f0{j} * (f1{(j + 1) % 3} * f2{(j + 2) % 3} - f1{(j + 2) % 3} * f2{(j + 1) % 3})" for j in range(3)]
    code.let("per_volume", f"1.0 / ({' + '.join(minors)})")
    for i in range(3):
        for j in range(3):
            code.let(f"g{i}{j}", " + ".join(f"f{i}{k} * s{VOIGT[k, j]}" for k in range(3)))
    for k, (i, j) in enumerate(PAIRS):
        code.let(row(CORNER, k), f"per_volume * ({' + '.join(f'g{i}{m} * f{j}{m}' for m in range(3))})")
    return code.function("corner_stress", "tile, x, y, z")


DRIVERS = f"""

{DECORATORS}def full_force(tile, memory, {CONSTANTS}):
    full_amplitudes(tile, ih)
    for k in range({WORK + 21 * LANES}, {WORK + 42 * LANES}):
        tile[k] = 0.0
    for l in range({LANES}):
        tile[{OUT + 24 * LANES} + l] = 1.0
        tile[{MEMORY + 12 * LANES} + l] = memory[{96 * LANES} + l]
    g = math.sqrt(1.0 / 3.0)
    for point in range(8):
{GAUSS}        rows = memory[point * {12 * LANES} : (point + 1) * {12 * LANES}]
        for k in range({12 * LANES}):
            tile[{MEMORY} + k] = rows[k]
        full_point_force(tile, x, y, z, {CONSTANTS})
        for k in range({12 * LANES}):
            rows[k] = tile[{MEMORY} + k]
    for l in range({LANES}):
        memory[{96 * LANES} + l] = tile[{MEMORY + 12 * LANES} + l]
    full_assemble(tile)


{DECORATORS}def full_fields(tile, memory, {CONSTANTS}):
    full_amplitudes(tile, ih)
    for k in range({21 * LANES}):
        tile[{OUT} + k] = tile[{WORK} + k]
    for k in range({OUT + 21 * LANES}, {OUT + 70 * LANES}):
        tile[k] = 0.0
    g = math.sqrt(1.0 / 3.0)
    for point in range(8):
{GAUSS}        rows = memory[point * {12 * LANES} : (point + 1) * {12 * LANES}]
        for k in range({12 * LANES}):
            tile[{MEMORY} + k] = rows[k]
        full_point_fields(tile, x, y, z, {CONSTANTS})
"""


def generate() -> str:
    """The text of `element_kernels.py`."""
    kernels = [stabilised_force(), stabilised_fields(), full_amplitudes(), full_point_force(), full_assemble()]
    return HEADER + "".join([*kernels, full_point_fields(), corner_stress()]) + DRIVERS


if __name__ == "__main__":
    Path(__file__).with_name("element_kernels.py").write_text(generate())
    Path(__file__).with_name("stepping.py").touch()  # numba keeps compiled callers until their own file changes
