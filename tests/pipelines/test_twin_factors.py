"""Twins over swept options: which jobs belong together, what their table says, and who has no error."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from made_up import write_json

from pipelines.gather import read_jobs
from pipelines.publish import main
from pipelines.registry import APPLICATION
from pipelines.sweep import parts_of
from pipelines.twin_factors import factor_parts, loop_of, part_text

COLUMNS = "clip,case,survived,reason,level_share,level_mm,vertical_velocity_rrmse,predict_p50_ms\n"
TRAINED = ("synthesize", "train_tignn")
LEVELS = {(3, 5): 0.2, (3, 50): 0.1, (7, 5): 0.08, (7, 50): None}  # None: refused in closed loop


def write_twin(root: Path, name: str, overrides: list[str], level: float | None, form: str = "node") -> None:
    """A finished job of two clips: open loop with twice the error; `level` None: the closed loop was refused."""
    folder, artifact = root / name, root.parents[1] / "artifacts" / "evaluate_twin" / name.replace("/", "_")
    rows = []
    for clip, factor in (("a", 0.5), ("b", 1.5)):
        share = (0.3 if level is None else level) * factor
        rows.append(f"{clip},masks_seed_open,True,,{2 * share},{20 * share},1.0,30.0")
        rows.append(
            f"{clip},masks,{level is not None},{'' if level else 'It flew apart.'},{share},{10 * share},0.9,40.0"
        )
    artifact.mkdir(parents=True)
    (artifact / "clips.csv").write_text(COLUMNS + "\n".join(rows) + "\n")
    write_json(artifact / "manifest.json", {"git_commit": "0123456789abcdef", "machine": "a machine"})
    cases = {"masks_seed_open": {"survived": 2}, "masks": {"survived": 2 if level else 0}}
    stages = {"film": {"key": "film"}, "evaluate_twin": {"artifact": str(artifact)}}
    summary = {"status": "finished", "experiment": "glass_laptop", "overrides": overrides, "stages": stages}
    summary["figures"] = {"evaluate_twin": {"scene": "glass", "clips": 2, **cases, "gains": {"x": {}}}}
    write_json(folder / "summary.json", summary)
    (folder / "config.yaml").write_text(json.dumps({"tignn": {"form": form}}))


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
    root = tmp_path / "outputs" / "multirun" / "2026_all"
    for k, ((passes, weight), level) in enumerate(LEVELS.items()):
        words = ["experiment=glass_laptop", f"tignn.passes={passes}", f"tignn.lambda_d={weight}"]
        write_twin(root, f"factors/{k}", words, level)
    write_twin(root, "reference/0", ["experiment=glass_laptop"], 0.01, "particle")
    return root


def test_jobs_of_a_part_are_told_apart_by_what_they_were_asked(sweep: Path) -> None:
    (part,) = factor_parts(read_jobs(sweep))
    assert (part.name, part.factors) == ("factors", ("tignn.passes", "tignn.lambda_d"))
    assert [job.folder.parent.name for job in part.others] == ["reference"]
    text = part_text(part)
    assert "| passes | lambda_d | case | survived | level % of fill |" in text
    assert "| 3 | 5 | masks | 2/2 | 20 | 2 | 90 | 40 |" in text
    assert "| 7 | 50 | masks | 0/2 | - | - | - | - |" in text and "- 7, 50: b masks: It flew apart." in text
    assert "| particle |  | masks_seed_open | 2/2 | 2 |" in text
    assert part.picture()[:4] == b"\x89PNG"


def test_what_was_refused_is_in_no_mean(sweep: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept: list[dict] = []
    monkeypatch.setattr("pipelines.twin_factors.error_against_factors", lambda rows, *_: kept.extend(rows) or b"")
    factor_parts(read_jobs(sweep))[0].picture()
    closed = [row["error"] for row in kept if row["method"] == "closed loop"]
    assert closed == pytest.approx([0.2, 0.1, 0.08])
    assert len(kept) == 7 and kept[0]["tignn.passes"] == 3
    assert loop_of("masks", ("masks", "columns")) == "masks"


def test_the_page_says_how_it_was_made_and_a_sweep_without_factors_is_refused(
    sweep: Path, tmp_path: Path, capsys
) -> None:
    call = ["--twin-factors", "--outputs", str(tmp_path / "outputs"), "--docs", str(tmp_path / "docs")]
    assert main(["glass_twin_factors", *call, "--readme", str(tmp_path / "none.md")]) == 0
    page = (tmp_path / "docs" / "glass_twin_factors.md").read_text()
    assert "Made by `make sweep` at commit 0123456789ab" in page and "](glass_twin_factors_factors.png)" in page
    assert (tmp_path / "docs" / "glass_twin_factors_factors.png").is_file()
    assert main(["x", *call, "--sweep", str(sweep / "reference")]) == 1
    assert "differ in an option" in capsys.readouterr().err


def first_of(overrides: list[str]) -> list[str]:
    """The first job of a part."""
    return [w if "[" in w else f"{w.partition('=')[0]}={w.partition('=')[2].split(',')[0]}" for w in overrides]


@pytest.mark.parametrize("scene", ["beam", "glass"])
def test_twins_over_factors_take_the_networks_of_the_sweep(scene: str) -> None:
    """All trainings behind the twins are those behind the rollouts, over the same values of all factors."""
    twin = parts_of("twin")["factors" if scene == "beam" else "glass_factors"]
    rollout = parts_of(scene)["factors"]
    for name in ("tignn.passes", "tignn.lambda_d", "training.noise"):
        assert [w for w in twin if w.startswith(name)] == [w for w in rollout if w.startswith(name)] != []
    keys = [
        {task.key for task in APPLICATION.planner().plan(APPLICATION.compose(first_of(part))) if task.label in TRAINED}
        for part in (twin, rollout)
    ]
    assert keys[0] == keys[1] and len(keys[0]) == 2
