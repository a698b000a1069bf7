"""Frames come back from folders and files, and whatever is broken says why."""

import cv2
import numpy as np
import pytest

from zsdt.errors import DataError, OptionError
from zsdt.perception.video import open_video, write_frames, write_video


def moving_pattern(count: int = 12, size: tuple[int, int] = (96, 64)) -> list[np.ndarray]:
    coarse = np.random.default_rng(0).integers(30, 220, (9, 14, 3), dtype=np.uint8)
    picture = cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC)
    return [np.roll(picture, 4 * k, axis=1) for k in range(count)]


@pytest.mark.parametrize("suffix", [".mp4", ".webm"])
def test_a_video_comes_back_as_it_was_written(tmp_path, suffix, capfd) -> None:
    frames = moving_pattern()
    path = tmp_path / f"beam{suffix}"
    assert write_video(path, frames, 25.0) == len(frames)
    source = open_video(path)
    assert (source.fps, source.size, source.count) == (25.0, (96, 64), len(frames))
    for _ in range(2):  # a file can be read twice
        read = list(source)
        assert [f.index for f in read] == list(range(len(frames))) and source.missing == []
        np.testing.assert_allclose([f.time for f in read], np.arange(len(frames)) / 25.0)
        assert max(np.abs(f.image.astype(int) - frames[f.index]).mean() for f in read) < 6.0
    assert open_video(str(path), fps=50.0).fps == 50.0
    assert capfd.readouterr().err == ""  # the codec keeps its opinions to itself


def test_a_folder_of_pictures_comes_back_without_loss(tmp_path) -> None:
    frames = moving_pattern()
    assert write_frames(tmp_path / "frames", frames) == len(frames)
    source = open_video(tmp_path / "frames", fps=10.0)
    for frame in source:
        np.testing.assert_array_equal(frame.image, frames[frame.index])
        assert frame.time == frame.index / 10.0
    assert source.count == len(frames)


def test_frames_that_do_not_decode_are_missing_and_the_rest_goes_on(tmp_path) -> None:
    write_frames(tmp_path / "frames", moving_pattern())
    (tmp_path / "frames" / "00004.png").write_bytes(b"torn")
    source = open_video(tmp_path / "frames")
    assert [f.index for f in source] == [0, 1, 2, 3, 5, 6, 7, 8, 9, 10, 11]
    assert source.missing == [4]


def test_a_damaged_video_goes_on_behind_the_damage_or_reports_its_loss(tmp_path) -> None:
    write_video(tmp_path / "beam.mp4", moving_pattern(40), 25.0)
    data = bytearray((tmp_path / "beam.mp4").read_bytes())
    middle = len(data) // 2
    data[middle : middle + len(data) // 5] = bytes(len(data) // 5)
    (tmp_path / "damaged.mp4").write_bytes(data)
    source = open_video(tmp_path / "damaged.mp4")
    seen = [f.index for f in source]
    assert source.missing, "damage must not pass unnoticed"
    assert sorted(seen + source.missing) == list(range(40))
    assert seen[:5] == [0, 1, 2, 3, 4]


def broken_text(path) -> None:
    path.write_text("this is a letter, no video\n" * 50)


def broken_half(path) -> None:
    write_video(path.with_name("whole.mp4"), moving_pattern(), 25.0)
    path.write_bytes(path.with_name("whole.mp4").read_bytes()[:200])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: None, "There is no video"),
        (lambda path: path.touch(), "is empty"),
        (broken_text, "cannot be read as a video"),
        (broken_half, "cannot be read as a video"),
        (lambda path: path.mkdir(), "holds no pictures"),
    ],
)
def test_what_cannot_be_read_says_why(tmp_path, make, message) -> None:
    make(tmp_path / "clip.mp4")
    with pytest.raises(DataError, match=message):
        open_video(tmp_path / "clip.mp4")


def test_pictures_of_two_sizes_are_no_video(tmp_path) -> None:
    write_frames(tmp_path / "frames", moving_pattern(3))
    cv2.imwrite(str(tmp_path / "frames" / "00001.png"), np.zeros((10, 10, 3), np.uint8))
    with pytest.raises(DataError, match="keep one video in a folder"):
        list(open_video(tmp_path / "frames"))
    for file in (tmp_path / "frames").iterdir():
        file.write_bytes(b"torn")
    with pytest.raises(DataError, match="None of the 3 pictures"):
        open_video(tmp_path / "frames")


def test_an_absent_webcam_says_so() -> None:
    for source in ("97", 97):
        with pytest.raises(DataError, match="Webcam 97 gives no picture"):
            open_video(source)


def test_videos_that_cannot_be_written_leave_nothing_behind(tmp_path) -> None:
    with pytest.raises(DataError, match="no frames"):
        write_video(tmp_path / "empty.mp4", [], 25.0)
    with pytest.raises(DataError, match="another size"):
        write_video(tmp_path / "sizes.mp4", [np.zeros((64, 96, 3), np.uint8), np.zeros((32, 32, 3), np.uint8)], 25.0)
    with pytest.raises(OptionError, match=r"\.mp4"):
        write_video(tmp_path / "clip.avi", moving_pattern(2), 25.0)
    with pytest.raises(OptionError, match="fps"):
        open_video(tmp_path, fps=0.0)
    assert list(tmp_path.iterdir()) == []
