"""The command that plans, and what a planned twin is given: nothing that the scene did not ask for."""

from types import SimpleNamespace

import pytest

from pipelines import beam_kind, footage, glass_kind, plan
from pipelines.options import GlassTwinRun, TwinRun
from tests.planning.test_planner import made_up
from zsdt.planning import planner
from zsdt.planning.budget import Budget
from zsdt.planning.choices import BeamChoice, GlassChoice
from zsdt.twin.field_scale import LiquidName, ShownName
from zsdt.twin.glass_scene import GlassTwinScene
from zsdt.twin.loop_common import LoopMode
from zsdt.twin.twin_scene import BeamTwinScene


@pytest.fixture
def data(monkeypatch):
    monkeypatch.setattr(planner, "shipped_data", lambda kind: made_up())


def test_the_command_prints_a_plan(data, capsys):
    assert plan.main(["scene=foam_beam", "scene.planar=true", "budget.error=0.5", "budget.speed=1"]) == 0
    assert "% of von_mises" in capsys.readouterr().out


def test_the_command_says_what_cannot_be(data, capsys):
    assert plan.main(["scene=foam_beam", "budget.error=0.0001", "budget.speed=1"]) == 1
    assert "No twin was measured that meets an error of 0.01 %" in capsys.readouterr().err
    assert plan.main(["scene=null", "budget.error=0.1"]) == 1
    assert "~scene leaves it out" in capsys.readouterr().err
    assert plan.main(["experiment=abaqus_beam", "budget.error=0.1"]) == 1
    assert "nothing to plan for" in capsys.readouterr().err
    assert plan.main(["scene=foam_beam", "budget.eror=0.1"]) == 1
    assert "did you mean budget.error" in capsys.readouterr().err


def test_a_budget_belongs_to_the_key_only_where_it_is_planned_by():
    read = {"scene": {}, "twin": {"video": None, "camera": None, "plan": False}, "budget": {"error": 0.1}}
    assert "budget" not in footage.narrow(read)
    planned = footage.narrow({**read, "twin": {**read["twin"], "plan": True}})
    assert planned["budget"] == {"error": 0.1}


def test_a_planned_twin_draws_the_wanted_field_and_runs_alone():
    chosen = SimpleNamespace(choice=BeamChoice(look_every=4), scene=BeamTwinScene(fields=["velocity", "stress"]))
    twin = beam_kind.as_planned(SimpleNamespace(twin=TwinRun(), budget=Budget()), chosen).twin
    assert twin.loop.look_every == 4 and twin.overlay.field is ShownName.speed
    assert not twin.compare_open and twin.loop.mode is LoopMode.closed
    liquid = SimpleNamespace(choice=GlassChoice(look_every=3), scene=GlassTwinScene(fields=["internal_energy"]))
    glass = glass_kind.as_planned(SimpleNamespace(twin=GlassTwinRun()), liquid).twin
    assert glass.loop.look_every == 3 and glass.overlay.field is LiquidName.internal_energy
    assert not glass.compare_open and glass.backend != "fastest"
