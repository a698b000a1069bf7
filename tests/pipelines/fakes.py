"""A tiny experiment for the tests of the frame: numbers are made, a factor is trained, the result is evaluated.

`python tests/pipelines/fake_app.py ARGS...` is the same command line as `python -m pipelines`, with these stages. Each
real build appends a line to `builds.txt` in the folder of the outputs, which is how tests count.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, DictConfig, OmegaConf

from pipelines.compose import Application
from pipelines.machine import Machine
from pipelines.stages import Stage
from zsdt.errors import DataError, OptionError


class Mood(Enum):
    """What a training does."""

    good = "good"
    bad = "bad"
    full = "full"


@dataclass
class NumbersOptions:
    """How many numbers, and how long making them takes [s]."""

    count: int = 3
    seconds: float = 0.0
    path: str | None = None


@dataclass
class TrainOptions:
    """Options of the fake training."""

    passes: int = 2
    lambda_d: float = 5.0
    mood: Mood = Mood.good
    seconds: float = 0.0
    logger: str = "csv"
    warm_start: str | None = None

    def __post_init__(self) -> None:
        if self.passes < 1:
            raise OptionError("There must be at least one pass.")


@dataclass
class FakeConfig:
    """Root of the fake experiment."""

    name: str = MISSING
    stages: list[str] = field(default_factory=lambda: ["numbers", "train", "evaluate"])
    objective: str = "evaluate.error"
    data: Any = MISSING
    tignn: TrainOptions = field(default_factory=TrainOptions)
    rivals: dict[str, Any] = field(default_factory=dict)
    machine: Machine = field(default_factory=Machine)


def count_build(cfg: SimpleNamespace, what: str) -> None:
    """Leaves a trace that a stage really ran."""
    with (Path(cfg.machine.outputs) / "builds.txt").open("a") as trace:
        trace.write(f"{what}\n")


def numbers(cfg: SimpleNamespace, inputs: dict[str, Path], out: Path, scratch: Path) -> dict[str, Any]:
    """Writes numbers, slowly if asked."""
    time.sleep(cfg.data.seconds)
    print("counting")
    (out / "numbers.txt").write_text("\n".join(str(n) for n in range(cfg.data.count)))
    count_build(cfg, "numbers")
    return {"count": cfg.data.count}


def train(cfg: SimpleNamespace, inputs: dict[str, Path], out: Path, scratch: Path) -> dict[str, Any]:
    """Counts seconds in the scratch folder, so that a killed training goes on where it was."""
    if cfg.tignn.mood is Mood.bad:
        raise DataError("The training went badly; choose mood=good.")
    if cfg.tignn.mood is Mood.full:
        (out / "weights.bin").write_bytes(bytes(64 << 20))
    (scratch / "pid.txt").write_text(str(os.getpid()))
    progress = scratch / "progress.txt"
    start = int(progress.read_text()) if progress.exists() else 0
    for step in range(start, round(10 * cfg.tignn.seconds)):
        time.sleep(0.1)
        progress.write_text(str(step + 1))
    (out / "weights.txt").write_text(str(cfg.tignn.passes))
    count_build(cfg, f"train passes={cfg.tignn.passes} lambda_d={cfg.tignn.lambda_d} from={start}")
    return {"from": start, "warm": "warm_start" in inputs}


def evaluate(cfg: SimpleNamespace, inputs: dict[str, Path], out: Path, scratch: Path) -> dict[str, Any]:
    """Error falls with the passes."""
    passes = int((inputs["train"] / "weights.txt").read_text())
    count_build(cfg, f"evaluate passes={passes}")
    return {"error": 1.0 / passes}


def sources(cfg: SimpleNamespace) -> list[Path]:
    """The file that the numbers come from."""
    return [Path(cfg.data.path)] if cfg.data.path else []


def rivals(config: DictConfig) -> dict[str, DictConfig]:
    """Further trainings with some options changed."""
    found = {}
    for name, changes in config.rivals.items():
        found[str(name)] = config.copy()
        found[str(name)].tignn = OmegaConf.merge(config.tignn, changes)
    return found


STAGES = [
    Stage("numbers", 1, ("data",), numbers, provides="dataset", ignores=("data.path",), sources=sources),
    Stage(
        "train",
        1,
        ("tignn",),
        train,
        inputs=("dataset",),
        ignores=("tignn.logger", "tignn.warm_start"),
        variants=rivals,
        elsewhere=lambda config: {"warm_start": config.tignn.warm_start} if config.tignn.warm_start else {},
    ),
    Stage("evaluate", 1, (), evaluate, inputs=("dataset", "train")),
]


def register() -> None:
    """Schemas of the fake options."""
    store = ConfigStore.instance()
    store.store(name="schema", node=FakeConfig)
    store.store(group="data", name="numbers_schema", node=NumbersOptions)


FAKE = Application(conf=Path(__file__).parent / "fake_conf", stages=STAGES, register=register)
