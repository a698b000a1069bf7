"""Windows, backends, instances, and the region that follows a glass."""

import importlib.util

import numpy as np
import pytest
import torch

from tests.perception.made_up_glass import ByColour, drawn
from zsdt.errors import DataError, OptionError
from zsdt.perception.glass_segmentation import (
    OUTPUTS,
    GlassMasks,
    GlassSegmenter,
    MirroringSegmenter,
    instances,
    load_glass_segmenter,
    mean_of,
)
from zsdt.perception.glass_window import OUTSIDE, Window, box_of, cut, put_back
from zsdt.perception.region_of_interest import RegionOfInterest, RegionOptions, parts
from zsdt.perception.segmentation import SegmentationBackend
from zsdt.perception.unet import UNet, UNetOptions
from zsdt.perception.unet_weights import save_unet

torch.set_num_threads(1)
SMALL = UNetOptions([4, 8, 8])


@pytest.fixture
def folder(tmp_path):
    torch.manual_seed(0)
    save_unet(tmp_path, UNet(SMALL, OUTPUTS), SMALL, {"size": 64})
    return tmp_path


def test_a_window_put_back_shows_the_picture_where_it_lies_and_nothing_elsewhere():
    ramp = np.add.outer(np.arange(90), 2 * np.arange(120)).astype(np.uint8)
    image = np.repeat(ramp[..., None], 3, axis=2)
    window = Window(20, 10, 64)
    part = cut(image, window, 64)
    np.testing.assert_array_equal(part, image[10:74, 20:84])
    back = put_back(part[..., 0].astype(np.float32), window, 90, 120)
    np.testing.assert_array_equal(back[10:74, 20:84], ramp[10:74, 20:84])
    assert back.sum() == ramp[10:74, 20:84].astype(float).sum()


@pytest.mark.parametrize("size", [32, 96, 192])
def test_resampling_moves_no_edge(size):
    step = np.zeros((96, 96, 3), np.uint8)
    step[41:] = 255
    window = Window.whole(96, 96)
    back = put_back(cut(step, window, size)[..., 0].astype(np.float32) / 255, window, 96, 96)
    assert back[:, 48].sum() == pytest.approx(55, abs=0.5)


def test_beyond_the_border_a_window_is_grey():
    part = cut(np.zeros((40, 60, 3), np.uint8), Window(-10, -10, 80), 80)
    assert (part[:10] == OUTSIDE).all() and (part[:, 70:] == OUTSIDE).all() and (part[10:50, 10:70] == 0).all()


def test_masks_have_the_size_of_the_picture_and_no_liquid_outside_its_container(folder):
    segmenter = load_glass_segmenter(folder)
    assert isinstance(segmenter, GlassSegmenter)
    image = np.random.default_rng(0).integers(0, 256, (50, 90, 3), dtype=np.uint8)
    masks = segmenter.masks(image)
    assert masks.container.shape == masks.liquid.shape == (50, 90)
    assert masks.container.dtype == masks.liquid.dtype == np.float32
    assert (masks.liquid <= masks.container).all()
    near = segmenter.masks(image, Window(30, 5, 32))
    assert near.container[:, :30].sum() == 0 and near.container[5:37, 30:62].min() > 0


@pytest.mark.skipif(importlib.util.find_spec("openvino") is None, reason="openvino is not installed")
def test_openvino_gives_what_torch_gives(folder):
    image = np.random.default_rng(1).integers(0, 256, (80, 100, 3), dtype=np.uint8)
    one, other = (
        load_glass_segmenter(folder, SegmentationBackend(backend)).masks(image) for backend in ("eager", "openvino")
    )
    np.testing.assert_allclose(one.container, other.container, atol=1e-3)
    np.testing.assert_allclose(one.liquid, other.liquid, atol=1e-3)


def test_weights_of_a_grid_and_sizes_that_do_not_fit_are_refused(folder, tmp_path):
    with pytest.raises(OptionError, match="multiple"):
        load_glass_segmenter(folder, size=70)
    save_unet(tmp_path / "grid", UNet(SMALL), SMALL, {})
    with pytest.raises(DataError, match="glasses two"):
        load_glass_segmenter(tmp_path / "grid")


def test_instances_are_the_containers_with_their_own_liquid():
    image, container, liquid = drawn(middle=40)
    other = drawn(middle=120, half=15, level=100)
    image[:, 80:] = other[0][:, 80:]
    found = instances(ByColour(160).masks(image))
    assert [one.box.middle[0] for one in found] == pytest.approx([40, 120], abs=1)
    assert found[0].area == pytest.approx(container.sum(), rel=0.02)
    assert found[0].liquid_area == pytest.approx(liquid.sum(), rel=0.03)
    assert found[1].liquid_area == pytest.approx(other[2].sum(), rel=0.1)
    assert not found[0].cut_off
    assert instances(GlassMasks.nothing(50, 60)) == [] and GlassMasks.nothing(50, 60).empty


