"""Plans from made-up data whose laws are known: the choice is the best there is, the words say why, and no is said."""

import numpy as np
import pandas as pd
import pytest

from zsdt.errors import OptionError, RunRejected
from zsdt.planning.budget import Budget, Motion
from zsdt.planning.choices import BEAM_CHOICES, BeamChoice, GlassChoice, cadence
from zsdt.planning.models import BeamSizes, GlassSizes, Measured
from zsdt.planning.planner import plan_beam, plan_glass
from zsdt.twin.glass_scene import GlassTwinScene
from zsdt.twin.twin_scene import BeamTwinScene

FAST, SLOW = 2.0, 4.0  # ms of the reference work on two machines
SIZES = {"a": (0.4, 0.1, 0.1), "b": (0.6, 0.2, 0.2), "c": (0.8, 0.2, 0.1), "d": (0.6, 0.1, 0.1)}
HARD = {"a": 1.0, "b": 2.0, "c": 0.5, "d": 1.5}
CHOICES = (*BEAM_CHOICES, *(BeamChoice(0.5, False, k) for k in (1, 2, 4)))
MOTION = {"a": "hand", "b": "dynamic", "c": "hand", "d": "dynamic"}


def error_law(choice, clip):
    """Fine cells are better, few looks worse."""
    return 0.1 * HARD[clip] * choice.cells**-0.5 * choice.look_every**0.5 * (0.8 if choice.one_layer else 1.0)


def made_up(skip=()):
    rows = []
    for number, (clip, (length, width, height)) in enumerate(SIZES.items()):
        machine = FAST if number % 2 else SLOW
        sizes = BeamSizes(length, width, height, 0.05, 60.0, 50.0)
        for choice in CHOICES:
            if (clip, choice) in skip:
                continue
            ms = {
                "predict": 0.2 + 1e-3 * sizes.bricks(choice) * sizes.substeps(choice),
                "track": 1.0 + 0.02 * sizes.points(choice), "correct": 0.5 + 1e-3 * sizes.nodes(choice),
                "decode": 5e-4 * sizes.bricks(choice), "trust": 0.1,
            }  # fmt: skip
            error = error_law(choice, clip)
            rows.append(
                {"clip": clip, "regime": MOTION[clip], "length": length, "width": width, "height": height,
                 "pitch": 0.05, "fps": 60.0, "wave": 50.0, "reference_ms": machine, "reason": "", **choice.columns(),
                 **{f"{part}_ms": value * machine / FAST for part, value in ms.items()},
                 "position": error, "velocity": 3 * error, "stress": 2 * error, "von_mises": 2 * error}
            )  # fmt: skip
    return Measured(pd.DataFrame(rows), "beam")


@pytest.fixture(scope="module")
def data():
    return made_up()


def scene(**more):
    return BeamTwinScene(width=0.2, fps=60.0, **more)


def test_the_fits_find_the_laws_on_both_machines(data):
    sizes = BeamSizes(0.7, 0.3, 0.2, 0.05, 60.0, 50.0)
    choice = BeamChoice(2.0, True, 2)
    found = data.milliseconds(sizes, choice, ["stress"], speed=data.reference_ms / FAST)
    assert found["predict"] == pytest.approx(0.2 + 1e-3 * sizes.bricks(choice) * sizes.substeps(choice))
    assert found["track"] == pytest.approx(1.0 + 0.02 * sizes.points(choice))
    hardness = np.exp(np.mean(np.log(list(HARD.values()))))
    assert data.errors(choice, "position")[0] == pytest.approx(0.1 * hardness * 0.8)
    assert data.errors(choice, "position")[1] == pytest.approx(0.1 * 2.0 * 0.8)
    assert data.errors(choice, "position", "hand")[0] == pytest.approx(0.1 * np.sqrt(0.5) * 0.8)


def test_a_choice_that_was_not_measured_on_the_easy_clips_is_not_called_hard():
    choice = BeamChoice(0.5, False, 1)
    few = made_up(skip={("a", choice), ("c", choice)})
    assert few.errors(choice, "position")[0] == pytest.approx(made_up().errors(choice, "position")[0])


def test_a_choice_that_failed_on_any_clip_is_not_offered(data):
    rows = data.rows.copy()
    first = plan_beam(scene(planar=True), Budget(error=0.25, speed=1.0), data).choice
    broken = [k for k, choice in enumerate(data.choices) if choice == first and rows["clip"][k] == "b"]
    rows.loc[broken, "reason"] = "it had to start again"
    again = plan_beam(scene(planar=True), Budget(error=0.25, speed=1.0), Measured(rows, "beam"))
    assert again.choice != first and first not in [choice for choice, _ in again.offers]


def test_the_cheapest_that_is_good_enough(data):
    plan = plan_beam(scene(planar=True), Budget(error=0.25, frame_ms=50.0, speed=1.0), data)
    good = [o for o in plan.offers if max(o[1].errors.values()) <= 0.25]
    assert plan.expected.frame_ms == min(o[1].frame_ms for o in good)
    assert max(plan.expected.errors.values()) <= 0.25
    assert plan.scene.cell_edge == pytest.approx(0.05 / plan.choice.cells)


