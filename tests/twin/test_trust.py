"""Trust at run time: what is measured has closed forms, a clean run raises nothing, and each fault its own flag."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from tests.twin.beam_clips import (
    FPS,
    DrawnSegmenter,
    DrawnVideo,
    KnowingTracker,
    cell_clip,
    cell_engine,
    scene_of,
    tip_force,
)
from zsdt.perception.grid_graph import ClampChoice, GridOptions
from zsdt.scene import Foam, Liquid, VesselFamily, VesselShape
from zsdt.shipped import shipped
from zsdt.tignn.cell_engine import CellEngine
from zsdt.tignn.engine import load_engine, roll_out
from zsdt.trajectory import Body, Trajectory
from zsdt.twin.assimilation import robust_fit
from zsdt.twin.beam_graph import beam_body
from zsdt.twin.loop import TwinOptions, run_twin
from zsdt.twin.trust import TrustMonitor, limits_of, watch_rollout
from zsdt.twin.trust_audit import EnergyAudit
from zsdt.twin.trust_gauges import LiquidGauge, SolidGauge
from zsdt.twin.trust_innovation import InnovationStatistics
from zsdt.twin.trust_limits import KINDS, PARTS, Flag, TrustLimits, hull, load_limits, widened

RNG = np.random.default_rng


# ---- gauges: closed forms -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def body():
    return beam_body(7, 3, scene_of(0.1), FPS)


def test_a_rigid_motion_is_no_strain(body):
    """Objectivity: turned, moved and spinning, the body is stretched nowhere and at no rate."""
    angle, spin = 1.1, 3.0
    turn = np.array([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
    position = body.points @ turn.T + [0.3, -0.2, 1.0]
    found = SolidGauge(body).frame(position, np.cross([0.0, spin, 0.0], position))
    assert found["stretch_low"] == pytest.approx(1.0, abs=1e-12)
    assert found["stretch_high"] == pytest.approx(1.0, abs=1e-12)
    assert found["rate"] < 1e-12


@pytest.mark.parametrize("stretch", [0.7, 1.4])
def test_stretch_rate_and_speed_of_a_homogeneous_motion(body, stretch):
    """x = s X and v = a x: every arm is s times as long and grows at the rate a."""
    rate, material = 2.5, body.material
    position = stretch * body.points
    found = SolidGauge(body).frame(position, rate * position)
    assert found["stretch_low"] == pytest.approx(stretch) and found["stretch_high"] == pytest.approx(stretch)
    assert found["rate"] == pytest.approx(rate * material.tau)
    fastest = rate * np.linalg.norm(position, axis=1).max()
    assert found["speed"] == pytest.approx(fastest / math.sqrt(material.young / material.density))


def test_shear_is_felt_by_the_diagonals(body):
    """Simple shear leaves edges along x at their length; the space diagonal of a cube grows to sqrt(2 + (1 + g)^2)."""
    shear = 0.3
    position = body.points + shear * body.points[:, [2]] * [1.0, 0.0, 0.0]
    found = SolidGauge(body).frame(position, np.zeros_like(position))
    assert found["stretch_high"] == pytest.approx(math.sqrt((2 + (1 + shear) ** 2) / 3))


def test_loads_are_measured_against_the_weight(body):
    gauge, weight = SolidGauge(body), 9.81 * body.mass.sum()
    still = np.zeros_like(body.points)
    gauge.frame(body.points, still, tip_force(body, (0.0, 0.0, -1.0)))
    found = gauge.frame(body.points, still, tip_force(body, (0.0, 0.0, -3.0)))
    assert found["load"] == pytest.approx(3.0 / weight) and found["load_step"] == pytest.approx(2.0 / weight)


def liquid_body(spacing=0.008):
    line = np.arange(-3, 4) * spacing
    points = np.stack(np.meshgrid(line, line, line + 4 * spacing, indexing="ij"), axis=-1).reshape(-1, 3)
    vessel = VesselShape(VesselFamily.cylinder, [0.0, 0.12], [0.04, 0.04])
    mass = np.full(len(points), 1261.0 * spacing**3)
    nothing = np.zeros((0, 2), np.int64)
    return Body(points, nothing, np.zeros(len(points), bool), mass, 0.004, spacing, liquid=Liquid(), vessel=vessel)


def test_the_nearest_pair_is_found_within_a_round():
    """A pair that comes close is seen when its turn comes, and no later than after `round` frames."""
    body = liquid_body()
    gauge = LiquidGauge(body)
    position, still = body.points.copy(), np.zeros_like(body.points)
    assert gauge.frame(position, still)["nearest"] == pytest.approx(1.0)
    position[-1] = position[-2] + [0.0, 0.0, 0.2 * body.pitch]
    least = min(gauge.frame(position, still)["nearest"] for _ in range(gauge.round))
    assert least == pytest.approx(0.2)


def test_speed_of_a_liquid_is_a_froude_number():
    body = liquid_body()
    gauge, velocity = LiquidGauge(body), np.zeros_like(body.points)
    velocity[5] = [0.0, 0.6, 0.8]
    expected = 1.0 / math.sqrt(9.81 * gauge.card["fill"])
    assert gauge.frame(body.points, velocity)["froude"] == pytest.approx(expected)


# ---- audit ----------------------------------------------------------------------------------------------------------


def swing(frames=200, leak=0.0, chill=0.0):
    """Accounts of a damped pendulum of 1 J in joules; `leak` J a frame from nowhere, `chill` J of heat lost at once."""
    for k in range(frames):
        heat = 1.0 - math.exp(-0.01 * k)
        kinetic = (1.0 - heat) * math.sin(0.2 * k) ** 2 + leak * k
        lost = chill if k > 100 else 0.0
        yield {
            "kinetic": kinetic + lost,
            "elastic": 1.0 - heat - (kinetic - leak * k),
            "dissipated": heat - lost,
            "work_of_ports": 0.0,
        }


def test_an_account_that_closes_has_no_leak():
    audit = EnergyAudit()
    rows = [audit.frame(account) for account in swing()]
    assert max(row["leak_total"] for row in rows) < 1e-12 and max(row["chill"] for row in rows) == 0.0


def test_energy_from_nowhere_and_heat_that_falls_are_told_apart():
    leaking, cold = EnergyAudit(), EnergyAudit()
    rows = [leaking.frame(account) for account in swing(leak=0.002)]
    assert rows[-1]["leak_total"] == pytest.approx(0.002 * 199 / max(1.0, 0.002 * 199), rel=0.05)
    assert max(row["chill"] for row in rows) == 0.0
    rows = [cold.frame(account) for account in swing(chill=0.1)]
    assert max(row["chill"] for row in rows) == pytest.approx(0.1, rel=0.2)
    assert max(row["leak_total"] for row in rows) < 1e-12


def test_work_of_a_port_is_no_leak():
    audit = EnergyAudit()
    for k in range(50):
        row = audit.frame({"kinetic": 0.1 * k, "elastic": 0.0, "dissipated": 0.0, "work_of_ports": 0.1 * k})
    assert row["leak_total"] < 1e-12


# ---- innovation -----------------------------------------------------------------------------------------------------


def test_whitened_innovation_has_unit_variance_where_the_prior_is_right():
    """gap = rows a + noise with a ~ N(0, prior), noise ~ N(0, 1): every mode's normalised innovation has variance 1."""
    draws, points, modes = 400, 30, 4
    rng = RNG(0)
    rows = rng.standard_normal((points, 2, modes))
    prior = np.array([4.0, 1.0, 0.3, 0.1])
    z = []
    for _ in range(draws):
        amplitude = np.sqrt(prior) * rng.standard_normal(modes)
        gap = rows @ amplitude + rng.standard_normal((points, 2))
        z.append(robust_fit(rows, gap, np.ones(points, bool), prior, gate=6.0).whitened)
    variance = np.var(z, axis=0)
    assert np.all(np.abs(variance - 1.0) < 0.25), variance  # scatter is never below 1.2 medians: a little less than 1


