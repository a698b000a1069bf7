"""The material of a foam beam read from a rendered video of it, and from its front nodes alone."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from zsdt.errors import DataError
from zsdt.evaluation.lab_material import compare_material, lab_material_case, scene_of
from zsdt.lab.beam_lab import BeamLabOptions, Storage
from zsdt.lab.clips import ClipSet, make_clips
from zsdt.perception.camera import Camera, ClampSide
from zsdt.scene import BeamShape, Foam
from zsdt.solid.characterise import characterise
from zsdt.solid.loads import LoadOptions
from zsdt.solid.prony import relaxed_young
from zsdt.solid.sampler import SizeRange
from zsdt.solid.specimen import Specimen, SpecimenFem
from zsdt.twin.beam_graph import BeamGraph, beam_body, front_nodes_of, turn_about_y
from zsdt.twin.twin_scene import BeamTwinScene
from zsdt.twin.video_material import FOUND_TO, observed_beam, options_of

FOAM = Foam()


class KnownGrid:
    """Stands in for the U-Net: the painted grid of the first frame, which the lab knows."""

    def __init__(self, clip):
        self.grid = clip.masks(0)[0]

    def probability(self, image):
        return cv2.GaussianBlur((self.grid > 0).astype(np.float32), (3, 3), 0)


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """A slender beam is hit from above; its material is 10 % off in E, g1, tau and density."""
    options = BeamLabOptions(
        clips=1,
        frames=100,
        width=640,
        height=360,
        sizes=SizeRange([50, 50], [10, 10], [10, 10]),
        hand_fraction=0.0,
        mesh_cm=[2.5],
        mismatch=0.1,
        signs=[1, -1, 1, -1],
        loads=LoadOptions(),
        storage=Storage.jpg,
    )
    folder = tmp_path_factory.mktemp("clips")
    make_clips(options, folder)
    return ClipSet(folder)[0]


def test_a_video_says_stiffness_over_density_and_loss_better_than_the_card(clip):
    case = lab_material_case([clip], KnownGrid(clip))
    (row,) = case.rows
    assert abs(row["told young over density %"]) > 15
    assert abs(row["young over density %"]) < 8
    assert abs(row["storage over density %"]) < 5
    assert abs(row["loss factor %"]) < 10


def graph_of(scene, columns, rows):
    body = beam_body(columns, rows, scene, 60.0)
    camera = Camera.facing(distance=1.2, look_at=(0.2, 0.05), focal=900.0, beam_width=scene.width)
    front = front_nodes_of(body, ClampSide.left)
    return BeamGraph(body, front, camera, 1.2, body.points[front], scene.pitch, 0.01)


def test_a_turned_picture_is_told_from_sag_by_its_curve():
    scene = BeamTwinScene(width=0.1, material=FOAM)
    graph = graph_of(scene, 9, 3)
    places = graph.body.points[graph.front_nodes.ravel()]
    fem = SpecimenFem(Specimen(BeamShape(0.4, 0.1, 0.1), FOAM.density, 0.05), places)
    swing = fem.swing(FOAM, 100, 1 / 60, np.array([0.0, 0.0, -0.2]))
    rest = np.repeat(fem.rest(FOAM)[None], 5, axis=0)
    positions = (np.concatenate([rest, swing]) + places) @ turn_about_y(0.01).T
    times = np.arange(105) / 60
    specimen, seen = observed_beam(graph, times, positions, released=6 / 60)
    free = characterise(specimen, seen, replace(options_of(scene), resamples=4))
    believed = characterise(specimen, seen, replace(options_of(scene), resamples=4, turn_sd=0.0))
    truth = relaxed_young(FOAM)
    assert free.static_young == pytest.approx(truth, rel=0.05)
    assert abs(believed.static_young / truth - 1.0) > 2 * abs(free.static_young / truth - 1.0)
    assert free.material.young == pytest.approx(FOAM.young, rel=0.03)
    row = compare_material("made up", free, FOAM)
    assert abs(row["storage over density %"]) < 2 and abs(row["loss factor %"]) < 5
    assert free.static_young_sd > FOUND_TO


def test_nodes_that_were_hardly_seen_are_left_out_and_too_few_are_refused():
    scene = BeamTwinScene(width=0.1, material=FOAM)
    graph = graph_of(scene, 9, 3)
    places = graph.body.points[graph.front_nodes.ravel()]
    sway = 0.01 * np.sin(20 * np.arange(60) / 60)[:, None, None] * (places[:, :1] / 0.4) * np.array([0.0, 0.0, 1.0])
    positions = places + np.where(np.arange(60)[:, None, None] < 10, 0.0, sway)
    positions[:40, 20] = np.nan
    positions[30:33, 14] = np.nan
    _, seen = observed_beam(graph, np.arange(60) / 60, positions)
    assert len(seen.places) == 27 - 3 - 1  # without the clamp and the node that was seldom seen
    assert np.isfinite(seen.displacement).all()
    positions[:, 4:] = np.nan
    with pytest.raises(DataError, match="three nodes"):
        observed_beam(graph, np.arange(60) / 60, positions)


def test_the_scene_of_a_clip_is_what_was_told(clip):
    scene = scene_of(clip)
    assert scene.width == pytest.approx(0.1) and scene.material == clip.scene.material
    assert scene.material != clip.truth.body.material
