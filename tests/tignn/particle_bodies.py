"""A small liquid of equal particles for the tests of the sub-step form."""

from dataclasses import replace

import numpy as np

from tests.tignn.liquid_bodies import PITCH, make_liquid
from zsdt.scene import VesselFamily, VesselShape
from zsdt.tignn.particle_engine import ParticleEngine
from zsdt.tignn.particle_options import ParticleOptions
from zsdt.tignn.particle_profiles import ParticleProfiles, start_profiles


def equal_liquid(shape=None, **options):
    """Glycerin in a cylinder (or `shape`, from whose wall the particles must keep away)."""
    body = make_liquid(**options)
    body.mass = np.full(body.nodes, 1261.0 * PITCH**3)
    return body if shape is None else replace(body, vessel=shape)


def random_profiles(options, seed=0, spread=0.4):
    """Textbook profiles whose coefficients are shaken."""
    plain = start_profiles(options.cutoff, options.degree)
    shaken = plain.coefficients + np.random.default_rng(seed).normal(size=plain.coefficients.shape) * spread
    return ParticleProfiles(plain.cutoff, shaken)


def engine_for(body, profiles=None, **options):
    engine = ParticleEngine(profiles, ParticleOptions(**options))
    engine.prepare(body)
    return engine


def stirred(body, speed=0.2, seed=0):
    """First frame with a swirl and a slosh of about `speed` [m/s]."""
    x = body.points
    noise = np.random.default_rng(seed).normal(size=x.shape) * 0.1
    swirl = np.stack([-x[:, 1], x[:, 0], 0 * x[:, 2]], axis=1) / 0.02 + np.array([0.7, 0.3, 0.0])
    return {"position": x.copy(), "velocity": speed * (swirl + noise), "internal_energy": np.zeros((len(x), 1))}


def prism():
    return VesselShape(VesselFamily.jar, [0.0, 0.08], [0.024, 0.024], aspect=0.9, exponent=4.0)