def statistics_of(z):
    found = {}
    statistics = InnovationStatistics()
    rows = [statistics.frame(row) for row in z]
    for name in ("variance", "bias", "lag"):
        found[name] = np.array([row[name] for row in rows if name in row])
    return found


def test_white_innovations_look_white():
    found = statistics_of(RNG(1).standard_normal((500, 16)))
    assert np.median(found["variance"]) == pytest.approx(1.0, abs=0.1)
    assert np.abs(found["lag"]).max() < 0.35 and found["bias"].max() < 5.0


def test_bias_variance_and_correlation_are_told_apart():
    rng = RNG(2)
    noise = rng.standard_normal((400, 16))
    offset = np.zeros(16)
    offset[0] = 3.0
    assert np.median(statistics_of(noise + offset)["bias"]) > 8.0
    assert np.median(statistics_of(3.0 * noise)["variance"]) == pytest.approx(9.0, rel=0.1)
    lagging = np.zeros_like(noise)
    for k in range(1, 400):
        lagging[k] = 0.8 * lagging[k - 1] + 0.6 * noise[k]  # AR(1) of variance 1 and correlation 0.8
    found = statistics_of(lagging)
    assert np.median(found["lag"]) == pytest.approx(0.8, abs=0.15)
    assert np.median(found["variance"]) == pytest.approx(1.0, abs=0.25)


