"""What the measured data say of a choice in a scene that was not measured: milliseconds of a frame, and errors.

Times: every part of a frame grows with the size of what it works on, `a + b * size`, fitted with non-negative a and b
to all rows, in units of the reference work of the machine. Errors: a clip is hard or easy as a whole, a choice good or
bad as a whole, so `log error = clip + choice`, by least squares over the clips of the scene's motion (over all where
it is not known); a scene is as hard as these are in the geometric mean.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy.optimize import nnls

from zsdt.errors import DataError
from zsdt.planning.choices import BeamChoice, Choice, GlassChoice

BEAM_FIELDS = ("position", "velocity", "stress", "von_mises")
GLASS_FIELDS = ("position", "velocity")


@dataclass(frozen=True)
class Expected:
    """What a choice is expected to do: frame_ms on average, look_ms in a frame with a look, errors [-] by field and
    their worst measured."""

    frame_ms: float
    look_ms: float
    errors: dict[str, float]
    worst: dict[str, float]


@dataclass(frozen=True)
class BeamSizes:
    """length, width, height, pitch [m]; fps; wave [m/s]: sqrt(E / rho). motion: of the measured clips that count, empty
    for all."""

    length: float
    width: float
    height: float
    pitch: float
    fps: float
    wave: float
    motion: str = ""

    def bricks(self, choice: BeamChoice) -> float:
        """Cells of the graph."""
        cell = self.pitch / choice.cells
        layers = 1.0 if choice.one_layer else self.width / cell
        return self.length / cell * layers * self.height / cell

    def nodes(self, choice: BeamChoice) -> float:
        """Nodes of the graph."""
        cell = self.pitch / choice.cells
        layers = 1.0 if choice.one_layer else self.width / cell
        return (self.length / cell + 1.0) * (layers + 1.0) * (self.height / cell + 1.0)

    def points(self, choice: BeamChoice) -> float:
        """Tracked nodes."""
        stride = self.pitch * max(1.0 / choice.cells, 1.0)
        return (self.length / stride + 1.0) * (self.height / stride + 1.0)

    def substeps(self, choice: BeamChoice) -> float:
        """In proportion to the sub-steps of a frame: a wave through a cell."""
        return self.wave * choice.cells / (self.pitch * self.fps)


@dataclass(frozen=True)
class GlassSizes:
    """volume [m3] of the liquid, fps. motion: not known of glasses, empty."""

    volume: float
    fps: float
    motion: str = ""

    def work(self, choice: GlassChoice) -> float:
        """In proportion to particles times sub-steps of a frame."""
        spacing = (self.volume / choice.particles) ** (1.0 / 3.0)
        return 1e-3 * choice.particles * choice.sound / (spacing * self.fps)


Sizes = BeamSizes | GlassSizes
BEAM_PARTS: dict[str, Callable[[Any, Any], float]] = {
    "predict": lambda sizes, choice: sizes.bricks(choice) * sizes.substeps(choice),
    "track": lambda sizes, choice: sizes.points(choice),
    "correct": lambda sizes, choice: sizes.nodes(choice),
    "decode": lambda sizes, choice: sizes.bricks(choice),
    "trust": lambda sizes, choice: sizes.nodes(choice),
}
GLASS_PARTS: dict[str, Callable[[Any, Any], float]] = {
    "predict": lambda sizes, choice: sizes.work(choice),
    "segment": lambda sizes, choice: 0.0,
    "observe": lambda sizes, choice: choice.particles,
    "correct": lambda sizes, choice: choice.particles,
    "decode": lambda sizes, choice: choice.particles,
    "trust": lambda sizes, choice: choice.particles,
}
LOOKS = ("track", "segment", "observe", "correct")  # parts of a frame that is looked at


class Measured:
    """Rows of the measured data and the two fits. known: choices that did not fail on any clip."""

    def __init__(self, rows: pd.DataFrame, kind: str):
        """kind: beam or glass. Raises: DataError where there are no usable rows."""
        self.kind = kind
        self.parts = BEAM_PARTS if kind == "beam" else GLASS_PARTS
        self.fields = BEAM_FIELDS if kind == "beam" else GLASS_FIELDS
        done = rows["reason"].isna() | (rows["reason"] == "")
        failed = {self._choice(row) for _, row in rows[~done].iterrows()}
        rows = rows[done]
        if rows.empty:
            raise DataError(
                f"The measured data of a {kind} hold no run; make them with `python -m pipelines.plan --measure`."
            )
        self.rows = rows.reset_index(drop=True)
        self.choices = [self._choice(row) for _, row in self.rows.iterrows()]
        self.known = tuple(choice for choice in dict.fromkeys(self.choices) if choice not in failed)
        self.reference_ms = float(self.rows["reference_ms"].median())
        self._times = {part: self._fit_time(part) for part in self.parts}
        self._errors: dict[tuple[str, str], tuple[dict[str, float], dict[Any, float]]] = {}

    def _choice(self, row: Any) -> BeamChoice | GlassChoice:
        if self.kind == "beam":
            return BeamChoice(float(row["cells"]), bool(row["one_layer"]), int(row["look_every"]))
        return GlassChoice(int(row["particles"]), float(row["sound"]), int(row["look_every"]))

    def sizes(self, row: Any) -> Sizes:
        """Of a measured row."""
        if self.kind == "beam":
            length, width, height, pitch = (float(row[n]) for n in ("length", "width", "height", "pitch"))
            return BeamSizes(length, width, height, pitch, float(row["fps"]), float(row["wave"]))
        return GlassSizes(float(row["volume"]), float(row["fps"]))

    def typical(self, name: str) -> float:
        """Median of a column over the clips."""
        return float(self.rows.drop_duplicates("clip")[name].median())

    # ---- times ------------------------------------------------------------------------------------------------

    def _fit_time(self, part: str) -> Float[np.ndarray, "2"]:
        size = self.parts[part]
        x = np.array([size(self.sizes(row), c) for c, (_, row) in zip(self.choices, self.rows.iterrows(), strict=True)])
        y = (self.rows.get(f"{part}_ms", 0.0) / self.rows["reference_ms"]).to_numpy(float)
        weight = 1.0 / np.maximum(y, 0.05 * max(float(y.max()), 1e-12))  # relative errors count
        found, _ = nnls(np.column_stack([weight, weight * x]), weight * y)
        return np.asarray(found)

    def milliseconds(self, sizes: Sizes, choice: Choice, fields: Sequence[str], speed: float = 1.0) -> dict[str, float]:
        """Time [ms] of each part of a frame in which it is done. speed: of the machine over that of the data."""
        found = {}
        for part, size in self.parts.items():
            fixed, growth = self._times[part]
            found[part] = float(fixed + growth * size(sizes, choice)) * self.reference_ms / speed
        if self.kind == "beam" and not {"stress", "von_mises"} & set(fields):
            found["decode"] = 0.0  # positions and velocities are there
        return found

    # ---- errors -----------------------------------------------------------------------------------------------

    def _effects(self, field: str, motion: str) -> tuple[dict[str, float], dict[Any, float]]:
        """Effects of the clips and of the choices on the logarithm of the error, in clips of this motion."""
        if (field, motion) not in self._errors:
            self._errors[field, motion] = self._fit_errors(field, motion)
        return self._errors[field, motion]

    def _fit_errors(self, field: str, motion: str) -> tuple[dict[str, float], dict[Any, float]]:
        counted = np.flatnonzero((self.rows["regime"] == motion) | (motion == ""))
        if not len(counted):
            raise DataError(f"No clip of the motion '{motion}' was measured; leave budget.motion away.")
        clips, choices = [self.rows["clip"][k] for k in counted], [self.choices[k] for k in counted]
        y = np.log(self.rows[field].to_numpy(float)[counted])
        names, kinds = list(dict.fromkeys(clips)), list(dict.fromkeys(choices))
        matrix = np.zeros((len(y), len(names) + len(kinds)))
        matrix[np.arange(len(y)), [names.index(c) for c in clips]] = 1.0
        matrix[np.arange(len(y)), [len(names) + kinds.index(c) for c in choices]] = 1.0
        known = np.isfinite(y)
        effect = np.linalg.lstsq(matrix[known], y[known], rcond=None)[0].tolist()
        return dict(zip(names, effect, strict=False)), dict(zip(kinds, effect[len(names) :], strict=True))

    def errors(self, choice: Choice, field: str, motion: str = "") -> tuple[float, float]:
        """Expected error [-] of a field, and the worst that was measured in clips of this motion (all if empty)."""
        clip, effect = self._effects(field, motion)
        if choice not in effect:  # its effect from clips of other motions, how hard a clip is from this one
            everywhere, effect = self._effects(field, "")
            clip = {name: everywhere[name] for name in clip}
        worst = [
            float(error)
            for own, error, regime in zip(self.choices, self.rows[field], self.rows["regime"], strict=True)
            if own == choice and (not motion or regime == motion)
        ]
        if choice not in effect:
            return math.inf, math.inf
        typical = math.exp(float(np.mean(list(clip.values()))) + effect[choice])
        return typical, max(worst, default=typical)

    def expected(self, sizes: Sizes, choice: Choice, fields: Sequence[str], speed: float = 1.0) -> Expected:
        """What a choice does in a scene of these sizes. fields: those with a measured error."""
        parts = self.milliseconds(sizes, choice, fields, speed)
        whole = sum(parts.values())
        looks = sum(parts.get(part, 0.0) for part in LOOKS)
        both = {field: self.errors(choice, field, sizes.motion) for field in fields}
        return Expected(
            whole - looks * (1.0 - 1.0 / choice.look_every), whole,
            {field: e[0] for field, e in both.items()}, {field: e[1] for field, e in both.items()},
        )  # fmt: skip


def shipped_data(kind: str) -> Measured:
    """The measured data that come with the package, kind: beam or glass.

    Raises: DataError where there are none.
    """
    return Measured(read_data(kind), kind)


def read_data(kind: str) -> pd.DataFrame:
    """The rows that come with the package."""
    found = resources.files("zsdt.planning") / "data" / f"{kind}.csv"
    if not found.is_file():
        raise DataError(
            f"No measured data of a {kind} come with this package; make them with `python -m pipelines.plan --measure`."
        )
    return read_rows(Path(str(found)))


def read_rows(path: Path) -> pd.DataFrame:
    """Rows that `zsdt.planning.cases.write_rows` wrote. Raises: DataError where there are none."""
    if not path.is_file():
        raise DataError(f"There are no rows in {path}; make them with `python -m pipelines.plan`.")
    return pd.read_csv(path, comment="#")


def mean_frame_ms(row: Mapping[str, Any], parts: Sequence[str], decodes: bool = True) -> float:
    """Milliseconds of a frame of a measured row on average over frames with and without a look."""
    looks = sum(float(row[f"{part}_ms"]) for part in parts if part in LOOKS)
    rest = sum(float(row[f"{part}_ms"]) for part in parts if part not in LOOKS and (decodes or part != "decode"))
    return rest + looks / float(row["look_every"])
