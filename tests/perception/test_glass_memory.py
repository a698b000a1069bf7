"""What is remembered of a glass: it steadies container and bottom, follows the glass, and never delays the surface."""

import numpy as np
import pytest

from zsdt.errors import OptionError
from zsdt.perception.glass_memory import GlassMemory, MemoryOptions
from zsdt.perception.glass_segmentation import GlassMasks
from zsdt.perception.glass_window import Box, Window

SIZE = 140, 240  # rows, columns
TOP, BOTTOM, HALF, FLOOR = 20, 120, 35, 108


def truth(middle: float = 90.0, level: float = 60.0) -> tuple[np.ndarray, np.ndarray]:
    """Exact covers of container and liquid; a thick base lies under the liquid."""
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float32)

    def between(value, low, high):
        return np.clip(np.minimum(value - low, high - value) + 0.5, 0, 1)

    container = between(columns, middle - HALF, middle + HALF) * between(rows, TOP, BOTTOM)
    liquid = between(columns, middle - HALF + 3, middle + HALF - 3) * between(rows, level, FLOOR)
    return container, np.minimum(liquid, container)


def seen(container: np.ndarray, liquid: np.ndarray, middle: float = 90.0) -> tuple[GlassMasks, Box]:
    box = Box(round(middle) - HALF, TOP, round(middle) + HALF + 1, BOTTOM + 1)
    return GlassMasks(container.astype(np.float32), liquid.astype(np.float32), Window(-10, -20, 260)), box


def iou(mask: np.ndarray, true: np.ndarray) -> float:
    one, other = mask > 0.5, true > 0.5
    return float((one & other).sum() / (one | other).sum())


def flickering(container, liquid, rng):
    """Blocks of a mask that are wrong in this picture alone."""
    container, liquid = container.copy(), liquid.copy()
    for _ in range(3):
        row, column = int(rng.integers(80, BOTTOM)), int(rng.integers(55, 120))
        container[row : row + 12, column : column + 12] = 0.2
        liquid[row : row + 12, column : column + 12] = rng.choice([0.1, 0.9])
    return container, np.minimum(liquid, container)


def test_what_flickers_in_single_pictures_is_outvoted():
    rng, memory = np.random.default_rng(0), GlassMemory()
    alone, steady = [], []
    for _ in range(20):
        container, liquid = truth()
        masks, box = seen(*flickering(container, liquid, rng))
        told = memory.steadied(masks, box)
        alone.append([iou(masks.container, container), iou(masks.liquid, liquid)])
        steady.append([iou(told.container, container), iou(told.liquid, liquid)])
        assert (told.liquid <= told.container).all()
    assert np.mean(alone[5:], axis=0).max() < 0.97
    assert np.mean(steady[5:], axis=0).min() > 0.99


def test_the_surface_of_the_liquid_comes_without_delay():
    memory = GlassMemory()
    for level in (90, 90, 90, 90, 90, 60, 45, 80):
        container, liquid = truth(level=level)
        told = memory.steadied(*seen(container, liquid))
        np.testing.assert_allclose(told.liquid, liquid, atol=1e-6)


@pytest.mark.parametrize("speed", [0.4, 13.7])
def test_the_memory_goes_with_the_glass(speed):
    memory = GlassMemory()
    for frame in range(8):
        middle = 60 + speed * frame
        container, liquid = truth(middle)
        told = memory.steadied(*seen(container, liquid, middle))
        assert iou(told.container, container) > 0.97 and iou(told.liquid, liquid) > 0.97
        # the axis, by which the twin tells how the glass moves, is where this picture shows it
        middles = [(mask[70] * np.arange(SIZE[1])).sum() / mask[70].sum() for mask in (told.container, container)]
        assert middles[0] == pytest.approx(middles[1], abs=0.2)
    assert memory.seen == 8


def test_a_camera_that_nods_blurs_nothing():
    memory = GlassMemory()
    for frame in range(10):
        nod = 3 * (frame % 4)
        container, liquid = (np.roll(part, nod, axis=0) for part in truth())
        masks, box = seen(container, liquid)
        told = memory.steadied(masks, box.moved(0, nod))
        assert iou(told.container, container) > 0.99 and iou(told.liquid, liquid) > 0.99


def test_a_hand_in_front_of_one_side_hides_nothing_that_is_known_and_leaves_no_mark():
    memory = GlassMemory()
    container, liquid = truth()
    for _ in range(6):
        memory.steadied(*seen(container, liquid))
    hidden = [part.copy() for part in (container, liquid)]
    for part in hidden:
        part[50:, :75] = 0
    for _ in range(3):
        told = memory.steadied(*seen(*hidden))
        assert iou(told.container, container) > 0.98
    told = memory.steadied(*seen(container, liquid))
    assert iou(told.container, container) > 0.99 and iou(told.liquid, liquid) > 0.98


def test_another_thing_in_its_place_is_not_mixed_in_and_soon_taken_as_it_is():
    memory = GlassMemory(MemoryOptions(patience=3))
    container, liquid = truth()
    for _ in range(5):
        memory.steadied(*seen(container, liquid))
    stump = container.copy()
    stump[60:] = 0
    for _ in range(3):
        told = memory.steadied(*seen(stump, np.zeros_like(stump)))
        np.testing.assert_array_equal(told.container, stump.astype(np.float32))
    assert memory.seen == 0
    memory.steadied(*seen(stump, np.zeros_like(stump)))
    assert memory.seen == 1


def test_masks_are_not_changed_and_without_memory_they_are_given_back():
    container, liquid = truth()
    masks, box = seen(container, liquid)
    before = masks.container.copy()
    memory = GlassMemory()
    memory.steadied(*seen(*(np.roll(part, 2, axis=0) for part in (container, liquid))))
    memory.steadied(masks, box)
    np.testing.assert_array_equal(masks.container, before)
    assert GlassMemory(MemoryOptions(frames=1)).steadied(masks, box) is masks
    for wrong in ({"frames": 0}, {"guard": 0.7}, {"alike": 1.0}):
        with pytest.raises(OptionError):
            MemoryOptions(**wrong)
