"""A camera's lens from pictures of a board: chessboard or ChArUco, by OpenCV's bundle adjustment (Zhang's method)."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Shaped

from zsdt.errors import DataError, OptionError
from zsdt.perception.camera import Camera

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")


class BoardKind(Enum):
    """What is printed on the board; ChArUco may be partly hidden and is never mistaken for its mirror image."""

    chessboard = "chessboard"
    charuco = "charuco"


@dataclass
class BoardOptions:
    """A calibration board and how its pictures are judged.

    columns, rows: number of squares. square, marker [m]: side of a square and of a ChArUco marker; only their ratio
    touches the lens. dictionary: of the markers, a name of `cv2.aruco`. minimum_images: with fewer usable pictures
    there is no result. k3: whether the third radial coefficient is fitted (needs boards near the picture's corners).
    tilt_deg: a board must be turned away from the camera by this much in at least two pictures; boards that all face
    it leave the focal length open (it is then exchanged for their distance, and the fit does not show it).
    """

    kind: BoardKind = BoardKind.charuco
    columns: int = 9
    rows: int = 6
    square: float = 0.025
    marker: float = 0.018
    dictionary: str = "DICT_4X4_50"
    minimum_images: int = 6
    k3: bool = False
    tilt_deg: float = 10.0

    def __post_init__(self) -> None:
        if self.columns < 3 or self.rows < 3 or self.square <= 0:
            raise OptionError("A calibration board needs at least 3 x 3 squares of positive size.")
        if self.kind is BoardKind.charuco:
            if not 0 < self.marker < self.square:
                raise OptionError("The marker of a ChArUco board must be smaller than its square and above 0.")
            if not self.dictionary.startswith("DICT_") or not hasattr(cv2.aruco, self.dictionary):
                raise OptionError(f"OpenCV knows no marker dictionary '{self.dictionary}'; take DICT_4X4_50 for one.")
        if self.minimum_images < 3:
            raise OptionError("minimum_images must be at least 3: fewer views do not fix a lens.")


@dataclass(frozen=True)
class Calibration:
    """What calibration found.

    camera: its world is its own frame. rms_px: root mean square of the corners' misfit. focal_std_px: standard
    deviation of the focal length from the scatter of the corners alone. Names of the pictures used, and of the others
    with the reason.
    """

    camera: Camera
    rms_px: float
    focal_std_px: float
    used: list[str]
    rejected: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class BoardView:
    """Corners of a board in one picture: where they are on the board [m] and in the picture [px]."""

    on_board: Float[np.ndarray, "corners 3"]
    pixels: Float[np.ndarray, "corners 2"]


def charuco_board(board: BoardOptions) -> cv2.aruco.CharucoBoard:
    """OpenCV's board; its `generateImage` prints it."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    return cv2.aruco.CharucoBoard((board.columns, board.rows), board.square, board.marker, dictionary)


def find_board(image: Shaped[np.ndarray, "height width *channels"], board: BoardOptions) -> BoardView | None:
    """Corners of the board in a picture, to a fraction of a pixel; None where it is not seen well enough."""
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    if board.kind is BoardKind.charuco:
        corners, numbers, _, _ = cv2.aruco.CharucoDetector(charuco_board(board)).detectBoard(grey)
        if numbers is None or len(numbers) < 8:
            return None
        on_board = np.asarray(charuco_board(board).getChessboardCorners(), np.float64)[numbers.ravel()]
        return BoardView(on_board, corners.reshape(-1, 2).astype(np.float64))
    inner = (board.columns - 1, board.rows - 1)
    found, corners = cv2.findChessboardCornersSB(
        grey, inner, flags=cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE
    )
    if not found:
        return None
    column, row = np.meshgrid(np.arange(inner[0]), np.arange(inner[1]))
    on_board = np.column_stack([column.ravel(), row.ravel(), np.zeros(column.size)]) * board.square
    return BoardView(on_board, corners.reshape(-1, 2).astype(np.float64))


def calibrate(
    images: Sequence[Shaped[np.ndarray, "height width *channels"]],
    board: BoardOptions,
    names: Sequence[str] | None = None,
) -> Calibration:
    """The camera that took `images` (uint8, grey or BGR) of a board. Pictures without a board are listed.

    Raises: DataError where too few pictures show the board or the views do not fix the focal length.
    """
    labels = list(names) if names is not None else [f"image {k}" for k in range(len(images))]
    views: dict[str, BoardView] = {}
    rejected: dict[str, str] = {}
    size: tuple[int, int] | None = None
    for name, image in zip(labels, images, strict=True):
        shape = (image.shape[1], image.shape[0])
        view = find_board(image, board)
        if view is None:
            rejected[name] = f"no {board.kind.value} of {board.columns} x {board.rows} squares found"
        elif size is not None and shape != size:
            rejected[name] = f"{shape[0]} x {shape[1]} px, not {size[0]} x {size[1]} as the pictures before it"
        else:
            size, views[name] = shape, view
    if size is None or len(views) < board.minimum_images:
        raise DataError(
            f"Calibration needs the board in at least {board.minimum_images} pictures and found it in {len(views)} of "
            f"{len(labels)}{_listed(rejected)}; take more pictures, or correct kind, columns and rows of the board."
        )
    return _solve(views, rejected, size, board)


def _solve(
    views: dict[str, BoardView], rejected: dict[str, str], size: tuple[int, int], board: BoardOptions
) -> Calibration:
    """Least squares over all views."""
    try:
        rms, matrix, distortion, turns, _, deviations, _, _ = cv2.calibrateCameraExtended(
            [view.on_board.astype(np.float32) for view in views.values()],
            [view.pixels.astype(np.float32) for view in views.values()],
            size,
            np.eye(3),
            np.zeros(5),
            flags=0 if board.k3 else cv2.CALIB_FIX_K3,
        )
    except cv2.error as error:
        raise DataError(
            "The views of the board fix no lens (OpenCV stopped); show it from several directions, not along one line."
        ) from error
    tilts = [np.degrees(np.arccos(min(abs(cv2.Rodrigues(turn)[0][2, 2]), 1.0))) for turn in turns]
    if sum(tilt >= board.tilt_deg for tilt in tilts) < 2:
        raise DataError(
            f"The board faces the camera in all pictures (tilted by {max(tilts):.0f} degrees at most), which leaves "
            "the focal length open; tilt the board by 20 to 45 degrees in several directions."
        )
    camera = Camera(matrix, distortion.ravel()[:5], np.eye(3), np.zeros(3), *size)
    return Calibration(camera, float(rms), float(np.max(deviations.ravel()[:2])), list(views), rejected)


def calibrate_folder(folder: str | os.PathLike[str], board: BoardOptions) -> Calibration:
    """`calibrate` with all pictures of a folder; files that do not decode are listed with the others.

    Raises: DataError where the folder is missing or has no pictures.
    """
    root = Path(folder)
    if not root.is_dir():
        raise DataError(f"There is no folder {folder}; give the folder with the pictures of the calibration board.")
    paths = sorted(p for p in root.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES)
    if not paths:
        raise DataError(f"{folder} holds no pictures ({', '.join(IMAGE_SUFFIXES)}); put those of the board there.")
    images = {path.name: cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in paths}
    broken = {name: "does not decode as a picture" for name, image in images.items() if image is None}
    good = {name: image for name, image in images.items() if image is not None}
    try:
        result = calibrate(list(good.values()), board, list(good))
    except DataError as error:
        if broken:
            raise DataError(f"{error} Not readable: {', '.join(broken)}.") from error
        raise
    return Calibration(result.camera, result.rms_px, result.focal_std_px, result.used, {**result.rejected, **broken})


def _listed(rejected: dict[str, str]) -> str:
    """The first few pictures that were not used, for a message."""
    if not rejected:
        return ""
    shown = ", ".join(list(rejected)[:5]) + (" ..." if len(rejected) > 5 else "")
    return f" (not in {shown})"