def test_the_best_that_is_fast_enough(data):
    plan = plan_beam(scene(planar=True), Budget(frame_ms=4.0, speed=1.0), data)
    assert plan.expected.frame_ms <= 4.0
    within = [max(o[1].errors.values()) for o in plan.offers if o[1].frame_ms <= 4.0]
    assert max(plan.expected.errors.values()) <= 1.03 * min(within)


def test_a_slower_machine_gets_another_plan(data):
    quick = plan_beam(scene(planar=True), Budget(frame_ms=4.0, speed=1.0), data)
    slow = plan_beam(scene(planar=True), Budget(frame_ms=4.0, speed=0.5), data)
    assert slow.expected.frame_ms <= 4.0
    assert max(slow.expected.errors.values()) > max(quick.expected.errors.values())


def test_one_layer_only_where_the_scene_is_planar_and_coarse_cells_only_where_they_fit(data):
    deep = plan_beam(scene(), Budget(error=10.0, speed=1.0), data)
    assert not deep.choice.one_layer and deep.choice.cells == 1.0  # its sizes are not told, so nothing coarser
    told = Budget(error=10.0, speed=1.0, length=0.6, height=0.2)
    assert plan_beam(scene(), told, data).choice.cells == 0.5
    odd = Budget(error=10.0, speed=1.0, length=0.65, height=0.2)
    assert plan_beam(scene(), odd, data).choice.cells == 1.0


def test_fields_without_stress_are_not_charged_for_it(data):
    sizes = BeamSizes(0.6, 0.2, 0.2, 0.05, 60.0, 50.0)
    assert data.milliseconds(sizes, BeamChoice(), ["velocity"])["decode"] == 0.0
    assert data.milliseconds(sizes, BeamChoice(), ["velocity", "stress"])["decode"] > 0.0


def test_impossible_budgets_are_refused_with_what_would_be_possible(data):
    with pytest.raises(RunRejected, match=r"No twin was measured that meets an error of 0.1 %.*least error is") as no:
        plan_beam(scene(), Budget(error=0.001, speed=1.0), data)
    assert no.value.cause == "budget"
    with pytest.raises(RunRejected, match=r"0.01 ms a frame.*the fastest is"):
        plan_beam(scene(), Budget(frame_ms=0.01, speed=1.0), data)
    with pytest.raises(RunRejected, match=r"Within the time the least error is.*Good enough at the least time"):
        plan_beam(scene(planar=True), Budget(error=0.15, frame_ms=2.5, speed=1.0), data)


def test_what_cannot_be_planned_is_said(data):
    with pytest.raises(OptionError, match="needs a budget"):
        plan_beam(scene(), Budget(), data)
    with pytest.raises(OptionError, match="elastic_energy was never measured"):
        plan_beam(scene(fields=["elastic_energy"]), Budget(error=0.1), data)
    with pytest.raises(OptionError, match="must be positive"):
        Budget(error=-1.0)


def test_the_motion_counts(data):
    budget = Budget(error=0.2, speed=1.0, motion=Motion.hand)
    calm = plan_beam(scene(planar=True), budget, data)
    wild = plan_beam(scene(planar=True), Budget(error=0.2, speed=1.0, motion=Motion.dynamic), data)
    assert calm.expected.frame_ms < wild.expected.frame_ms


def test_words_name_the_choice_its_price_and_what_more_would_cost(data):
    words = plan_beam(scene(planar=True), Budget(error=0.3, speed=1.0), data).words
    assert "planar (one cell wide)" in words and "ms" in words and "% of von_mises" in words
    assert "would cost" in words and cadence(2) == "a look at every 2nd frame" and cadence(1) in "a look at every frame"


def test_glasses_are_planned_by_their_particles():
    rows = []
    for clip, volume in (("a", 1e-4), ("b", 3e-4)):
        for particles in (150, 600):
            choice, sizes = GlassChoice(particles), GlassSizes(volume, 60.0)
            parts = {
                "predict": 3.0 * sizes.work(choice),
                "segment": 20.0,
                "observe": 1.0,
                "correct": 1.0,
                "decode": 1.0,
            }
            rows.append(
                {"clip": clip, "regime": "bowl", "volume": volume, "fps": 60.0, "reference_ms": 1.0, "reason": "",
                 **choice.columns(), **{f"{n}_ms": v for n, v in parts.items()}, "position": 6.0 / particles,
                 "velocity": 60.0 / particles}
            )  # fmt: skip
    data = Measured(pd.DataFrame(rows), "glass")
    rough = plan_glass(GlassTwinScene(), Budget(error=0.5, speed=1.0), data)
    fine = plan_glass(GlassTwinScene(), Budget(error=0.2, speed=1.0), data)
    assert (rough.scene.particles, fine.scene.particles) == (150, 600)
    assert fine.expected.errors["velocity"] == pytest.approx(0.1)
