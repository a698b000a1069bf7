"""Weights of finished jobs go into a package folder, with a card that is written from the manifests."""

import json
from pathlib import Path

import pytest

from pipelines.ship import NOTE, keep_limits, main, note_limits, ship
from pipelines.store import MANIFEST
from zsdt.errors import DataError
from zsdt.shipped import LARGEST, PARTS
from zsdt.twin.trust_limits import TrustLimits, load_limits


def job(root: Path, name: str, parts: tuple[str, ...], status: str = "finished", size: int = 10) -> Path:
    folder = root / "runs" / name
    folder.mkdir(parents=True)
    stages, figures = {}, {}
    for part in parts:
        artifact = root / "artifacts" / f"train_{part}" / name
        artifact.mkdir(parents=True)
        (artifact / "weights.pt").write_bytes(b"w" * size)
        (artifact / "training.csv").write_text("step\n")
        card = {
            "key": name, "git_commit": "0123456789abcdef", "machine": "Linux", "wall_seconds": 60.0,
            "config": {part: {"width": 48}}, "figures": {"error": 0.125},
        }  # fmt: skip
        (artifact / MANIFEST).write_text(json.dumps(card))
        stages[f"train_{part}"] = {"artifact": f"../../artifacts/train_{part}/{name}", "key": name}
        figures[f"train_{part}"] = {"error": 0.125}
    summary = {"status": status, "experiment": name, "overrides": [], "stages": stages, "figures": figures}
    (folder / "summary.json").write_text(json.dumps(summary))
    return folder


def test_each_part_comes_from_the_first_job_that_has_it(tmp_path: Path) -> None:
    jobs = [job(tmp_path, "beams", ("tignn", "psi_ini")), job(tmp_path, "eyes", ("vision", "tignn"))]
    folder = ship("foam", jobs, tmp_path / "weights")
    assert sorted(p.name for p in folder.iterdir()) == ["MODEL_CARD.md", *sorted(PARTS)]
    assert [p.name for p in (folder / "tignn").iterdir()] == ["weights.pt"]  # not what only a run needs
    card = (folder / "MODEL_CARD.md").read_text()
    assert "experiment=beams`, stage `train_tignn`" in card and "experiment=eyes`, stage `train_vision`" in card
    assert "| error | 0.125 |" in card and "- tignn.width: 48" in card


def test_shipping_again_replaces_and_a_failure_leaves_what_was_there(tmp_path: Path) -> None:
    weights = tmp_path / "weights"
    ship("foam", [job(tmp_path, "first", PARTS)], weights)
    ship("foam", [job(tmp_path, "second", PARTS)], weights)
    assert "artifact second" in (weights / "foam" / "MODEL_CARD.md").read_text()
    with pytest.raises(DataError, match=r"at most 2 MB"):
        ship("foam", [job(tmp_path, "heavy", PARTS, size=LARGEST + 1)], weights)
    assert "artifact second" in (weights / "foam" / "MODEL_CARD.md").read_text()
    assert [p.name for p in weights.iterdir()] == ["foam"]


def test_what_cannot_be_shipped_is_said_in_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(DataError, match="one finished job"):
        ship("foam", [job(tmp_path, "killed", PARTS, status="running")], tmp_path / "weights")
    with pytest.raises(DataError, match="None of the jobs has run train_vision"):
        ship("foam", [job(tmp_path, "blind", ("tignn", "psi_ini"))], tmp_path / "weights")
    assert main(["foam", str(tmp_path / "nothing")]) == 1
    assert capsys.readouterr().err.startswith("error: ")


def test_limits_of_trust_stay_with_the_same_engine_only(tmp_path: Path) -> None:
    folders = [tmp_path / name / "tignn" for name in ("old", "same", "other")]
    for folder, weights in zip(folders, ("1", "1", "2"), strict=True):
        folder.mkdir(parents=True)
        (folder / "engine.json").write_text(f'{{"weights": {weights}}}')
    TrustLimits.of({"rate": (0.0, 1.0)}, {}, about={"data": "some"}).save(folders[0])
    for folder in folders[1:]:
        keep_limits(folders[0], folder)
    assert load_limits(folders[1]) is not None and load_limits(folders[2]) is None
    card = tmp_path / "same" / "MODEL_CARD.md"
    card.write_text("# Weights\n")
    for _ in range(2):
        note_limits(tmp_path / "same")
    assert card.read_text().count(NOTE) == 1 and '- data: "some"' in card.read_text()
