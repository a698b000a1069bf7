"""The cases of the benchmark, scene by scene, from what finished jobs hold."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from pipelines.bench_sources import Source, costs_of, entries_of, error_of, judged_of, maker_of
from pipelines.gather import Method
from zsdt.evaluation.bench import Case, Progress
from zsdt.evaluation.bench_bodies import beam_of, finer_beam, finer_glass, glass_of
from zsdt.evaluation.bench_cases import Entry, case_of, network_variants, on_backends, seed_variants
from zsdt.evaluation.bench_growth import Grower, LooseParticles, OwnSph
from zsdt.evaluation.bench_judge import judge
from zsdt.evaluation.bench_ratio import LITERAL, PAIRS, PARTICLES, on_radius
from zsdt.evaluation.coarse_engines import OtherPitch, OtherSpacing
from zsdt.solid.engine import CoarseFem, Start
from zsdt.tignn.cell_energy import CellStart
from zsdt.tignn.cell_engine import CellEngine
from zsdt.tignn.engine import Engine, load_engine
from zsdt.tignn.liquid_engine import LiquidEngine
from zsdt.tignn.node_engine import NodeEngine
from zsdt.tignn.options import Bracket, Energy, TignnOptions
from zsdt.tignn.particle_engine import ParticleEngine
from zsdt.tignn.seed_engine import SeedEngine, SeedModel, literal_options
from zsdt.tignn.seed_train import scales_of
from zsdt.trajectory import Trajectory

NETWORK_SCENES = ("abaqus_beam", "glass")  # where widths and passes are timed; the foam beam's graph is a beam's
EXACT = ("tignn_exact", "seed_form")
COMPILED, TRACED = ("compiled",), ("onnx", "openvino")  # slow to build: a minute, some seconds
JUDGED_HERE = "judged by this command"
INTERPOLATED = "its first frame is interpolated from the coarser graph, which rings, so it is not the truth again"
SUBSTEPS = "exact, sub-step form (the same particles, pairs within its own radius)"
PITCHES, MESHES, RATIOS = (0.10,), (0.025,), (1.25, 1.5, 2.0)  # the rest of a cell model on 2.5 cm takes 15 s to find


def points_of(source: Source, judged: int, progress: Progress) -> list[Case]:
    """All cases of a scene: what was trained, on all backends; other resolutions, which are judged here on `judged`
    trajectories of each regime; untrained widths and passes."""
    bodies, entries = source.bodies(), entries_of(source)
    exact = source.named(*EXACT)
    cases = []
    for regime, trajectory in bodies.items():
        for entry in entries:
            if regime in entry.judged:
                cases.append(case_of(entry, source.scene, regime, trajectory))
        if exact is not None and regime in judged_of(exact):
            entry = Entry(exact.name, maker_of(exact), judged_of(exact))
            cases += _backends(source, entry, regime, trajectory)
        cases += [c for e in entries if e.method == "tignn_particle" for c in _backends(source, e, regime, trajectory)]
        cases += _resolutions(source, entries, regime, trajectory, judged, progress)
    first = next(iter(bodies))
    if source.scene in NETWORK_SCENES and exact is not None:
        engine = maker_of(exact)()
        assert isinstance(engine, NodeEngine | LiquidEngine)
        untrained = [*network_variants(engine), *_untrained_seed(source, bodies[first])]
        cases += [case_of(entry, source.scene, first, bodies[first]) for entry in untrained]
    return cases


def _backends(source: Source, entry: Entry, regime: str, trajectory: Trajectory) -> list[Case]:
    """A trained engine on the inference backends that it was not loaded with."""
    but = {"abaqus_beam": (), "glass": COMPILED}.get(source.scene, COMPILED + TRACED)
    plain = case_of(entry, source.scene, regime, trajectory)
    made = on_backends(entry, but)
    return [replace(plain, make=make, card={**plain.card, "backend": name}) for name, make in made.items()]


def _untrained_seed(source: Source, trajectory: Trajectory) -> list[Entry]:
    """The seed's network with own weights per pass, and with shared ones where none was trained."""
    trained = source.named(LITERAL) is not None
    return [entry for entry in seed_variants([trajectory]) if not (trained and entry.method == "seed literal")]


