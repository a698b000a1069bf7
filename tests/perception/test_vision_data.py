"""Labelled pictures: from pairs, folders and COCO polygons; crops keep picture and mask together."""

import json

import cv2
import numpy as np
import pytest

from zsdt.errors import DataError, OptionError
from zsdt.perception.vision_augment import Augmentation, random_crop
from zsdt.perception.vision_data import drawn_polygons, labelled, read_folder
from zsdt.perception.vision_strangers import face_of, repainted, with_strangers

STILL = Augmentation(
    scale_low=1.0,
    scale_high=1.0,
    rotation=0.0,
    turns=False,
    permute=0.0,
    invert=0.0,
    contrast=0.0,
    brightness=0.0,
    tint=0.0,
    blur=0.0,
    noise=0.0,
    strangers=0.0,
)


def striped(h: int = 90, w: int = 120) -> tuple[np.ndarray, np.ndarray]:
    """A picture whose every channel is its mask."""
    mask = np.zeros((h, w), np.uint8)
    mask[::16] = mask[1::16] = mask[2::16] = 255
    mask[:, ::20] = 255
    return np.repeat(mask[..., None], 3, axis=2), mask


@pytest.mark.parametrize("beside", [False, True], ids=["images/ and masks/", "photo.jpg and photo.png"])
def test_a_folder_of_photos_and_masks(tmp_path, beside):
    image, mask = striped()
    for name in ("a", "b"):
        photo = tmp_path / ("" if beside else "images") / f"{name}.jpg"
        drawn = tmp_path / ("" if beside else "masks") / f"{name}.png"
        for path, content in ((photo, image), (drawn, mask // 255 if name == "a" else mask)):
            path.parent.mkdir(exist_ok=True)
            cv2.imwrite(str(path), content)
    data = read_folder(tmp_path)
    assert list(data.names) == ["a", "b"]
    for read in data.masks:  # also from a mask of class numbers 0 and 1
        np.testing.assert_array_equal(read, mask)


def test_what_is_wrong_with_a_folder_is_said(tmp_path):
    image, mask = striped()
    with pytest.raises(DataError, match="no folder"):
        read_folder(tmp_path / "nowhere")
    with pytest.raises(DataError, match="no PNG or JPG"):
        read_folder(tmp_path)
    for part in ("images", "masks"):
        (tmp_path / part).mkdir()
    cv2.imwrite(str(tmp_path / "images" / "a.png"), image)
    with pytest.raises(DataError, match="no mask of the same name"):
        read_folder(tmp_path)
    cv2.imwrite(str(tmp_path / "masks" / "a.png"), mask[:-1])
    with pytest.raises(DataError, match="one size"):
        read_folder(tmp_path)
    cv2.imwrite(str(tmp_path / "masks" / "a.png"), 255 - mask)
    with pytest.raises(DataError, match="white on black"):
        read_folder(tmp_path)
    (tmp_path / "masks" / "a.png").write_bytes(b"nonsense")
    with pytest.raises(DataError, match="no readable picture"):
        read_folder(tmp_path)


def coco(polygon: object, categories: tuple[str, ...] = ("grid lines",)) -> dict:
    """One picture with one polygon of every class, and one without."""
    return {
        "images": [{"id": 7, "file_name": "a.png"}, {"id": 9, "file_name": "b.png"}],
        "categories": [{"id": k, "name": name} for k, name in enumerate(categories)],
        "annotations": [{"image_id": 7, "category_id": k, "segmentation": polygon} for k in range(len(categories))],
    }


def write_coco(folder, content: object) -> None:
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(folder / name), striped()[0])
    (folder / "labels.json").write_text(json.dumps(content))


def test_polygons_cover_what_they_enclose(tmp_path):
    # Corners of pixels: from 10 to 30 and from 5.5 to 20, so half of the pixels of row 5 are covered.
    write_coco(tmp_path, coco([[10, 5.5, 30, 5.5, 30, 20, 10, 20]]))
    data = read_folder(tmp_path)
    mask = data.masks[0].astype(float) / 255
    assert mask.sum() == pytest.approx(20 * 14.5, rel=0.03)
    assert (mask[7:19, 11:29] > 0.99).all()
    assert mask[5, 12:28].mean() == pytest.approx(0.5, abs=0.13)
    assert data.masks[1].max() == 0  # labelled as without lines


def test_a_class_can_be_chosen_and_must_be_where_there_are_several(tmp_path):
    write_coco(tmp_path, coco([[10, 5, 30, 5, 30, 20]], ("beam", "lines")))
    with pytest.raises(DataError, match="beam, lines"):
        read_folder(tmp_path)
    assert read_folder(tmp_path, "lines").masks[0].max() == 255


def test_broken_coco_files_are_said(tmp_path):
    write_coco(tmp_path, coco({"counts": "abc", "size": [90, 120]}))
    with pytest.raises(DataError, match="run-length"):
        read_folder(tmp_path)
    (tmp_path / "labels.json").write_text("{}")
    with pytest.raises(DataError, match="no COCO JSON"):
        read_folder(tmp_path)
    write_coco(tmp_path, coco([[10, 5, 30, 5, 30, 20]]))
    (tmp_path / "b.png").unlink()
    with pytest.raises(DataError, match=r"b\.png"):
        read_folder(tmp_path)


def test_area_of_a_slanted_line_is_its_length_times_its_width():
    a, b, width = np.array([20.0, 15.0]), np.array([95.0, 70.0]), 5.0
    across = np.array([-(b - a)[1], (b - a)[0]]) / np.linalg.norm(b - a) * width / 2
    mask = drawn_polygons([np.array([a + across, b + across, b - across, a - across])], (90, 120))
    assert mask.sum() / 255 == pytest.approx(np.linalg.norm(b - a) * width, rel=0.05)


def test_pairs_of_shares_and_truths_become_masks():
    image, mask = striped()
    data = labelled([(image, mask > 0), (image, mask / 255.0), (image, mask)])
    for read in data.masks:
        np.testing.assert_array_equal(read, mask)


def test_held_out_pictures_are_others_and_drawn_by_the_seed():
    image, mask = striped()
    data = labelled([(image, mask)] * 20)
    learned, judged = data.held_out(0.1, seed=3)
    assert len(judged) == 2 and set(learned.names) | set(judged.names) == set(data.names)
    assert not set(learned.names) & set(judged.names)
    assert data.held_out(0.1, seed=3)[1].names == judged.names
    with pytest.raises(DataError, match="too few"):
        data.pick([0]).held_out(0.5, seed=0)


def test_a_crop_without_changes_is_a_part_of_the_picture():
    image, mask = striped(200, 200)
    image = np.random.default_rng(0).integers(0, 256, image.shape, dtype=np.uint8)
    crop, paint = random_crop(image, mask, face_of(mask), 64, STILL, np.random.default_rng(1))
    found = cv2.matchTemplate(image.astype(np.float32), ((crop + 0.5) * 255).astype(np.float32), cv2.TM_SQDIFF)
    _, _, (u, v), _ = cv2.minMaxLoc(found)
    # Subpixel placement blurs a random picture; the mask, with its wide lines, must be that of the same place.
    assert np.abs(paint - mask[v : v + 64, u : u + 64] / 255.0).mean() < 0.15


@pytest.mark.parametrize("seed", range(6))
def test_a_mask_goes_where_its_picture_goes(seed):
    image, mask = striped(200, 260)
    shape_only = Augmentation(
        permute=0.0,
        invert=0.0,
        contrast=0.0,
        brightness=0.0,
        tint=0.0,
        blur=0.0,
        noise=0.0,
        rotation=30.0,
        strangers=0.0,
        repaint=0.0,
    )
    crop, paint = random_crop(image, mask, face_of(mask), 64, shape_only, np.random.default_rng(seed))
    np.testing.assert_allclose(crop + 0.5, np.repeat(paint[..., None], 3, axis=2), atol=0.01)


def test_colours_change_but_the_mask_does_not():
    image, mask = striped(200, 260)
    colours = Augmentation(scale_low=1.0, scale_high=1.0, rotation=0.0, turns=False, strangers=0.0, repaint=0.0)
    plain = random_crop(image, mask, face_of(mask), 64, STILL, np.random.default_rng(5))
    changed = random_crop(image, mask, face_of(mask), 64, colours, np.random.default_rng(5))
    assert np.abs(changed[0] - plain[0]).mean() > 0.01
    assert changed[0].min() >= -0.5 and changed[0].max() <= 0.5


def test_strangers_stay_behind_the_face():
    """What the lines enclose is the face; patterns come elsewhere, and everywhere else in the long run."""
    image = np.full((128, 128, 3), 120, np.uint8)
    mask = np.zeros((128, 128), np.uint8)
    for k in range(30, 91, 20):
        mask[k - 1 : k + 2, 29:92] = mask[29:92, k - 1 : k + 2] = 255
    face = face_of(mask)
    assert (face[30:90, 30:90] == 255).all() and face[:27].max() == 0
    changed = [with_strangers(image, face, np.random.default_rng(seed)) for seed in range(40)]
    assert all((picture[face > 0] == 120).all() for picture in changed)
    touched = np.mean([np.abs(picture.astype(int) - 120).max(axis=2) > 8 for picture in changed], axis=0)
    assert touched[face == 0].min() > 0.2


def test_repainting_changes_both_colours_and_keeps_the_texture():
    rng = np.random.default_rng(0)
    mask = np.zeros((96, 96), np.uint8)
    for k in range(16, 81, 16):
        mask[k - 1 : k + 2, 15:82] = mask[15:82, k - 1 : k + 2] = 255
    face = face_of(mask)
    image = np.full((96, 96, 3), 30, np.uint8)
    image[face > 0] = 180
    image[mask > 0] = 90
    image = np.clip(image + rng.normal(0, 4, image.shape), 0, 255).astype(np.uint8)
    foam = (face > 0) & (mask == 0)
    foam[:16] = foam[81:] = foam[:, :16] = foam[:, 81:] = False  # the border of the face is half painted
    for seed in range(8):
        new = repainted(image, mask, face, np.random.default_rng(seed))
        np.testing.assert_array_equal(new[face == 0], image[face == 0])
        paint, rest = new[mask > 0].mean(axis=0), new[foam].mean(axis=0)
        assert np.abs(paint - rest).max() > 50  # they can be told apart
        free = (rest > 20) & (rest < 235)  # channels that were not clipped
        texture = image[foam].std(axis=0)[free]
        np.testing.assert_allclose(new[foam].std(axis=0)[free], texture, rtol=0.1)


def test_options_refuse_nonsense():
    with pytest.raises(OptionError, match="scale_low"):
        Augmentation(scale_low=2.0)
    with pytest.raises(OptionError, match="shares"):
        Augmentation(permute=1.5)
