"""Chooses the cheapest twin that a scene's budget allows, says why, and refuses where nothing does.

    plan = plan_beam(scene, Budget(error=0.2, frame_ms=5.0))
    print(plan.words)
    run_twin(..., plan.scene, with_cadence(options, plan.choice), ...)

With an error budget the choice is the cheapest that is good enough; with a frame budget alone it is the best that is
fast enough, or one that is nearly as good (`NEARLY`) and cheaper.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from zsdt.errors import DataError, OptionError, RunRejected
from zsdt.planning.budget import Budget, Motion
from zsdt.planning.choices import BeamChoice, Choice, GlassChoice
from zsdt.planning.models import BeamSizes, Expected, GlassSizes, Measured, Sizes, shipped_data
from zsdt.planning.reference import reference_ms

if TYPE_CHECKING:  # a beam needs nothing of a glass
    from zsdt.perception.segmentation import SegmentationBackend
    from zsdt.twin.glass_scene import GlassTwinScene
    from zsdt.twin.twin_scene import BeamTwinScene

NEARLY = 1.03  # times the least error: as good for less


@dataclass(frozen=True)
class Plan:
    """A choice and what it is expected to do. scene: with the choice put in. offers: all choices that the scene
    allows, with what they would do. speed: of this machine over that of the data. words: why, for people."""

    choice: Any
    expected: Expected
    scene: Any
    offers: list[tuple[Any, Expected]]
    speed: float
    words: str

    def figures(self) -> dict[str, Any]:
        """For a manifest."""
        return {
            "words": self.words,
            "choice": self.choice.columns(),
            "frame_ms": self.expected.frame_ms,
            "look_ms": self.expected.look_ms,
            "errors": self.expected.errors,
            "speed": self.speed,
        }


def plan_beam(scene: BeamTwinScene, budget: Budget, data: Measured | None = None) -> Plan:
    """Graph and cadence of a beam's twin. A graph of one layer is only chosen where the scene says that the motion is
    planar; cells that the beam cannot be cut into, never.

    Raises: OptionError where nothing is asked for or the error of a wanted field was never measured; RunRejected
    ("budget") where nothing meets the budget.
    """
    data = data or shipped_data("beam")
    sizes = BeamSizes(
        budget.length or data.typical("length"),
        scene.width,
        budget.height or data.typical("height"),
        scene.pitch,
        scene.fps or data.typical("fps"),
        (scene.material.young / scene.material.density) ** 0.5,
        "" if budget.motion is Motion.any else budget.motion.value,
    )
    told = bool(budget.length and budget.height)
    allowed = [c for c in data.known if isinstance(c, BeamChoice) and _beam_allows(scene, c, sizes, told)]
    return _plan(scene, budget, data, sizes, allowed)


def _beam_allows(scene: BeamTwinScene, choice: BeamChoice, sizes: BeamSizes, told: bool) -> bool:
    """Whether the beam can be cut like that, as far as its sizes are told."""
    if choice.one_layer and not scene.planar:
        return False
    cell = sizes.pitch / choice.cells
    lengths = [] if choice.one_layer else [sizes.width]
    if told:
        lengths += [sizes.length, sizes.height]
    elif choice.cells < 1.0:
        return False  # fine cells fit in any painted grid, coarse ones do not
    return all(abs(x / cell - round(x / cell)) < 0.02 and round(x / cell) >= 1 for x in lengths)


def plan_glass(scene: GlassTwinScene, budget: Budget, data: Measured | None = None) -> Plan:
    """Particles and cadence of a glass's twin. Raises: as `plan_beam`."""
    data = data or shipped_data("glass")
    sizes = GlassSizes(budget.volume or data.typical("volume"), scene.fps or data.typical("fps"))
    allowed = [c for c in data.known if isinstance(c, GlassChoice)]
    return _plan(scene, budget, data, sizes, allowed)


def _plan(scene: Any, budget: Budget, data: Measured, sizes: Sizes, allowed: Sequence[Any]) -> Plan:
    if not budget.is_set:
        raise OptionError("A plan needs a budget: say budget.error=0.1 (RRMSE), budget.frame_ms=10, or both.")
    fields = list(scene.fields)
    unknown = [name for name in fields if name not in data.fields]
    if unknown or not fields:
        raise OptionError(
            f"The error of {unknown[0] if unknown else 'no field'} was never measured in a twin of a {data.kind}, so "
            f"nothing can be planned for it; measured are {', '.join(data.fields)}."
        )
    if not allowed:
        raise DataError(f"None of the measured choices fits this {data.kind}.")
    speed = budget.speed or data.reference_ms / reference_ms()
    offers = [(choice, data.expected(sizes, choice, fields, speed)) for choice in allowed]
    offers.sort(key=lambda offer: offer[1].frame_ms)
    choice, expected = choose(offers, budget, scene)
    words = explain(choice, expected, offers, budget, scene)
    return Plan(choice, expected, choice.scene(scene), offers, speed, words)