def _resolutions(
    source: Source, entries: Sequence[Entry], regime: str, trajectory: Trajectory, judged: int, progress: Progress
) -> list[Case]:
    """The sub-step engines and the beam's solver on other pitches and spacings, judged here."""
    found: list[tuple[str, Callable[[], Engine], float]] = []
    for entry in entries:
        if entry.method == "tignn_cell":
            for pitch in PITCHES:
                make: Callable[[], Engine] = partial(_on_pitch, entry.make, pitch)
                found.append((entry.method, make, pitch / trajectory.body.pitch))
            found += [(f"fem_{100 * m:g}cm", partial(CoarseFem, mesh=m), m / trajectory.body.pitch) for m in MESHES]
        if entry.method == "tignn_particle":
            found += [(entry.method, partial(_on_spacing, entry.make, ratio), ratio) for ratio in RATIOS]
    some = source.some(regime, judged) if found else []
    cases = []
    for method, make, resolution in found:
        fitting = [t for t in some if _fits(make(), t)]
        on = trajectory if _fits(make(), trajectory) else next(iter(fitting), None)
        if on is not None and fitting:
            note = JUDGED_HERE if resolution >= 1.0 else f"{JUDGED_HERE}; {INTERPOLATED}"
            entry = Entry(method, make, {regime: judge(make, fitting)}, note)
            cases.append(case_of(entry, source.scene, regime, on, resolution=resolution))
            progress(f"{method} x {resolution:g}")
    return cases


def _on_pitch(make: Callable[[], Engine], pitch: float) -> Engine:
    return OtherPitch(make(), pitch)


def _on_spacing(make: Callable[[], Engine], ratio: float) -> Engine:
    return OtherSpacing(make(), ratio)


def _fits(engine: Any, trajectory: Trajectory) -> bool:
    applies_to = getattr(engine, "applies_to", None)
    return applies_to is None or bool(applies_to(trajectory.body))


@dataclass(frozen=True)
class RatioPart:
    """A graph on which the seed's network and the exact form are compared; see `zsdt.evaluation.bench_ratio`."""

    name: str
    trajectory: Trajectory
    pairs: int
    makers: Mapping[str, Callable[[], Engine]]
    judged: Mapping[str, Mapping[str, Any]]


def ratio_parts(source: Source) -> list[RatioPart]:
    """The comparison of a scene; none where no exact form was trained, and none for the foam beam."""
    exact = [m for m in source.methods if m.name in EXACT and m.folder is not None]
    if source.scene not in NETWORK_SCENES or not exact:
        return []
    liquid = source.scene == "glass"
    trajectory = glass_of(PARTICLES) if liquid else next(iter(source.bodies().values()))
    literal = source.named(LITERAL)
    steps = literal.figures.get("steps") if literal is not None else None
    full = max(exact, key=lambda m: float(m.figures.get("steps", 0)))
    chosen = [*[m for m in exact if m.figures.get("steps") == steps][:1], full]
    if literal is not None:
        most = error_of(literal)
        chosen += sorted((m for m in exact if error_of(m) <= most), key=_work)[:1]
    methods = {f"exact {_shape(m)}, {m.figures.get('steps')} steps": m for m in chosen}

    def given(make: Callable[[], Engine]) -> Callable[[], Engine]:
        return partial(_given_radius, make, trajectory) if liquid else make

    makers = {LITERAL: given(maker_of(literal) if literal else _untrained(source))}
    makers["seed_literal, own weights per pass"] = given(_untrained(source, shared=False))
    judged = {LITERAL: costs_of(literal)} if literal is not None else {}
    for name, method in methods.items():
        makers[name], judged[name] = given(maker_of(method)), costs_of(method)
        for backend, make in on_backends(Entry("exact", makers[name], {}), COMPILED + TRACED).items():
            makers[f"{name}, {backend}"], judged[f"{name}, {backend}"] = make, judged[name]
    substeps = source.named("tignn_particle")
    if liquid and substeps is not None:
        makers[SUBSTEPS], judged[SUBSTEPS] = maker_of(substeps), costs_of(substeps)
    return [RatioPart(source.scene, trajectory, PAIRS if liquid else len(trajectory.body.pairs), makers, judged)]


