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

LANES = 16
ROW = LANES + 8  # length of a displacement row: LANES elements have LANES + 1 nodes
MODES = ("x", "y", "z", "yz", "xz", "xy", "xyz")
PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # order 11 22 33 12 13 23
VOIGT = {pair: k for k, pair in enumerate(PAIRS)} | {(j, i): k for k, (i, j) in enumerate(PAIRS)}
BASIS = ("1", "x", "y", "z", "yz", "xz", "xy", "xyz")  # trilinear functions of a stress field

# Where things lie in a tile. Displacements: 12 rows (component * 4 + y + 2 z) and the element weights. Out: either 24
# nodal forces (component * 8 + node) and the margin of the stability watch, or 21 amplitudes, 48 stress coefficients
# (component * 8 + basis) and the elastic energy. Work: 21 amplitudes and 21 conjugate forces (`full`). Memory: rows of
# the elements, or of one of their Gauss points and the sum of |q|^2. Corner: Cauchy stress at one corner.
DISP = 0
OUT = DISP + 13 * ROW
WORK = OUT + 70 * LANES
MEMORY = WORK + 42 * LANES
CORNER = MEMORY + 43 * LANES
TILE = CORNER + 6 * LANES
STABILISED_MEMORY = 2 * 21 + 1  # 6 at the centre, 3 x 3 normal, 3 shear, 3 last modes, then the sum of |q|^2
FULL_MEMORY = 2 * 48 + 1  # 8 x 6, then the sum of |q|^2

CONSTANTS = "ih, bulk, m_inf, m_vis, keep, cond_s, cond_q, m_last, per_q, lo, hi"

DECORATORS = "@njit(cache=True, fastmath=FAST, error_model='numpy')\n@no_type_check\n"
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