def error_of(expected: Expected) -> float:
    """The largest expected error over the wanted fields [-]."""
    return max(expected.errors.values())


def choose(offers: Sequence[tuple[Any, Expected]], budget: Budget, scene: Any) -> tuple[Any, Expected]:
    """The offer that the budget asks for. Raises: RunRejected ("budget") where none meets it."""
    most_error = budget.error if budget.error is not None else float("inf")
    most_ms = budget.frame_ms if budget.frame_ms is not None else float("inf")
    good = [o for o in offers if error_of(o[1]) <= most_error and o[1].frame_ms <= most_ms]
    if not good:
        raise RunRejected("budget", refusal(offers, budget, scene))
    if budget.error is not None:
        return min(good, key=lambda o: (o[1].frame_ms, error_of(o[1])))
    least = min(error_of(o[1]) for o in good)
    return min((o for o in good if error_of(o[1]) <= NEARLY * least), key=lambda o: o[1].frame_ms)


def refusal(offers: Sequence[tuple[Any, Expected]], budget: Budget, scene: Any) -> str:
    """Why no offer meets the budget, and what comes nearest."""
    best = min(offers, key=lambda o: (error_of(o[1]), o[1].frame_ms))
    fastest = min(offers, key=lambda o: o[1].frame_ms)
    asked = []
    if budget.error is not None:
        asked.append(f"an error of {percent(budget.error)}")
    if budget.frame_ms is not None:
        asked.append(f"{budget.frame_ms:.3g} ms a frame")
    text = f"No twin was measured that meets {' and '.join(asked)} for {' and '.join(scene.fields)}. "
    text += f"The least error is {_offer(best, scene)}; the fastest is {_offer(fastest, scene)}."
    if budget.frame_ms is not None and fastest[1].frame_ms <= budget.frame_ms:
        within = [o for o in offers if o[1].frame_ms <= budget.frame_ms]
        text += f" Within the time the least error is {_offer(min(within, key=lambda o: error_of(o[1])), scene)}."
    if budget.error is not None and error_of(best[1]) <= budget.error:
        enough = [o for o in offers if error_of(o[1]) <= budget.error]
        text += f" Good enough at the least time is {_offer(min(enough, key=lambda o: o[1].frame_ms), scene)}."
    return text


def explain(
    choice: Choice, expected: Expected, offers: Sequence[tuple[Any, Expected]], budget: Budget, scene: Any
) -> str:
    """What was chosen and what a better and a cheaper one would be."""
    text = f"{_offer((choice, expected), scene)}"
    text += f" (worst measured {percent(max(expected.worst.values()))}"
    text += f"; {short(expected.look_ms)} ms in a frame with a look)" if choice.look_every > 1 else ")"
    better = [o for o in offers if error_of(o[1]) < 0.97 * error_of(expected) and o[1].frame_ms > expected.frame_ms]
    cheaper = [o for o in offers if o[1].frame_ms < 0.97 * expected.frame_ms]
    if better:
        dearer = min(better, key=lambda o: o[1].frame_ms)
        text += (
            f"; {dearer[0].words(scene)} would cost {short(dearer[1].frame_ms)} ms for {percent(error_of(dearer[1]))}"
        )
    if cheaper:
        less = min(cheaper, key=lambda o: error_of(o[1]))
        text += f"; for {short(less[1].frame_ms)} ms {less[0].words(scene)} would be {percent(error_of(less[1]))} off"
    return text + "."


def _offer(offer: tuple[Any, Expected], scene: Any) -> str:
    choice, expected = offer
    errors = ", ".join(f"{percent(e)} of {name}" for name, e in expected.errors.items())
    return f"{choice.words(scene)}: {short(expected.frame_ms)} ms, {errors}"


def percent(share: float) -> str:
    """A share for people."""
    return f"{short(100 * share)} %"


def short(value: float) -> str:
    """Two figures, without powers of ten."""
    return f"{value:.2g}" if value < 99.5 else f"{value:.0f}"


def backend() -> SegmentationBackend:
    """The fastest segmentation that this machine can do."""
    from zsdt.perception.segmentation import SegmentationBackend, resolved

    return resolved(SegmentationBackend.fastest)
