"""The twin of a liquid against a reality of another viscosity and resolution, and what a correction must not do."""

from dataclasses import replace

import numpy as np
import pytest

from tests.twin.liquid_scenes import FPS, LEVEL, RADIUS, SHAPE, SeenSurface, engine, liquid, reality
from zsdt.errors import OptionError
from zsdt.fluid.coarsening import coarsen, interpolate
from zsdt.fluid.linear_theory import cylinder_modes
from zsdt.fluid.vessel import Vessel
from zsdt.twin.glass_levels import surface_heights
from zsdt.twin.glass_twin import GlassTwin
from zsdt.twin.liquid_assimilation import LiquidAssimilationOptions, LiquidMethod

SHARE = 0.4  # of the true velocity that the twin begins with


class WrongStart:
    """A Psi_ini that thinks too little of the motion."""

    def infer_fields(self, body, positions):
        true = reality()
        velocity = interpolate(positions, true.position[0], true.velocity[0], true.body.pitch)[0]
        return {"velocity": SHARE * velocity, "internal_energy": np.zeros((len(positions), 1))}


@pytest.fixture(scope="module")
def ready():
    """A twin at t0, prepared once; options are set afterwards."""
    true = reality()
    volume, count = float(true.body.mass.sum()) / 1261.0, 300
    pitch = (volume / count) ** (1 / 3)
    points = coarsen(true.position[0], count, Vessel(SHAPE), pitch, 1.5 * pitch)
    body = replace(
        liquid(300), points=points, mass=np.full(count, 1261.0 * pitch**3), pitch=pitch,
        clamped=np.zeros(count, bool),
    )  # fmt: skip
    twin = GlassTwin(engine(), WrongStart(), body)
    twin.prepare()
    return twin


def begun(ready, **options):
    """The twin at t0; what it sees is good, and Psi_ini is told to be doubtful."""
    ready.options = LiquidAssimilationOptions(**{"noise": 5e-4, "steep_noise": 0.05, "first_rate": 0.5, **options})
    ready.begin()
    return ready


def follow(twin, profiles=None, frames=None):
    """Vertical velocities at the true particles, surface errors [m], innovations."""
    true = reality()
    errors, levels, said = [], [], []
    for k in range(1, frames or len(true.position)):
        twin.predict()
        if profiles is not None and profiles(k) is not None:
            said.append(twin.correct(profiles(k)))
        ours = interpolate(true.position[k], twin.position, twin.state.velocity, twin.body.pitch)[0]
        errors.append([((ours - true.velocity[k])[:, 2] ** 2).sum(), (true.velocity[k][:, 2] ** 2).sum()])
        levels.append(twin.surface(true.places) - true.height[k])
    total = np.array(errors).sum(axis=0)
    return float(np.sqrt(total[0] / total[1])), np.array(levels), said


@pytest.fixture(scope="module")
def open_loop(ready):
    return follow(begun(ready))


def test_what_is_seen_halves_the_error_of_what_is_not(ready, open_loop):
    twin = begun(ready)
    twin.look_back([reality().profile(k) for k in range(6)])
    error, levels, said = follow(twin, reality().profile)
    assert error < 0.5 * open_loop[0]
    assert np.sqrt((levels[5:] ** 2).mean()) < 0.02 * LEVEL
    assert all(i.taken.any() for i in said) and 0.8 < said[-1].viscosity < 1.4


def test_masks_that_are_too_high_in_every_picture_move_no_liquid(ready, open_loop):
    def high(k):
        seen = reality().profile(k)
        return replace(seen, height=seen.height + 1.5e-3)

    error, levels, _ = follow(begun(ready), high)
    offset = ready.level_offset
    right, true_levels, _ = follow(begun(ready), reality().profile)
    assert abs(error - right) < 0.01 and right < 0.9 * open_loop[0]
    # The amount of liquid is known from before: it does not rise to what is seen.
    assert abs(levels[-8:].mean() - true_levels[-8:].mean()) < 3e-4
    assert abs(offset - ready.level_offset - 1.5e-3) < 3e-4
    sure, _, _ = follow(begun(ready, level_doubt=0.0), high)
    assert sure > error + 0.1, "who takes heights for exact is thrown about"


def test_what_would_be_seen_follows_the_liquid(ready):
    twin, profile = begun(ready), reality().profile(1)
    before = twin.shown(profile)[0]
    assert twin.shown(profile)[0] is before, "found once for a surface"
    twin.predict()
    assert np.abs(twin.shown(profile)[0] - before).max() > 1e-5


def test_columns_bring_the_surface_too(ready, open_loop):
    error, levels, _ = follow(begun(ready, method=LiquidMethod.columns), reality().profile)
    assert error < 1.1 * open_loop[0] and np.sqrt((levels**2).mean()) < 0.7 * np.sqrt((open_loop[1] ** 2).mean())