class Code:
    """Lines of the lane loop, in order."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def let(self, name: str, expression: str) -> str:
        """Adds ``name = expression`` and gives the name back."""
        self.lines.append(f"{name} = {expression}")
        return name

    def function(self, name: str, arguments: str) -> str:
        """The text of a numba function that runs the lines for every lane."""
        body = "".join(f"        {line}\n" for line in self.lines)
        head = f"{DECORATORS}def {name}({arguments}):\n    for l in range({LANES}):\n"
        return f"\n\n{head}{body}"


def row(base: int, number: int) -> str:
    """A row of the tile in the lane loop."""
    return f"tile[{base + number * LANES} + l]"


def out_row(number: int) -> str:
    """A row of `OUT`."""
    return row(OUT, number)


def sign(value: int) -> str:
    """'+' or '-'."""
    return "+" if value > 0 else "-"


def amplitudes(code: Code, c: int) -> None:
    """Seven amplitudes of component c from its eight nodal displacements (a fast Hadamard transform)."""
    for line in range(4):  # line = y + 2 z; nodes x = 0 and x = 1 are neighbours in a row
        row = DISP + (c * 4 + line) * ROW
        low, high = f"tile[{row} + l]", f"tile[{row + 1} + l]"
        code.let(f"s{c}_{line}", f"{high} + {low}")
        code.let(f"d{c}_{line}", f"{high} - {low}")
    for k in "sd":
        for z in (0, 1):
            code.let(f"{k}s{c}_{z}", f"{k}{c}_{2 * z + 1} + {k}{c}_{2 * z}")
            code.let(f"{k}d{c}_{z}", f"{k}{c}_{2 * z + 1} - {k}{c}_{2 * z}")
    parts = {"x": ("ds", "+"), "y": ("sd", "+"), "z": ("ss", "-"), "yz": ("sd", "-"), "xz": ("ds", "-")}
    parts |= {"xy": ("dd", "+"), "xyz": ("dd", "-")}
    for mode, (kind, op) in parts.items():
        code.let(f"a{c}_{mode}", f"ih * ({kind}{c}_1 {op} {kind}{c}_0)")


def nodal_forces(code: Code, c: int, p: dict[str, str]) -> None:
    """Eight nodal forces of component c from the forces `p` that are conjugate to its amplitudes (transposed)."""
    for z in (-1, 1):
        code.let(f"fx{c}_{z + 1}", f"{p['x']} {sign(z)} {p['xz']}")
        code.let(f"fy{c}_{z + 1}", f"{p['y']} {sign(z)} {p['yz']}")
        code.let(f"fxy{c}_{z + 1}", f"{p['xy']} {sign(z)} {p['xyz']}")
        for y in (-1, 1):
            even = code.let(f"ev{c}_{z + 1}{y + 1}", f"{'-' if z < 0 else ''}{p['z']} {sign(y)} fy{c}_{z + 1}")
            odd = code.let(f"od{c}_{z + 1}{y + 1}", f"fx{c}_{z + 1} {sign(y)} fxy{c}_{z + 1}")
            for x in (-1, 1):
                node = (x + 1) // 2 + (y + 1) + 2 * (z + 1)
                code.let(out_row(c * 8 + node), f"weight * ({even} {sign(x)} {odd})")


def strain(code: Code, h: list[list[str]], p: str = "") -> list[str]:
    """Green-Lagrange strain (tensor components) of the displacement gradient `h`."""
    names = []
    for k, (i, j) in enumerate(PAIRS):
        square = " + ".join(f"{h[c][i]} * {h[c][j]}" for c in range(3))
        linear = h[i][i] if i == j else f"0.5 * ({h[i][j]} + {h[j][i]})"
        names.append(code.let(f"{p}e{k}", f"{linear} + 0.5 * ({square})"))
    return names


def watch(code: Code, h: list[list[str]], e: list[str]) -> str:
    """Margin that is positive exactly if J > 0 and every principal stretch lies within the two limits.

    ``E + lo`` and ``hi - E`` are positive definite (Sylvester: leading minors) for lo = (1 - smin^2)/2 and
    hi = (smax^2 - 1)/2.
    """
    f = [[f"({h[i][j]} + 1.0)" if i == j else h[i][j] for j in range(3)] for i in range(3)]
    code.let(
        "jac",
        " + ".join(
            f"{f[0][j]} * ({f[1][(j + 1) % 3]} * {f[2][(j + 2) % 3]} - {f[1][(j + 2) % 3]} * {f[2][(j + 1) % 3]})"
            for j in range(3)
        ),
    )
    minors = ["jac"]
    for side, op in (("lo", "+"), ("hi", "-")):
        a, b, c = (code.let(f"{side}{k}", f"{side} {op} {e[k]}") for k in range(3))
        minors += [a, code.let(f"{side}_m2", f"{a} * {b} - {e[3]} * {e[3]}")]
        det = f"{c} * {side}_m2 {op} 2.0 * {e[3]} * {e[4]} * {e[5]} - {a} * {e[5]} * {e[5]} - {b} * {e[4]} * {e[4]}"
        minors.append(code.let(f"{side}_m3", det))
    margin = minors[0]
    for minor in minors[1:]:
        margin = code.let("margin", f"min({margin}, {minor})")
    return margin


class Material:
    """Emits the stress of one strain or strain mode, reading and (for forces) writing memory rows in turn."""

    def __init__(self, code: Code, store: bool):
        self.code, self.store, self.component = code, store, 0
        self.norm: list[str] = []  # terms of the mean of |2 q|^2 at the middle of a step (output: |q|^2 now)
        self.stored: list[str] = []  # terms of the mean of the energy without the memory's part

    def _address(self, row: int) -> str:
        return f"tile[{MEMORY + row * LANES} + l]"

    def past(self, component: int) -> str:
        """What the memory contributes to q of a component, whatever its strain is now."""
        q, strain = self._address(2 * component), self._address(2 * component + 1)
        return f"(keep * {q} - m_vis * {strain})" if self.store else q

    def overstress(self, deviator: str, name: str) -> tuple[str, str]:
        """q of the next component now, and twice its value at the middle of the step; moves the memory on."""
        q_row, strain_row = (self._address(2 * self.component + k) for k in (0, 1))
        self.component += 1
        if not self.store:
            q = self.code.let(f"{name}q", q_row)
            return q, q
        q = self.code.let(f"{name}q", f"keep * {q_row} + m_vis * ({deviator} - {strain_row})")
        twice = self.code.let(f"{name}h", f"{q} + {q_row}")
        self.code.let(q_row, q)
        self.code.let(strain_row, deviator)
        return q, twice

    def centre(self, e: list[str], p: str) -> list[str]:
        """Second Piola-Kirchhoff stress of a full strain tensor; six names."""
        let = self.code.let
        let(f"{p}tr", f"{e[0]} + {e[1]} + {e[2]}")
        let(f"{p}mean", f"{p}tr * (1.0 / 3.0)")
        dev = [let(f"{p}v{k}", f"{e[k]} - {p}mean") if k < 3 else e[k] for k in range(6)]
        q, middle = zip(*(self.overstress(dev[k], f"{p}{k}") for k in range(6)), strict=True)
        stress = []
        for k in range(6):
            pressure = f"bulk * {p}tr + " if k < 3 else ""
            stress.append(let(f"{p}s{k}", f"{pressure}m_inf * {dev[k]} + {q[k]}"))
        for target, terms in ((self.norm, middle), (self.stored, dev)):
            squares = [f"{t} * {t}" for t in terms]
            target.append(f"{' + '.join(squares[:3])} + 2.0 * ({' + '.join(squares[3:])})")
        self.stored[-1] = f"0.5 * (bulk * {p}tr * {p}tr + m_inf * ({self.stored[-1]}))"
        return stress

    def normal_mode(self, first: str, second: str, p: str) -> tuple[str, str]:
        """Stresses of two normal strains whose third partner follows from zero stress in its own direction."""
        let = self.code.let
        let(f"{p}sum", f"{first} + {second}")
        let(f"{p}third", f"-(cond_s * {p}sum + cond_q * {self.past(self.component + 2)})")
        let(f"{p}tr", f"{p}sum + {p}third")
        let(f"{p}mean", f"{p}tr * (1.0 / 3.0)")
        dev = [let(f"{p}v{k}", f"{e} - {p}mean") for k, e in enumerate((first, second, f"{p}third"))]
        q, middle = zip(*(self.overstress(dev[k], f"{p}{k}") for k in range(3)), strict=True)
        self.norm.append(f"(1.0 / 3.0) * ({' + '.join(f'{t} * {t}' for t in middle)})")
        squares = " + ".join(f"{t} * {t}" for t in dev)
        self.stored.append(f"(1.0 / 6.0) * (bulk * {p}tr * {p}tr + m_inf * ({squares}))")
        s = [let(f"{p}s{k}", f"bulk * {p}tr + m_inf * {dev[k]} + {q[k]}") for k in range(2)]
        return s[0], s[1]

    def scalar_mode(self, e: str, p: str, share: str) -> str:
        """Stress of a mode with a single strain; `share` is the mean of its squared shape times its multiplicity."""
        q, middle = self.overstress(e, p)
        self.norm.append(f"{share} * {middle} * {middle}")
        self.stored.append(f"0.5 * {share} * m_inf * {e} * {e}")
        return self.code.let(f"{p}s", f"m_inf * {e} + {q}")


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
