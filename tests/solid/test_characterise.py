"""A simulated foam beam, looked at through a few points, gives back the material that it was made with."""

import numpy as np
import pytest

from zsdt.errors import DataError, OptionError, RunRejected
from zsdt.scene import BeamShape, Foam, Modulus
from zsdt.solid.beam_observation import BeamObservation, observe_positions
from zsdt.solid.characterise import CharacteriseOptions, characterise
from zsdt.solid.prony import PronyChoice, loss_factor
from zsdt.solid.specimen import HungAt, Specimen, SpecimenFem

FOAM = Foam()
SPECIMEN = Specimen(BeamShape(0.35, 0.1, 0.1), FOAM.density, 0.05)
PLACES = np.array([[0.15, 0.0, 0.05], [0.25, 0.0, 0.1], [0.35, 0.0, 0.05]])  # front nodes, as a camera tracks them
DT, STILL, SWING = 1 / 120, 12, 150
QUICK = CharacteriseOptions(resamples=8)


@pytest.fixture(scope="module")
def recording():
    """12 frames at rest under gravity, then a swing after a push of 0.15 N at the tip is gone."""
    fem = SpecimenFem(SPECIMEN, PLACES)
    rest = fem.rest(FOAM)
    swing = fem.swing(FOAM, SWING, DT, np.array([0.0, 0.0, -0.15]))
    return np.concatenate([np.repeat(rest[None], STILL, axis=0), swing])


def observation(displacement):
    frames = np.arange(STILL + SWING)
    return BeamObservation(DT * frames, displacement, PLACES, frames < STILL, frames >= STILL)


def test_young_g1_and_tau_of_a_simulated_beam_come_back(recording):
    found = characterise(SPECIMEN, observation(recording), QUICK)
    assert found.material.young == pytest.approx(FOAM.young, rel=0.02)
    assert found.loss_factor == pytest.approx(loss_factor(FOAM, found.frequency), rel=0.05)
    assert found.material.g1 == pytest.approx(FOAM.g1, rel=0.05)
    assert found.material.tau == pytest.approx(FOAM.tau, rel=0.05)
    assert found.fem_frequency == pytest.approx(found.frequency, rel=2e-3)


def test_noise_and_lost_points_move_the_result_by_little(recording):
    generator = np.random.default_rng(2)
    noisy = recording + 3e-4 * generator.normal(size=recording.shape)
    noisy[30:36, 1] = np.nan
    found = characterise(SPECIMEN, observation(noisy), QUICK)
    assert found.material.young == pytest.approx(FOAM.young, rel=0.02)
    assert found.loss_factor == pytest.approx(loss_factor(FOAM, found.frequency), rel=0.05)


def test_tracks_of_a_finer_beam_with_other_elements_in_it_say_the_same():
    """Truth at 2.5 cm, fit at 5 cm; rest and swing found in the tracks; half a millimetre of noise, points lost."""
    finer = Specimen(SPECIMEN.shape, FOAM.density, 0.025)
    fem = SpecimenFem(finer, PLACES)
    swing = fem.swing(FOAM, 180, DT, np.array([0.0, 0.0, -0.3]))
    moved = np.concatenate([np.repeat(swing[:1], 6, axis=0), swing])
    moved = moved + 5e-4 * np.random.default_rng(3).normal(size=moved.shape) * (np.arange(186) < 60)[:, None, None]
    moved[12:15, 2] = np.nan
    seen = observe_positions(DT * np.arange(186), PLACES + moved, PLACES)
    assert seen.resting[-20:].all() and not seen.resting[:100].any()
    assert 6 <= np.argmax(seen.swinging) <= 15
    found = characterise(SPECIMEN, seen, QUICK)
    assert found.material.young == pytest.approx(FOAM.young, rel=0.03)
    assert found.loss_factor == pytest.approx(loss_factor(FOAM, found.frequency), rel=0.1)


