"""Each kind of scene goes through the same stages with its own rooms behind them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipelines.app import main
from pipelines.kinds import kind_of, kinds
from pipelines.registry import APPLICATION
from pipelines.stages import settings_of
from zsdt.errors import OptionError
from zsdt.lab.beam_lab import BeamLabOptions
from zsdt.lab.glass_lab import GlassLabOptions
from zsdt.perception.camera import Camera
from zsdt.twin.glass_scene import GlassTwinScene

GROUPS = ("lab", "vision", "scene", "twin", "twin_evaluation")


def test_options_say_which_kind_of_scene_they_belong_to() -> None:
    assert kind_of(BeamLabOptions()).name == "beam"
    assert kind_of(GlassLabOptions(), GlassTwinScene()).weights == "glycerin_glass"
    with pytest.raises(OptionError, match=r"mixes scenes \(beam and glass\)"):
        kind_of(BeamLabOptions(), GlassTwinScene())
    names = [kind.name for kind in kinds()]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("name", APPLICATION.experiments())
def test_no_experiment_mixes_kinds(name: str) -> None:
    config = APPLICATION.compose([f"experiment={name}"])
    if config.lab is not None:
        chosen = settings_of(config, GROUPS)
        kind_of(*(part for part in vars(chosen).values() if part is not None))


def test_a_scene_of_one_kind_before_a_twin_of_another_is_refused_before_anything_runs(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    words = [f"machine.outputs={tmp_path}", "experiment=beam_demo", "scene=glass"]
    assert main(APPLICATION, words) == 1
    assert "mixes scenes (beam and glass)" in capfd.readouterr().err
    assert not list(tmp_path.rglob("index.csv"))


def test_a_painted_clip_of_a_glass_does_not_depend_on_how_many_liquids_were_trained_on() -> None:
    def key(*words: str) -> str:
        plan = APPLICATION.planner().plan(APPLICATION.compose(["experiment=glass_laptop", "stages=[film]", *words]))
        return {task.label: task.key for task in plan}["film"]

    assert key() == key("data.train=7")
    assert key() != key("lab.fps=50")
    assert key() != key("lab.camera=raytrace")


def test_a_camera_that_knows_only_its_lens_is_put_where_the_options_say() -> None:
    matrix = np.array([[900.0, 0.0, 319.5], [0.0, 900.0, 199.5], [0.0, 0.0, 1.0]])
    lens = Camera(matrix, np.zeros(5), np.eye(3), np.zeros(3), 640, 400)
    options = settings_of(APPLICATION.compose(["experiment=glass_demo", "twin.distance=0.5"]), ["twin"]).twin
    (glass,) = (kind for kind in kinds() if kind.name == "glass")
    placed = glass.placed(lens, options)
    assert np.allclose(placed.center, [0.0, -0.5, options.height])
    foot, higher, right = placed.project(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.05], [0.03, 0.0, 0.0]]))
    assert foot[0] == pytest.approx(319.5) and higher[1] < foot[1] and right[0] > foot[0]
    assert glass.placed(placed, options) is placed
