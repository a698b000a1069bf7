"""Frames from wherever they come: a folder of pictures, a video file, a webcam; and video files that open elsewhere."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import UInt8

from zsdt.errors import DataError, OptionError
from zsdt.files import atomic_path

log = logging.getLogger(__name__)

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
DEFAULT_FPS = 60.0
# What OpenCV's wheels can write and browsers and viewers play; mp4v plays in few, avc1 is not there. The encoders take
# no options. A noisy frame of 960 x 540 costs 0.33 CPU-s as VP9 (40 kB) and 0.08 as VP8 (90 kB).
CODECS = {".mp4": "vp09", ".webm": "VP80"}
PATIENCE = 60  # failed reads in a row after which a source counts as ended
# Broken files are told in our words; the decoder's own go to the terminal past every logger.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")


@dataclass(frozen=True)
class VideoFrame:
    """One picture: its number from 0, its time [s] and the picture (BGR)."""

    index: int
    time: float
    image: UInt8[np.ndarray, "height width 3"]


@runtime_checkable
class FrameSource(Protocol):
    """Frames in order. Numbers of frames that did not decode are left out of the iteration and kept in `missing`.

    count: number of frames, None where nobody knows it before the end; size: (width, height) px.
    """

    name: str
    fps: float
    size: tuple[int, int]
    missing: list[int]

    @property
    def count(self) -> int | None: ...

    def __iter__(self) -> Iterator[VideoFrame]: ...


@dataclass
class FolderSource:
    """Pictures of a folder, sorted by name; `fps` is given, not known."""

    name: str
    paths: list[Path]
    fps: float
    size: tuple[int, int]
    missing: list[int] = field(default_factory=list)

    @property
    def count(self) -> int:
        """Number of files."""
        return len(self.paths)

    def __iter__(self) -> Iterator[VideoFrame]:
        self.missing.clear()
        for index, path in enumerate(self.paths):
            image = cv2.imread(str(path), cv2.IMREAD_COLOR)
            if image is None:
                log.warning("%s does not decode as a picture; frame %d is missing.", path.name, index)
                self.missing.append(index)
                continue
            if (image.shape[1], image.shape[0]) != self.size:
                raise DataError(
                    f"{path} is {image.shape[1]} x {image.shape[0]} px, but the first picture is "
                    f"{self.size[0]} x {self.size[1]}; keep one video in a folder."
                )
            yield VideoFrame(index, index / self.fps, image)


@dataclass
class FileSource:
    """A video file; times follow from its frame rate."""

    name: str
    fps: float
    size: tuple[int, int]
    count: int | None
    missing: list[int] = field(default_factory=list)

    def __iter__(self) -> Iterator[VideoFrame]:
        self.missing.clear()
        capture = cv2.VideoCapture(self.name)
        gap: list[int] = []
        try:
            index = 0
            while True:
                good = capture.grab()
                # Decoders stumble over a damaged packet and go on behind it: try as far as the file says it goes.
                if not good and (self.count is None or index >= self.count or len(gap) >= PATIENCE):
                    break
                found, image = capture.retrieve() if good else (False, None)
                if found and image is not None and image.size:
                    self._lose(gap)
                    yield VideoFrame(index, index / self.fps, image)
                else:
                    gap.append(index)
                index += 1
        finally:
            capture.release()
            self._lose(gap)

    def _lose(self, gap: list[int]) -> None:
        """Reports a run of frames that did not decode, once, and empties the list."""
        if gap:
            log.warning("Frames %d to %d of %s do not decode; they are missing.", gap[0], gap[-1], self.name)
            self.missing.extend(gap)
            gap.clear()


@dataclass
class WebcamSource:
    """A camera of this computer; it can be read once. Times are those at which its frames came, `fps` is its claim."""

    name: str
    fps: float
    size: tuple[int, int]
    capture: cv2.VideoCapture
    count: None = None
    missing: list[int] = field(default_factory=list)

    def __iter__(self) -> Iterator[VideoFrame]:
        began = cv2.getTickCount()
        index = failed = 0
        try:
            while failed < PATIENCE:
                good, image = self.capture.read()
                time = (cv2.getTickCount() - began) / cv2.getTickFrequency()
                if good and image is not None and image.size:
                    failed = 0
                    yield VideoFrame(index, time, image)
                else:
                    failed += 1
                    self.missing.append(index)
                index += 1
        finally:
            self.capture.release()
        raise DataError(f"Webcam {self.name} gave no picture {PATIENCE} times in a row; check its cable.")


def open_video(source: str | int | os.PathLike[str], fps: float | None = None) -> FrameSource:
    """Frames of a folder of PNG or JPG, of a video file, or of a webcam (its number, also as text).

    fps: frames per second of a folder (default 60), or instead of what a video file says.
    Raises: DataError with the reason where there is nothing to read; OptionError for an fps that is not positive.
    """
    if fps is not None and not (fps > 0 and np.isfinite(fps)):
        raise OptionError(f"fps is {fps}; give the camera's frames per second.")
    if isinstance(source, int) or (isinstance(source, str) and source.isdigit() and not Path(source).exists()):
        return _open_webcam(int(source), fps)
    path = Path(source)
    if path.is_dir():
        return _open_folder(path, fps or DEFAULT_FPS)
    if not path.exists():
        raise DataError(f"There is no video {path}; give a video file, a folder of pictures or the number of a webcam.")
    return _open_file(path, fps)


def _open_folder(path: Path, fps: float) -> FolderSource:
    paths = sorted(p for p in path.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES)
    if not paths:
        raise DataError(
            f"The folder {path} holds no pictures ({', '.join(IMAGE_SUFFIXES)}); give the folder of frames."
        )
    for first in paths:
        image = cv2.imread(str(first), cv2.IMREAD_COLOR)
        if image is not None:
            return FolderSource(str(path), paths, fps, (image.shape[1], image.shape[0]))
    raise DataError(f"None of the {len(paths)} pictures in {path} can be read; they are damaged or no pictures.")


def _open_file(path: Path, fps: float | None) -> FileSource:
    if path.stat().st_size == 0:
        raise DataError(f"The video {path} is empty (0 bytes); record or copy it again.")
    capture = cv2.VideoCapture(str(path))
    try:
        good, image = capture.read() if capture.isOpened() else (False, None)
        if not good or image is None:
            raise DataError(
                f"{path} cannot be read as a video: it is damaged, no video, or of an unknown kind; "
                "convert it to .mp4 or give a folder of pictures."
            )
        told = float(capture.get(cv2.CAP_PROP_FPS))
        count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    finally:
        capture.release()
    if fps is None and not (1.0 <= told <= 1000.0):
        raise DataError(f"The video {path} does not say its frame rate; give fps.")
    return FileSource(str(path), fps or told, (image.shape[1], image.shape[0]), count if count > 0 else None)


def _open_webcam(number: int, fps: float | None) -> WebcamSource:
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        capture = cv2.VideoCapture(number)
        good, image = capture.read() if capture.isOpened() else (False, None)
    finally:
        cv2.utils.logging.setLogLevel(level)
    if not good or image is None:
        capture.release()
        raise DataError(f"Webcam {number} gives no picture; check that it is plugged in and that no program uses it.")
    told = float(capture.get(cv2.CAP_PROP_FPS))
    rate = fps or (told if 1.0 <= told <= 1000.0 else 30.0)
    return WebcamSource(str(number), rate, (image.shape[1], image.shape[0]), capture)


@contextmanager
def _muted() -> Iterator[None]:
    """Keeps what C code writes to the terminal from it for a moment.

    WebM knows no four-letter codes, so OpenCV complains past every logger that VP80 is none of them, and then writes
    the file as asked.
    """
    sys.stderr.flush()
    with open(os.devnull, "wb") as nowhere:
        kept = os.dup(2)
        try:
            os.dup2(nowhere.fileno(), 2)
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)


def write_video(path: str | os.PathLike[str], frames: Iterable[UInt8[np.ndarray, "height width 3"]], fps: float) -> int:
    """Writes BGR frames of one size, beside and then moved; gives back their number.

    The suffix chooses: .mp4 is VP9 (small, slow), .webm is VP8 (four times faster).
    Raises: DataError where the disk or the codec does not take it or there is no frame; OptionError for another
    suffix.
    """
    target = Path(path)
    suffix = target.suffix.lower()
    if suffix not in CODECS:
        raise OptionError(f"Videos are written as {' or '.join(CODECS)}, not '{suffix}'; change the name of {target}.")
    count = 0
    with atomic_path(target) as beside:
        named = beside.with_suffix(suffix)  # OpenCV chooses the container by the suffix
        writer: cv2.VideoWriter | None = None
        try:
            for frame in frames:
                if writer is None:
                    size = (frame.shape[1], frame.shape[0])
                    with _muted():
                        writer = cv2.VideoWriter(str(named), cv2.VideoWriter.fourcc(*CODECS[suffix]), fps, size)
                    if not writer.isOpened():
                        raise DataError(
                            f"OpenCV cannot write {CODECS[suffix]} video to {target}; write a folder of PNG instead."
                        )
                elif (frame.shape[1], frame.shape[0]) != size:
                    raise DataError(f"Frame {count} for {target} has another size than the first; keep one size.")
                writer.write(np.ascontiguousarray(frame))
                count += 1
        finally:
            if writer is not None:
                writer.release()
            if named.exists():
                os.replace(named, beside)
        if count == 0:
            raise DataError(f"There are no frames to write to {target}.")
    return count


def write_frames(
    folder: str | os.PathLike[str],
    frames: Iterable[UInt8[np.ndarray, "height width 3"]],
    jpeg_quality: int | None = None,
) -> int:
    """Writes frames into a new folder as `00000.png`, ... without loss, or as .jpg of a quality from 0 to 100.

    Gives back their number. Raises: DataError where the disk does not take them.
    """
    suffix, how = ".png", [cv2.IMWRITE_PNG_COMPRESSION, 1]
    if jpeg_quality is not None:
        suffix, how = ".jpg", [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality]
    count = 0
    with atomic_path(folder) as beside:
        beside.mkdir()
        for frame in frames:
            if not cv2.imwrite(str(beside / f"{count:05d}{suffix}"), frame, how):
                raise DataError(f"Could not write frame {count} to {folder}; free some space or choose another folder.")
            count += 1
    return count