def _shape(method: Method) -> str:
    return f"{method.options.get('passes')} x {method.options.get('width')}"


def _work(method: Method) -> float:
    """What grows with the work of a pass: depth times the square of the width."""
    return float(method.options.get("passes", 0)) * float(method.options.get("width", 0)) ** 2


def _untrained(source: Source, shared: bool = True) -> Callable[[], Engine]:
    options = literal_options(shared_weights=shared)
    scales = scales_of(list(source.bodies().values())[:1])
    return lambda: SeedEngine(SeedModel(options, scales))


def _given_radius(make: Callable[[], Engine], trajectory: Trajectory) -> Engine:
    return on_radius(make(), trajectory)


def growers_of(found: Sequence[Source]) -> list[Grower]:
    """The methods whose cost is followed to 100,000 nodes."""
    growers: list[Grower] = []
    for source in found:
        exact = source.named(*EXACT)
        liquid = source.scene == "glass"
        if source.scene in NETWORK_SCENES and exact is not None:
            body = glass_of if liquid else beam_of
            scene = "liquid" if liquid else "beam"
            growers.append(Grower(scene, "tignn_exact", maker_of(exact), body))
            for backend, make in on_backends(Entry("exact", maker_of(exact), {}), COMPILED + TRACED).items():
                growers.append(Grower(scene, f"tignn_exact, {backend}", make, body))
            literal = source.named(LITERAL)
            growers.append(Grower(scene, LITERAL, maker_of(literal) if literal else _untrained(source), body))
        growers += _substep_growers(source)
    return growers


def _substep_growers(source: Source) -> list[Grower]:
    """Sub-step engines and solvers, on larger bodies and on finer grids of one."""
    folders = [m.folder for m in source.methods if m.folder is not None and m.name in ("tignn_cell", "tignn_particle")]
    if not folders:
        return []
    engine = load_engine(folders[0])
    if isinstance(engine, CellEngine):
        options = replace(engine.options, start=CellStart.residual, anchor_stress=False)

        def cells() -> Engine:
            return CellEngine(engine.constants, options, engine.correction, engine.readout)

        fem = partial(CoarseFem, mesh=0.05, start=Start.given)
        return [
            Grower("beam", "tignn_cell", cells, beam_of),
            Grower("beam", "tignn_cell, finer grids", cells, finer_beam),
            Grower("beam", "fem_5cm", fem, beam_of),
        ]
    assert isinstance(engine, ParticleEngine)
    loose = partial(LooseParticles, engine.profiles, engine.options, engine.single)
    return [
        Grower("liquid", "tignn_particle", loose, glass_of),
        Grower("liquid", "tignn_particle, finer particles", loose, finer_glass),
        Grower("liquid", "full_sph", OwnSph, glass_of),
    ]


def training_parts(source: Source) -> tuple[dict[str, TignnOptions], list[Trajectory]]:
    """Networks whose training is timed, and trajectories of one regime to learn from."""
    exact = source.named(*EXACT)
    if source.scene not in NETWORK_SCENES or exact is None:
        return {}, []
    engine: Any = maker_of(exact)()
    options: TignnOptions = engine.model.options
    small = replace(options, passes=4, local_passes=2, width=32)
    networks = {
        "node exact": options,
        "node soft": replace(options, bracket=Bracket.soft, energy=Energy.learned),
        "node none": replace(options, bracket=Bracket.none, energy=Energy.learned),
        "node exact, small": small,
        "seed literal": literal_options(),
    }
    return networks, source.some(next(iter(source.bodies())), 2)
