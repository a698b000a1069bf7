"""Pieces of element kernels as text: the layout of a tile, a list of lines, and the terms that kernels share.

`zsdt.solid.codegen` puts them together and says what the mathematics is.
"""

from __future__ import annotations

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
