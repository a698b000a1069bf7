"""The benchmark: methods take turns, the law of growth is found, fronts and ratios are right."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from tests.tignn.conftest import make_body, make_trajectory
from zsdt.errors import OptionError, RunRejected
from zsdt.evaluation.baselines import InertiaBaseline, StaticBaseline
from zsdt.evaluation.bench import Case, clock, measure
from zsdt.evaluation.bench_bodies import beam_of, finer_beam, finer_glass, glass_of
from zsdt.evaluation.bench_cases import Entry, case_of
from zsdt.evaluation.bench_growth import exponents, fit_growth
from zsdt.evaluation.bench_judge import judge
from zsdt.evaluation.bench_ratio import radius_for, with_ratio
from zsdt.evaluation.bench_report import Results, page, with_front, write_report
from zsdt.evaluation.coarse_engines import OtherPitch, OtherSpacing
from zsdt.fluid.vessel import Vessel
from zsdt.tignn.liquid_body import LiquidBody
from zsdt.tignn.options import TignnOptions
from zsdt.trajectory import Body


class Named(StaticBaseline):
    """Nothing moves, but it says when it is asked; takes bodies of `most` nodes, and refuses after `frames`."""

    def __init__(self, name: str, asked: list[str], most: int = 1000, frames: int = 1000):
        self.name, self.asked, self.most, self.frames = name, asked, most, frames

    def prepare(self, body: Body) -> None:
        if body.nodes > self.most:
            raise OptionError("Too large.")

    def start(self, fields, load):
        self.asked.append(self.name)
        self.left = self.frames
        return super().start(fields, load)

    def step(self, state, load, load_next):
        self.left -= 1
        if self.left < 0:
            raise RunRejected("tired", "It does not go on.")
        return super().step(state, load, load_next)


def test_methods_take_turns_on_warm_engines_and_what_does_not_fit_is_left_out() -> None:
    asked: list[str] = []
    trajectory = make_trajectory(make_body())
    engines = {"one": Named("one", asked), "small": Named("small", asked, most=3), "two": Named("two", asked, frames=3)}
    cases = [Case(lambda e=e: e, trajectory, {"method": name}) for name, e in engines.items()]
    rows = measure(cases, rounds=3, frames=5)
    assert asked == ["one"] * 2 + ["two"] * 2 + ["one", "two"] * 3
    assert [(row["method"], row["nodes"], row["timed_frames"]) for row in rows] == [
        ("one", trajectory.body.nodes, 15),
        ("two", trajectory.body.nodes, 9),  # it refused in the fourth frame of each turn
    ]
    assert all(0 < row["ms_p50"] <= row["ms_p95"] for row in rows)


def test_a_clock_stops_where_the_engine_refuses() -> None:
    trajectory = make_trajectory(make_body())
    times, _ = clock(Named("x", [], frames=2), trajectory, 4)
    assert np.isfinite(times[:2]).all() and np.isnan(times[2:]).all()


@pytest.mark.parametrize("exponent", [0.9, 1.07, 2.0])
def test_the_law_of_growth_is_found_whatever_calls_cost_below_it(exponent: float) -> None:
    nodes = np.array([100.0, 300.0, 1000.0, 3000.0, 1e4, 3e4, 1e5])
    law = 2.5 * (nodes / 1000) ** exponent
    overhead = np.where(nodes < 1000, 5.0, 0.0)
    found = fit_growth(nodes, law + overhead)
    assert found.exponent == pytest.approx(exponent, abs=1e-9)
    assert found.at_1000 == pytest.approx(2.5)
    assert found.worst_factor == pytest.approx(1.0) and (found.smallest, found.largest) == (1000, 100000)
    bent = law.copy()
    bent[-1] *= 3.0
    assert fit_growth(nodes, bent).worst_factor > 1.3


def test_growth_without_enough_sizes_is_unknown_and_methods_are_fitted_apart() -> None:
    assert math.isnan(fit_growth(np.array([100.0, 1000.0]), np.array([1.0, 2.0])).exponent)
    rows = [{"scene": "beam", "method": m, "nodes": n, "ms_p50": (n / 1e3) ** b}
            for m, b in (("slow", 1.3), ("fast", 1.0)) for n in (1000, 3000, 10000)]  # fmt: skip
    laws = {row["method"]: row["exponent"] for row in exponents(rows)}
    assert laws == {"slow": pytest.approx(1.3), "fast": pytest.approx(1.0)}


def point(method: str, ms: float, error: float, scene: str = "beam", **more) -> dict:
    errors = {
        f"{name}_rrmse{tail}": error for name in ("displacement", "velocity", "stress") for tail in ("", "_worst")
    }
    card = {"passes": 7, "width": 100, "backend": "eager", "resolution": 1.0, "pitch_m": 0.05, "nodes": 756}
    return {"scene": scene, "regime": "ramp", "method": method, "ms_p50": ms, "ms_p95": ms, "peak_mb": 3.0, "note": "",
            "pairs": 1980, "trained": int(math.isfinite(error)), "trajectories": 2,
            **card, **errors, **more}  # fmt: skip


def test_fronts_are_those_of_each_scene_and_the_untrained_are_on_none() -> None:
    rows = [point("a", 1.0, 0.5), point("b", 2.0, 0.1), point("c", 3.0, 0.2), point("d", 0.5, math.nan),
            point("e", 9.0, 0.9, scene="glass"), point("static", 0.1, 1.0, scene="glass")]  # fmt: skip
    assert [row["front"] for row in with_front(rows)] == [1, 1, 0, 0, 1, 0]


def test_ratio_is_the_seeds_time_over_that_of_the_row() -> None:
    rows = with_ratio([{"method": "exact", "ms_p50": 4.0}, {"method": "seed_literal", "ms_p50": 30.0}])
    assert [row["times_faster"] for row in rows] == [7.5, 1.0]


def test_the_page_shows_the_worst_row_and_marks_a_missed_exponent(tmp_path: Path) -> None:
    points = with_front([point("good", 1.0, 0.01), point("bad", 9.0, 2.5)])
    ratio = [{"graph": "beam", "nodes": 756, "pairs": 1980, **row} for row in with_ratio(
        [point("exact, 9 steps", 10.0, 0.02, steps=9, cpu_minutes=0.5), point("seed_literal", 90.0, 0.3)])]  # fmt: skip
    growth = [{"scene": "beam", "method": "good", "nodes": n, "ms_p50": (n / 1e3) ** 1.4, "peak_mb": 1.0}
              for n in (1000, 3000, 10000)]  # fmt: skip
    results = Results(points, ratio, growth, exponents(growth), [])
    text = page(results, "Made by a test.")
    lines = text.splitlines()
    order = [k for k, line in enumerate(lines) if line.startswith(("| good *", "| bad"))]
    assert len(order) == 2 and "250 (250)" in lines[order[1]] and "| bad |" in lines[order[1]]
    assert "| 1.4 (!) |" in text
    assert "| exact, 9 steps | 10 / 10 | 9 |" in text
    assert write_report(tmp_path, results, "Made by a test.").read_text() == text
    for name in ("bench_pareto.png", "bench_memory.png", "bench_growth.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "bench_points.csv").read_text().count("\n") == 3


@pytest.mark.parametrize("nodes", [100, 3000])
def test_bodies_have_the_size_and_the_mass_that_they_say(nodes: int) -> None:
    beam, glass = beam_of(nodes).body, glass_of(nodes).body
    for body in (beam, glass):
        assert 0.7 * nodes < body.nodes < 1.4 * nodes
    volume = np.ptp(beam.points, axis=0).prod()
    assert beam.material is not None and beam.mass.sum() == pytest.approx(beam.material.density * volume)
    assert glass.vessel is not None and Vessel(glass.vessel).distance(glass.points).min() > 0
    finer = [finer_beam(n).body.mass.sum() for n in (300, 3000)] + [1.0]
    assert finer[0] == pytest.approx(finer[1], rel=0.25)
    liquids = [finer_glass(n).body for n in (1000, 9000)]
    assert liquids[0].mass.sum() == pytest.approx(liquids[1].mass.sum(), rel=0.15)
    assert liquids[0].pitch > 2 * liquids[1].pitch


def test_the_radius_gives_the_asked_number_of_pairs() -> None:
    trajectory = glass_of(1000)
    options = radius_for(trajectory, TignnOptions(), 12000)
    found = len(LiquidBody(trajectory.body, options).connect(trajectory.fields["position"][0]).pairs)
    assert found == pytest.approx(12000, rel=0.01)


class Pushed(StaticBaseline):
    """Moves every node as fast as its load says [m/s per N]; keeps what it was told."""

    def prepare(self, body: Body) -> None:
        self.body = body

    def step(self, state, load, load_next):
        self.load = load_next
        return state.but(position=state.fields["position"] + self.body.frame_dt * load_next, velocity=load_next)


@pytest.mark.parametrize("pitch", [0.05, 0.1, 0.2])
def test_another_pitch_keeps_linear_fields_and_the_total_load(pitch: float) -> None:
    trajectory = beam_of(300, pitch=0.1)
    body = trajectory.body
    sizes = np.ptp(body.points, axis=0) / pitch
    engine = OtherPitch(Pushed(), pitch)
    if not np.allclose(sizes, np.round(sizes)):
        assert not engine.applies_to(body)
        with pytest.raises(OptionError, match="does not fit"):
            engine.prepare(body)
        return
    engine.prepare(body)
    draw = np.random.default_rng(0)
    fields = trajectory.at(0) | {"position": body.points + 0.01 * body.points @ draw.normal(size=(3, 3))}
    load = draw.normal(size=(body.nodes, 3))
    state = engine.start(fields, 0 * load)
    assert np.allclose(engine.read(state)["position"], fields["position"], atol=1e-12)  # linear, so also between nodes
    engine.step(state, load, load)
    assert np.allclose(engine.engine.load.sum(0), load.sum(0))
    torque = np.cross(engine.body.points, engine.engine.load).sum(0)
    assert np.allclose(torque, np.cross(body.points, load).sum(0))


def test_another_spacing_carries_the_given_particles_as_its_own_move() -> None:
    """All particles fly with one velocity: so do the carried ones, whatever the spacing, with the same momentum."""
    trajectory = glass_of(400)
    body = trajectory.body
    velocity = np.tile([0.02, -0.01, 0.03], (body.nodes, 1))
    engine = OtherSpacing(InertiaBaseline(), 1.5)
    engine.prepare(body)
    state = engine.start(trajectory.at(0) | {"velocity": velocity}, trajectory.load[0])
    assert engine.body.nodes == round(body.nodes / 1.5**3)
    assert engine.body.mass.sum() == pytest.approx(body.mass.sum())
    after = engine.read(engine.step(state, trajectory.load[0], trajectory.load[1]))
    assert np.allclose(after["velocity"], velocity, atol=1e-9)
    assert np.allclose(after["position"], body.points + body.frame_dt * velocity, atol=1e-9)
    with pytest.raises(OptionError, match="finer"):
        OtherSpacing(InertiaBaseline(), 0.5)


def test_what_no_job_has_judged_is_judged_by_full_rollouts() -> None:
    """A picture in which nothing moves scores 1 in displacement and velocity; what takes no body says nothing."""
    trajectories = [make_trajectory(make_body(), seed=s) for s in (1, 2)]
    found = judge(StaticBaseline, trajectories)
    assert found.trajectories == 2 and found.errors["velocity_rrmse"] == pytest.approx(1.0)
    assert judge(lambda: Named("x", [], most=1), trajectories).errors == {}
    card = case_of(Entry("static", StaticBaseline, {"hand": found}), "beam", "hand", trajectories[0]).card
    assert card["trained"] == 1 and card["velocity_rrmse_worst"] == pytest.approx(1.0)
    assert math.isnan(
        case_of(Entry("static", StaticBaseline, {}), "beam", "hand", trajectories[0]).card["stress_rrmse"]
    )