def test_the_region_follows_a_moving_glass_at_one_look_a_picture():
    segmenter = ByColour()
    region = RegionOfInterest(segmenter)
    for step in range(12):
        image, container, _ = drawn(240, 400, middle=60 + 20 * step, level=120, half=35, top=60)
        masks = region.masks(image)
        assert region.instance is not None and region.others == 0
        seen = masks.container > 0.5
        assert (seen & container).sum() / (seen | container).sum() > 0.95
        if step == 0:
            segmenter.windows.clear()
    assert len(segmenter.windows) <= 11 + 2
    assert all(window.side < 300 for window in segmenter.windows)


def test_a_lost_glass_is_found_again_and_a_second_one_is_left_alone():
    region = RegionOfInterest(ByColour(128))
    first = drawn(200, 400, middle=90, level=120, half=40, top=50)[0]
    region.masks(first)
    empty = drawn(200, 400, middle=-500)[0]
    assert region.masks(empty).empty and region.instance is None and region.window is None
    back = drawn(200, 400, middle=300, level=120, half=40, top=50)[0]
    assert region.masks(back).container[100, 300] > 0.5
    two = back.copy()
    two[:, :230] = drawn(200, 400, middle=175, level=70, half=50, top=30)[0][:, :230]
    masks = region.masks(two)
    assert masks.container[100, 300] > 0.5 and masks.container[:, :230].max() < 0.5


def test_a_small_glass_in_a_large_picture_is_found_in_a_part_of_it():
    image = drawn(600, 900, middle=700, level=560, half=14, top=540)[0]
    region = RegionOfInterest(ByColour(64), RegionOptions(smallest=0.004))
    masks = region.masks(image)
    assert masks.container[570, 700] > 0.5
    assert region.instance is not None and region.instance.area == pytest.approx(29 * 50, rel=0.1)


def test_parts_cover_the_picture():
    covered = np.zeros((300, 700), bool)
    for window in parts(300, 700):
        covered[window.inside(300, 700)] = True
    assert covered.all()
    assert box_of(np.zeros((3, 3), bool)) is None


def test_the_mirror_image_is_told_as_the_picture_lies(folder):
    """What the network says of the mirror image of a mirrored picture is what it says of the picture, mirrored."""
    segmenter = load_glass_segmenter(folder)
    assert isinstance(segmenter, MirroringSegmenter)
    image = np.random.default_rng(0).integers(0, 256, (64, 90, 3), dtype=np.uint8)
    window = Window(13, 0, 64)
    over = np.ascontiguousarray(image[:, ::-1])
    plain, mirrored = segmenter.masks(image, window), segmenter.mirrored(over, window)
    np.testing.assert_allclose(mirrored.container[:, 13:77], plain.container[:, 13:77][:, ::-1], atol=1e-5)
    np.testing.assert_allclose(mirrored.liquid[:, 13:77], plain.liquid[:, 13:77][:, ::-1], atol=1e-5)


def test_two_looks_are_averaged_where_both_windows_are():
    one, other = (GlassMasks(*np.full((2, 20, 30), value, np.float32), window) for value, window in (
        (0.2, Window(0, 0, 20)), (0.8, Window(10, 5, 20))))  # fmt: skip
    both = mean_of(one, other)
    assert both.window == other.window
    assert both.container[10, 15] == pytest.approx(0.5) and both.liquid[10, 15] == pytest.approx(0.5)
    assert both.container[10, 25] == pytest.approx(0.8) and other.container[10, 15] == np.float32(0.8)


def test_a_known_glass_is_looked_at_from_nearer_and_by_turns_in_the_mirror():
    class Mirroring(ByColour):
        mirrors = 0

        def mirrored(self, image, window=None):
            self.mirrors += 1
            return self.masks(image, window)

    segmenter = Mirroring(128)
    region = RegionOfInterest(segmenter, RegionOptions(wide=4))
    image = drawn(240, 400, middle=150, level=120, half=40, top=60)[0]
    sides, mirrors = [], []
    for _ in range(10):
        region.masks(image)
        sides.append(segmenter.windows[-1].side)
        mirrors.append(segmenter.mirrors)
    assert sides[2] == pytest.approx(170 * 1.5, abs=4) and sides[-1] == pytest.approx(170 * 1.16, abs=4)
    assert mirrors[0] == 2 and mirrors[-1] == 2 + 5  # two at the start, then every other picture
