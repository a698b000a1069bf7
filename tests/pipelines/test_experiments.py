"""Every experiment composes into the options of the rooms; the smallest one runs, twice, and gives the same bits."""

from __future__ import annotations

import csv
import hashlib
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from pipelines.app import main
from pipelines.registry import APPLICATION
from pipelines.stages import settings_of
from pipelines.sweep import SWEEPS, command_of, parts_of
from zsdt.errors import OptionError
from zsdt.files import data_root

BEAM = (
    "experiment=beam_ci",
    "data.train=2",
    "data.test=1",
    "data.hand_duration=0.1",
    "data.dynamic_duration=0.1",
    "psi_ini.steps=4",
    "psi_ini.extra=0",
    "training.steps=8",
    "training.check_every=4",
    "lab.frames=12",
    "vision.images=3",
    "vision.steps=2",
    "vision.check_every=2",
)
GLASS = (
    "experiment=glass_ci",
    "stages=[evaluate]",  # what comes after it: test_glass_stage
    "data.train=2",
    "data.duration=0.04",
    "psi_ini.steps=4",
    "psi_ini.check_every=4",
    "psi_ini.frames=[0,2]",
    "training.steps=4",
    "training.check_every=2",
    "rivals.black_box=null",
    "baselines=[static,coarse_sph]",
)


@pytest.mark.parametrize("name", APPLICATION.experiments())
def test_every_experiment_composes(name: str) -> None:
    config = APPLICATION.compose([f"experiment={name}"])
    assert config.name == name
    settings_of(config, [str(part) for part in config])
    APPLICATION.planner().check(config)


def test_every_sweep_composes() -> None:
    for file in SWEEPS.glob("*.yaml"):
        for overrides in parts_of(file.stem).values():
            APPLICATION.check(overrides, multirun=True)
            assert command_of(overrides, Path("x"), [])[4] == "hydra/launcher=side_by_side"


@pytest.mark.parametrize("part", ["beam_factors", "glass_factors"])
def test_the_sweep_has_at_least_two_values_of_each_factor(part: str) -> None:
    factors = {w.partition("=")[0]: w.partition("=")[2].split(",") for w in parts_of("all")[part]}
    assert all(len(factors[name]) >= 2 for name in ("tignn.passes", "tignn.lambda_d", "training.noise"))


@pytest.mark.parametrize("group", ["launcher", "sweeper"])
def test_every_launcher_and_sweeper_composes(group: str) -> None:
    for file in (APPLICATION.conf / "hydra" / group).glob("*.yaml"):
        APPLICATION.compose([f"hydra/{group}={file.stem}"])


def test_a_rival_with_a_mistyped_key_is_found_before_anything_runs() -> None:
    with pytest.raises(OptionError, match=r"rivals\.black_box\.tign'; did you mean tignn"):
        APPLICATION.check(["experiment=beam_ci", "+rivals.black_box.tign.passes=3"], multirun=False)


def keys(*overrides: str) -> dict[str, str]:
    """Artifact keys of the tasks of a config."""
    return {task.label: task.key for task in APPLICATION.planner().plan(APPLICATION.compose(overrides))}


def test_a_sweep_shares_what_its_factors_do_not_touch() -> None:
    form = ("experiment=beam_laptop", "tignn.form=node", "tignn.bracket=soft", "rivals.seed_form=null")
    jobs = [
        keys(*form, f"tignn.passes={p}", f"tignn.lambda_d={w}", f"training.noise={n}")
        for p, w, n in itertools.product((4, 8), (5, 50), (3e-3, 3e-2))
    ]
    assert len({job["synthesize"] for job in jobs}) == len({job["train_psi_ini"] for job in jobs}) == 1
    assert len({job["train_tignn"] for job in jobs}) == 8
    assert len({job["train_tignn.black_box"] for job in jobs}) == 4, "a black box has no penalty for lambda_d to weigh"


def test_options_that_are_switched_off_do_not_count() -> None:
    cell = keys("experiment=beam_laptop")["train_tignn"]
    assert keys("experiment=beam_laptop", "tignn.passes=3", "training.noise=0.5")["train_tignn"] == cell
    assert keys("experiment=beam_laptop", "tignn.cell.hidden=3")["train_tignn"] != cell
    assert keys("experiment=beam_laptop", "training.seed=3")["train_tignn"] != cell


def test_missing_data_of_others_are_named(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    where = f"data.path={tmp_path}/nothing"
    assert main(APPLICATION, [f"machine.outputs={tmp_path}", "experiment=abaqus_beam", where]) == 1
    error = capfd.readouterr().err.strip()
    assert error.startswith("error: There is nothing at") and "set data.path" in error and "\n" not in error


def test_the_place_of_foreign_data_does_not_count(tmp_path: Path) -> None:
    source = data_root() / "abaqus_beams" / "abaqus_beams_dev.h5"
    if not source.is_file():
        pytest.skip(f"{source} is not here; set ZSDT_DATA.")
    (tmp_path / source.name).symlink_to(source)
    assert keys("experiment=abaqus_beam") == keys("experiment=abaqus_beam", f"data.path={tmp_path / source.name}")


def leaves(node: Any) -> Iterator[torch.Tensor]:
    """All tensors in a file of weights."""
    if isinstance(node, dict):
        for name in sorted(node):
            yield from leaves(node[name])
    elif isinstance(node, torch.Tensor):
        yield node


def digests(outputs: Path) -> dict[str, str]:
    """Hash of everything that must repeat bit by bit: weights, fields, and metrics without the clock."""
    found = {}
    for path in sorted((outputs / "artifacts").rglob("*")):
        name = str(path.relative_to(outputs))
        if path.suffix == ".pt":  # the archive around the numbers names the file that it was written to
            weights = torch.load(path, weights_only=True)
            found[name] = hashlib.sha256(b"".join(leaf.numpy().tobytes() for leaf in leaves(weights))).hexdigest()
        if path.suffix == ".h5" or path.name == "errors_over_time.csv":
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
        if path.name == "metrics.csv":
            with path.open() as lines:
                rows = [{k: v for k, v in row.items() if "ms" not in k.split("_")} for row in csv.DictReader(lines)]
            found[name] = repr(rows)
    return found


@pytest.mark.parametrize(("tiny", "trajectories"), [(BEAM, 7), (GLASS, 5)])
def test_the_smallest_experiment_runs_from_end_to_end_and_repeats_bit_by_bit(
    tmp_path: Path, tiny: tuple[str, ...], trajectories: int
) -> None:
    for name, workers in (("first", 2), ("second", 1)):
        (tmp_path / name).mkdir()
        assert main(APPLICATION, [f"machine.outputs={tmp_path / name}", f"machine.workers={workers}", *tiny]) == 0
    first, second = digests(tmp_path / "first"), digests(tmp_path / "second")
    kinds = {Path(name).name for name in first}
    assert {"weights.pt", "metrics.csv", "errors_over_time.csv"} <= kinds
    assert sum(name.endswith(".h5") for name in first) == trajectories
    assert first == second
    assert list((tmp_path / "first" / "artifacts").rglob("*.rrd"))
