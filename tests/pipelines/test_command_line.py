"""What a person at the terminal gets: one sentence for a mistake, reuse for what was done before."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from fakes import FAKE
from helpers import builds, run

from pipelines.app import main
from zsdt.errors import OptionError


def keys(*overrides: str) -> dict[str, str]:
    """Artifact keys of the tasks of a config."""
    return {task.label: task.key for task in FAKE.planner().plan(FAKE.compose(overrides))}


def test_only_what_a_stage_reads_changes_its_key() -> None:
    base = keys()
    for neutral in (
        "tignn.logger=tensorboard",
        "machine.outputs=elsewhere",
        "machine.workers=7",
        "machine.threads=2",
    ):
        assert keys(neutral) == base
    trained = keys("tignn.lambda_d=50")
    assert trained["numbers"] == base["numbers"]
    assert trained["train"] != base["train"] and trained["evaluate"] != base["evaluate"]
    made = keys("data.count=4")
    assert all(made[name] != base[name] for name in base)
    assert keys("tignn.lambda_d=50.0") == trained


def test_data_of_others_count_by_their_contents(tmp_path: Path) -> None:
    for name, text in (("a", "1"), ("b", "1"), ("c", "2")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "data.txt").write_text(text)
    a, b, c = (keys(f"data.path={tmp_path / name}/data.txt") for name in "abc")
    assert a == b and a["numbers"] != c["numbers"]


def test_warm_start_names_an_experiment_or_a_folder(tmp_path: Path) -> None:
    planned = keys("tignn.warm_start=large")
    assert list(planned)[-4:] == ["large/numbers", "large/train", "train", "evaluate"]
    assert planned["large/train"] == keys("experiment=large")["train"]
    assert planned["train"] != keys()["train"]
    (tmp_path / "weights.txt").write_text("9")
    assert keys(f"tignn.warm_start={tmp_path}")["train"] != planned["train"]
    with pytest.raises(OptionError, match="did you mean large"):
        keys("tignn.warm_start=larg")


def test_a_variant_is_the_artifact_of_the_job_that_has_its_options() -> None:
    planned = keys("+rivals.deep.passes=9")
    assert list(planned) == ["numbers", "train", "train.deep", "evaluate"]
    assert planned["train.deep"] == keys("tignn.passes=9")["train"]
    assert planned["evaluate"] != keys()["evaluate"]


def test_stages_bring_what_they_need() -> None:
    assert list(keys("stages=[evaluate]")) == ["numbers", "train", "evaluate"]
    assert list(keys("stages=[numbers]")) == ["numbers"]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["tignn.pases=4"], "There is no option 'tignn.pases'; did you mean tignn.passes"),
        (["-m", "tignn.pases=4,8"], "There is no option 'tignn.pases'; did you mean tignn.passes"),
        (["experiment=smal"], "There is no experiment 'smal'; did you mean small?"),
        (["tignn.mood=goood"], "The option 'tignn.mood' cannot be used: Invalid value 'goood', expected one of [good"),
        (["tignn.passes=four"], "The option 'tignn.passes' cannot be used: Value 'four'"),
        (["-m", "tignn.passes=4,0"], "There must be at least one pass."),
        (["stages=[trian]"], "There is no stage 'trian'; did you mean train?"),
        (["passes"], "Error parsing override 'passes'; write KEY=VALUE"),
        (["data.path=none.txt"], "Could not read none.txt: No such file or directory"),
        (["tignn.warm_start=larg"], "warm_start=larg is neither an artifact folder nor an experiment"),
        (["tignn.mood=bad"], "The training went badly; choose mood=good."),
    ],
)
def test_a_mistake_is_one_sentence(
    arguments: list[str], sentence: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    code = main(FAKE, [f"machine.outputs={tmp_path}", *arguments])
    error = capfd.readouterr().err.strip()
    assert code == 1
    assert error.startswith(f"error: {sentence}") and "\n" not in error
    assert not any("train" in line for line in builds(tmp_path))


def test_a_full_disk_is_one_sentence(small_disk: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(FAKE, [f"machine.outputs={small_disk}", "tignn.mood=full"]) == 1
    error = capfd.readouterr().err.strip()
    assert error.startswith("error: Could not write") and "No space left on device; free some space" in error
    assert "\n" not in error
    assert main(FAKE, [f"machine.outputs={small_disk}"]) == 0
    assert builds(small_disk).count("numbers") == 1


def test_a_run_leaves_its_config_and_a_repeated_one_computes_nothing(tmp_path: Path) -> None:
    assert main(FAKE, [f"machine.outputs={tmp_path}"]) == 0
    first = builds(tmp_path)
    assert first == ["numbers", "train passes=3 lambda_d=5.0 from=0", "evaluate passes=3"]
    assert main(FAKE, [f"machine.outputs={tmp_path}", "machine.workers=1"]) == 0
    assert builds(tmp_path) == first
    folder = max((tmp_path / "runs").iterdir())
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["status"] == "finished"
    assert (folder / "config.yaml").read_text().startswith("name: small\n")
    for stage in summary["stages"].values():
        manifest = json.loads((folder / stage["artifact"] / "manifest.json").read_text())
        assert {"config", "inputs", "packages", "seed", "wall_seconds", "host", "git_commit", "figures"} <= set(
            manifest
        )


def test_the_command_line_as_a_process(tmp_path: Path) -> None:
    code, out, err = run(tmp_path, "tignn.pases=4")
    assert (code, out) == (1, "") and err.startswith("error: There is no option") and err.count("\n") == 1