def test_a_recording_that_never_rests_or_never_swings_is_refused():
    times = DT * np.arange(100)
    swing = 0.01 * np.cos(20 * times)[:, None, None] * np.array([0.0, 0.0, 1.0]) * np.ones((1, 3, 1))
    with pytest.raises(DataError, match="never rests"):
        observe_positions(times, PLACES + swing, PLACES)
    with pytest.raises(DataError, match="after the release"):
        observe_positions(times, PLACES + swing, PLACES, released=times[-3])


@pytest.mark.parametrize("choice", [PronyChoice.least_g1, PronyChoice.given_tau])
def test_storage_modulus_and_loss_factor_do_not_hang_on_the_choice(recording, choice):
    options = CharacteriseOptions(prony=choice, tau=0.03, straight_sd=0.01, resamples=8)
    found = characterise(SPECIMEN, observation(recording), options)
    sure = characterise(SPECIMEN, observation(recording), QUICK)
    assert found.storage_young == pytest.approx(sure.storage_young, rel=0.02)
    assert found.loss_factor == pytest.approx(sure.loss_factor, rel=0.05)
    assert abs(found.material.tau / FOAM.tau - 1) > 0.1  # what one frequency does not say


def test_a_hung_mass_is_part_of_the_fit():
    silicone = Foam(1070.0, 2.6e5, 0.45, 0.2, 0.02, Modulus.long_term)
    specimen = Specimen(BeamShape(0.1, 0.03, 0.03), 1070.0, 0.01, tip_mass=0.02, hung_at=HungAt.top)
    places = np.array([[0.1, 0.015, 0.036], [0.1, -0.006, 0.024]])  # beside the body, as glued markers are
    fem = SpecimenFem(specimen, places)
    swing = fem.swing(silicone, 120, 0.01)
    frames = np.arange(130)
    moved = np.concatenate([swing, np.repeat(fem.rest(silicone)[None], 10, axis=0)])
    seen = BeamObservation(0.01 * frames, moved, places, frames >= 120, (frames > 10) & (frames < 120))
    found = characterise(specimen, seen, CharacteriseOptions(poisson=0.45, state=Modulus.long_term, resamples=8))
    assert found.material.young == pytest.approx(2.6e5, rel=0.02)
    assert found.loss_factor == pytest.approx(loss_factor(silicone, found.frequency), rel=0.05)


def test_markers_ride_on_the_body_and_turn_with_it():
    places = np.array([[0.35, 0.05, 0.11], [0.2, 0.05, 0.05]])
    operator = SPECIMEN.observe(places)
    points = SPECIMEN.grid.grid.points
    assert np.allclose(operator @ points, places)
    angle = 0.3
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    assert np.allclose(operator @ (points @ turn.T + 0.02), places @ turn.T + 0.02)
    with pytest.raises(OptionError, match="off the beam"):
        SPECIMEN.observe(np.array([[0.35, 0.05, 0.4]]))


def test_the_hung_mass_is_all_there_whichever_nodes_carry_it():
    for hung_at in HungAt:
        specimen = Specimen(BeamShape(0.1, 0.03, 0.03), 1070.0, 0.01, tip_mass=0.052, hung_at=hung_at)
        assert specimen.extra_mass.sum() == pytest.approx(0.052)


def test_recordings_that_say_nothing_are_refused(recording):
    upside_down = observation(recording * np.array([1.0, 1.0, -1.0]))
    with pytest.raises(DataError, match="sag"):
        characterise(SPECIMEN, upside_down, QUICK)
    never_still = observation(recording)
    never_still.resting[:] = False
    with pytest.raises(DataError, match="at rest"):
        characterise(SPECIMEN, never_still, QUICK)
    twice_the_sag = recording.copy()
    twice_the_sag[:STILL] *= 0.2
    with pytest.raises(RunRejected, match="static shape"):
        characterise(SPECIMEN, observation(twice_the_sag), QUICK)