# ---- limits ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(KINDS))
def test_what_is_normal_is_within_its_limits(name):
    centre = KINDS[name].centre
    for low, high in ((0.4, 0.9), (0.0, 0.0), (1.1, 30.0), *(() if centre is None else ((-2.0, 3.0),))):
        least, greatest = widened(name, low, high)
        assert least <= low and greatest >= high


def engine_folder(tmp_path, text="{}"):
    (tmp_path / "engine.json").write_text(text)
    return tmp_path


def test_limits_are_kept_beside_the_weights_that_they_belong_to(tmp_path):
    limits = TrustLimits.of({"rate": (0.0, 2.0)}, {"rate": (0.0, 3.0), "leak": (0.0, 0.01)}, about={"command": "test"})
    limits.save(engine_folder(tmp_path))
    found = load_limits(tmp_path)
    assert found is not None and found.about == limits.about
    for name in PARTS:
        assert {n: pytest.approx(r) for n, r in getattr(limits, name).items()} == getattr(found, name)
    engine_folder(tmp_path, '{"other": 1}')
    assert load_limits(tmp_path) is None


@pytest.mark.parametrize("scene", ["foam_beam", "glycerin_glass"])
def test_shipped_weights_come_with_limits_around_their_training(scene):
    limits = limits_of(load_engine(shipped(scene, "tignn")))
    assert limits is not None
    for alone, ranges in ((True, [limits.normal_alone]), (False, [limits.normal_alone, limits.normal_twin])):
        known = limits.within(alone)
        for name, (low, high) in hull([limits.training, *ranges]).items():
            least, greatest = known.get(name, (-np.inf, np.inf))
            assert least <= low <= high <= greatest
    assert {"card", "range", "energy", "entropy", "innovation", "blind"} == {KINDS[n].flag for n in limits.limits}
    json.dumps(limits.about)


# ---- open loop: each fault its own flag -----------------------------------------------------------------------------


FRAMES = 40
NOTHING = TrustLimits({})


def rollout_of(engine, body, force=-0.25, frames=FRAMES):
    load = tip_force(body, (0.0, 0.0, force)) * np.minimum(np.arange(frames) / 10.0, 1.0)[:, None, None]
    fields = {"position": body.points, "velocity": np.zeros_like(body.points), "stress": np.zeros((body.nodes, 6))}
    whole = {name: np.repeat(values[None], frames, axis=0) for name, values in fields.items()}
    trajectory = Trajectory(body, np.arange(frames) / FPS, whole, load)
    return trajectory, roll_out(engine, trajectory)


@pytest.fixture(scope="module")
def limits(body):
    trajectory, rollout = rollout_of(cell_engine(), body)
    series = watch_rollout(NOTHING, body, rollout, trajectory.load)
    ranges = {n: (float(np.nanmin(v)), float(np.nanmax(v))) for n, v in series.values.items()}
    ranges |= {n: (v, v) for n, v in TrustMonitor(None, body).card.items()}
    return TrustLimits.of(ranges, {})


def test_a_clean_run_is_trusted(body, limits):
    trajectory, rollout = rollout_of(cell_engine(), body, force=-0.2)
    series = watch_rollout(limits, body, rollout, trajectory.load)
    assert series.first_flag is None and max(series.shares["range"]) < 1.0