def test_what_was_predicted_changes_nothing_when_it_is_seen(ready):
    twin = begun(ready)
    twin.predict()
    before, places = twin.state, reality().places
    same = SeenSurface(places, twin.surface(places), np.ones(len(places), bool))
    innovation = twin.correct(same)
    assert np.abs(twin.state.position - before.position).max() < 1e-12
    assert np.abs(twin.state.velocity - before.velocity).max() < 1e-12
    assert abs(innovation.work) < 1e-12 and twin.viscosity == pytest.approx(1.0, abs=1e-12)
    closed = begun(ready, gain=0.0)
    closed.predict()
    open_state = closed.state
    assert np.nanmax(np.abs(closed.correct(reality().profile(1)).distance)) > 1e-4 and closed.state is open_state


@pytest.mark.parametrize("method", list(LiquidMethod))
def test_the_account_closes_with_the_work_of_the_corrections(ready, method):
    twin = begun(ready, method=method)

    def balance():
        a = twin.account()
        return a["kinetic"] + a["potential"] + a["internal"] - a["work_of_ports"] - a["integrator"]

    at_first, scale = balance(), twin.account()["kinetic"]
    follow(twin, reality().profile, 10)
    assert abs(twin.work) > 1e-3 * scale
    assert balance() == pytest.approx(at_first, abs=1e-9 * scale + 1e-12)


def test_a_correction_keeps_the_volume(ready):
    twin = begun(ready, viscosity_doubt=0.0)
    points, step = twin.position.copy(), 1e-5
    change = np.zeros(twin.modes.count)
    change[0] = 1e-3 / twin.modes.stiffness[0]  # a rise of one millimetre at the wall

    def moved(x):
        half = twin.modes.at(x)[1] @ change
        return x + twin.modes.at(x + 0.5 * half)[1] @ change

    inside = points[Vessel(SHAPE).distance(points) > 0.004]
    columns = [(moved(inside + step * e) - moved(inside - step * e)) / (2 * step) for e in np.eye(3)]
    volumes = np.linalg.det(np.stack(columns, axis=2))
    assert np.abs(volumes - 1).max() < 1e-3
    follow(begun(ready), reality().profile)
    assert ready.volume_below() == pytest.approx(Vessel(SHAPE).volume(LEVEL), rel=0.03)


def test_modes_of_the_particles_swing_as_linear_theory_says():
    twin = GlassTwin(engine(), None, liquid(300))
    twin.prepare()
    twin.begin()
    expected = cylinder_modes(RADIUS, LEVEL).frequency()[0]
    assert twin._flow().modes.omega[0] / (2 * np.pi) == pytest.approx(expected, rel=0.1)
    assert twin.modes.frequency()[0] == pytest.approx(expected, rel=1e-6)


def test_flashes_are_not_taken_and_impossible_surfaces_not_believed(ready):
    true = reality()

    def flashing(k):
        profile = true.profile(k)
        profile.height[3:6] += 0.02
        return profile

    clean, _, _ = follow(begun(ready), true.profile)
    error, _, said = follow(begun(ready), flashing)
    assert error < 1.25 * clean and not any(i.taken[3:6].any() for i in said)

    def mad(k):
        profile = true.profile(k)
        if k in (6, 7):
            profile.height[:] = 0.08 - 2.0 * profile.places[:, 0]
        return profile

    error, _, said = follow(begun(ready), mad)
    assert [k + 1 for k, i in enumerate(said) if i.rejected] == [6, 7]
    assert error < 1.5 * clean


def test_gaps_are_predicted_over(ready, open_loop):
    true = reality()
    error, _, _ = follow(begun(ready), lambda k: None if 5 <= k < 11 else true.profile(k))
    assert error < 0.85 * open_loop[0]
    nobody = replace(true.profile(1), seen=np.zeros(len(true.places), bool))
    twin = begun(ready)
    twin.predict()
    state = twin.state
    assert not twin.correct(nobody).taken.any() and twin.state is state


def test_a_vessel_that_is_moved_again_pushes_its_liquid():
    twin = GlassTwin(engine(), None, liquid(300))
    twin.begin()
    for _ in range(3):
        twin.predict(np.array([3.0, 0.0, 0.0]))
    assert twin.position[:, 0].mean() < -5e-4 and twin.account()["work_load"] > 0
    slope = twin.surface(np.array([[-0.8 * RADIUS, 0.0], [0.8 * RADIUS, 0.0]]))
    assert slope[0] > slope[1] + 1e-3


def test_what_is_no_liquid_is_refused(ready):
    with pytest.raises(OptionError, match="liquid in a vessel"):
        GlassTwin(engine(), None, replace(liquid(300), vessel=None))
    with pytest.raises(OptionError, match="stress"):
        begun(ready).fields(["stress"])
    assert list(ready.fields(["velocity"])) == ["velocity"] and ready.fields([]) == {}
    with pytest.raises(OptionError, match="gain"):
        LiquidAssimilationOptions(gain=2.0)
    assert surface_heights(liquid(300), liquid(300).points, np.array([[0.02, 0.0]]))[0] == pytest.approx(
        LEVEL, abs=1e-3
    )
    assert ready.body.frame_dt == 1 / FPS