class Leaky(CellEngine):
    """Makes energy: velocities grow by 3 % a frame."""

    def step(self, state, load, load_next):
        new = super().step(state, load, load_next)
        new.velocity *= 1.03
        return new


def test_energy_from_nowhere_is_flagged(body, limits):
    plain = cell_engine()
    trajectory, rollout = rollout_of(Leaky(plain.constants, plain.options), body)
    series = watch_rollout(limits, body, rollout, trajectory.load)
    assert "energy" in series.count() and "leak" in series.reasons[series.first_flag]


def test_a_load_beyond_the_training_is_flagged_before_the_strain_is(body, limits):
    trajectory, rollout = rollout_of(cell_engine(), body, force=-0.8)
    series = watch_rollout(limits, body, rollout, trajectory.load)
    assert "range" in series.flags[series.first_flag]
    assert "load" in series.reasons[series.first_flag] and "stretch" not in series.reasons[series.first_flag]
    assert any("stretch" in words for words in series.reasons)


@pytest.mark.parametrize("value, flag", [(np.nan, Flag.finite), (0.08, Flag.range)])
def test_a_node_that_is_nowhere_is_flagged(body, limits, value, flag):
    monitor = TrustMonitor(limits, body)
    position, still = body.points.copy(), np.zeros_like(body.points)
    assert not monitor.frame(position, still).flags
    position[-1, 2] += value
    assert monitor.frame(position, still).flags == (flag,)


@pytest.mark.parametrize("change", [{"young": 5 * 4.5e4}, {"tau": 0.5}])
def test_another_material_is_flagged_in_every_frame(body, limits, change):
    monitor = TrustMonitor(limits, replace(body, material=replace(body.material, **change)))
    reading = monitor.frame(body.points, np.zeros_like(body.points))
    assert reading.flags == (Flag.card,) and next(iter(change)) in reading.words


# ---- closed loop ----------------------------------------------------------------------------------------------------


def closed(seed=0, told=None, faults=None, frames=FRAMES, engine=None):
    clip = cell_clip(frames=frames)
    options = TwinOptions(grid=GridOptions(clamp_side=ClampChoice.left))
    return run_twin(
        DrawnVideo(frames), DrawnSegmenter(clip), scene_of(material=told or Foam()), options, camera=clip.camera,
        engine=engine or cell_engine(), tracker=KnowingTracker(clip.tracked(0.2, seed=seed), faults),
    ).trust  # fmt: skip


@pytest.fixture(scope="module")
def closed_limits(tmp_path_factory):
    """An engine with limits from three clean runs beside it."""
    runs = [closed(seed) for seed in range(3)]
    ranges = [{n: (float(np.nanmin(v)), float(np.nanmax(v))) for n, v in run.values.items()} for run in runs]
    told = {"stiffness_found": (0.8, 1.25), "density_found": (0.8, 1.25)}
    folder = engine_folder(tmp_path_factory.mktemp("engine"))
    TrustLimits.of({}, hull([*ranges, told])).save(folder)
    engine = cell_engine()
    engine.folder = folder
    return engine


def test_a_clean_twin_is_trusted(closed_limits):
    assert closed(seed=9, engine=closed_limits).count() == {}


def test_a_camera_that_is_bumped_is_flagged_at_once(closed_limits):
    faults = {k: lambda pixels, seen: (pixels + np.array([0.0, 6.0]), seen) for k in range(20, FRAMES)}
    series = closed(engine=closed_limits, faults=faults)
    assert series.first_flag == 20 and "innovation" in series.flags[20]


@pytest.mark.parametrize("factor", [0.2, 5.0])
def test_a_material_that_is_five_times_off_is_flagged(closed_limits, factor):
    """The beam hardly sags, so its first picture does not weigh it: what it does under its load tells."""
    series = closed(told=Foam(young=factor * 4.5e4), engine=closed_limits)
    assert series.first_flag is not None and series.first_flag < 10


def test_a_beam_that_is_hidden_for_long_is_no_longer_known(closed_limits):
    faults = {k: "dark" for k in range(15, 38)}
    series = closed(engine=closed_limits, faults=faults)
    blind = [k for k, text in enumerate(series.flags) if "blind" in text]
    assert blind and 15 < blind[0] < 38
