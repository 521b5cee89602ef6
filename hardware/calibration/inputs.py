"""A calibration's input, recorded or live, and its sanity checks.

A wrong board file is recognised by the pictures; swapped or turned cameras and a wrong scale by the rig that was
given.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from pathlib import Path

import numpy as np

from estimation import se3
from estimation.calibration.camera_rig import MIN_VIEWS
from estimation.calibration.lens_model import KnownLenses, lens_parameters
from estimation.errors import InputError
from estimation.rig import Rig
from estimation.se3 import Array
from hardware.files.rig_file import ImageSource, is_calibrated, read_rig, read_uncalibrated
from hardware.files.session import Session
from hardware.files.session_folder import open_folder
from hardware.recording.session_reader import open_session
from perception.boards.board import DICTIONARIES, MAX_BLUR, MIN_CORNERS, Board, CornerFinder, CornerTable
from perception.frames import Image

SAMPLE_PICTURES = 5  # in which other boards are searched
MAX_MARKER_ERROR = 0.08  # relative, of the marker's edge: thresholding shrinks markers by 4 %
MIN_STRANGER_SHARE = 0.1  # of the pictures, in which an unknown marker is seen
SAME_RIG_DEG, OTHER_RIG_DEG = 6.0, 12.0  # misfit of rotations: below, the same rig; above, another one
MAX_SCALE_ERROR = 0.08  # of the distances between the cameras: new lenses shift them by 3 %

Pictures = Callable[[int], list[Image]]  # some pictures of a camera, by its number


def check_table(table: CornerTable, board: Board, board_file: Path, names: Sequence[str], pictures: Pictures) -> None:
    """InputError that says what the corners show to be wrong; names: of the cameras."""
    _check_strangers(table, board, board_file)
    _check_markers(table, board, board_file)
    for c, name in enumerate(names):
        views, looked, where = int((table.camera == c).sum()), int(table.looked[c]), f"camera {name}"
        if views < MIN_VIEWS:
            advice = "record more" if 0 < looked <= 2 * views else why_unseen(pictures(c), board)
            allowed = f"{MIN_VIEWS} or more; it has {looked} pictures: {advice}"
            raise InputError(where, "pictures that show the board", views, allowed)
        blur = float(np.median(table.blur[table.camera == c]))
        if blur > MAX_BLUR:
            allowed = f"{MAX_BLUR:g} px or less: focus the lens, more light, slower hands"
            raise InputError(where, "blur of the edges", f"{blur:.1f} px", allowed)


def _check_strangers(table: CornerTable, board: Board, board_file: Path) -> None:
    ids, counts = np.unique(table.strangers, return_counts=True)
    often = ids[counts > max(MIN_STRANGER_SHARE * table.looked.sum() / len(table.looked), 3)]
    if len(often):
        got = f"{board.squares[0]} x {board.squares[1]}, markers 0 to {board.markers() - 1}"
        examples = ", ".join(str(i) for i in often[:6])
        raise InputError(board_file, "squares", got, f"those of the board that was held: it has markers {examples} too")


def _check_markers(table: CornerTable, board: Board, board_file: Path) -> None:
    known = table.marker[np.isfinite(table.marker)]
    if len(known) < MIN_VIEWS:
        return
    ratio = float(np.median(known))
    if abs(ratio / board.marker - 1) > MAX_MARKER_ERROR:
        raise InputError(board_file, "marker", board.marker, f"what the pictures show: about {ratio:.2f} of a square")


def why_unseen(pictures: list[Image], board: Board) -> str:
    """Why pictures do not show the board: tries similar boards and mirrored pictures."""
    if not pictures:
        return "it has no pictures"
    half, shown = len(pictures) // 2, _count_showing(pictures, board)
    for words, other in _similar_boards(board).items():
        if _count_showing(pictures, other) > max(half, shown):
            return f"they show another board: {words}"
    if _count_showing([np.ascontiguousarray(p[:, ::-1]) for p in pictures], board) > max(half, shown):
        return "they are mirrored: switch the camera's mirroring off"
    if max(float(picture.std()) for picture in pictures) < 5:
        return "they are of one grey, as behind a cover"
    if shown:
        return "the others do not show it; is it in view, sharp and lit?"
    return "none of them shows a board that is known; is it in view, sharp and lit?"


def _count_showing(pictures: list[Image], board: Board) -> int:
    finder = CornerFinder(board)
    return sum(finder(picture).count >= MIN_CORNERS for picture in pictures)


def pictures_of(session: Session, camera: int) -> list[Image]:
    """A few pictures of a camera, spread over a recording."""
    refs = [ref for refs in session.sets for ref in refs if ref.camera == camera]
    selected = refs[:: max(len(refs) // SAMPLE_PICTURES, 1)][:SAMPLE_PICTURES]
    with closing(session.open_reader()) as reader:
        return [reader.read(ref) for ref in selected]


def _similar_boards(board: Board) -> dict[str, Board]:
    """Boards that are easily taken for this one, by what differs."""
    columns, rows = board.squares
    out = {
        "black and white exchanged (`inverted`)": replace(board, inverted=not board.inverted),
        f"{rows} x {columns} squares": replace(board, squares=(rows, columns)),
        "the other layout (`legacy`)": replace(board, legacy=not board.legacy),
    }
    if board.kind == "charuco":
        size = board.dictionary.split("_")[1]
        alike = (name for name in DICTIONARIES if name.endswith(f"_{size}") and name != board.dictionary)
        out |= {f"dictionary {name}": replace(board, dictionary=name) for name in alike}
    return out


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationInput:
    """What a rig is calibrated from, apart from the corners."""

    title: str  # of the report
    rig: Rig  # names and sizes of the cameras; the rest only if `given`
    calibrated: bool  # whether the session has a calibrated rig
    images: Sequence[ImageSource | None]  # where each camera's pictures are, for the new rig.toml
    lens_sigma: Sequence[Array | None]  # of the given lenses, (9,) per camera or None
    pictures: Pictures  # a few of each camera

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return tuple(camera.name for camera in self.rig.cameras)

    @property
    def lenses(self) -> KnownLenses:
        """The given lenses; those without a sigma are exact."""
        sigma = [np.zeros(9) if own is None else own for own in self.lens_sigma]
        return KnownLenses(np.stack([lens_parameters(camera) for camera in self.rig.cameras]), np.stack(sigma))


def check_against(rig: Rig, before: Rig, board_file: Path, square: float) -> None:
    """InputError where the new rig is the given one with cameras swapped, turned by a quarter, or of another size."""
    places = _rotations(before)
    if misfit(_rotations(rig), places) > OTHER_RIG_DEG:
        for words, other in _common_mistakes(before, places):
            if misfit(_rotations(rig), other) < SAME_RIG_DEG:
                raise InputError("the recording", "cameras", words, "as in its rig.toml (or --new-rig, if it is meant)")
        return
    ratio = _size(rig) / _size(before)
    if abs(ratio - 1) > MAX_SCALE_ERROR:
        allowed = f"about {square / ratio:.3g} mm by the distances between the cameras in rig.toml (or --new-rig)"
        raise InputError(board_file, "square_mm", f"{square:g} mm", allowed)


def camera_shifts(rig: Rig, before: Rig) -> tuple[tuple[float, float], ...]:
    """Distance and angle, mm and degrees, of each camera from its given pose, if the first one's poses agree."""
    same = before.cameras[0].base_from_camera @ se3.inverse(rig.cameras[0].base_from_camera)
    pairs = [(a.base_from_camera, b.base_from_camera) for a, b in zip(rig.cameras, before.cameras, strict=True)]
    off = [se3.log(se3.inverse(b) @ same @ a) for a, b in pairs]
    return tuple((float(np.linalg.norm(x[3:])), float(np.degrees(np.linalg.norm(x[:3])))) for x in off)


def check_distance(rig: Rig, first: str, second: str, distance: float, board_file: Path, square: float) -> None:
    """InputError unless two lenses are as far apart as measured, mm: the corners alone do not show a wrong square."""
    ends = [rig.cameras[rig.index(name)].base_from_camera[:3, 3] for name in (first, second)]
    apart = float(np.linalg.norm(ends[0] - ends[1]))
    if abs(apart / distance - 1) > MAX_SCALE_ERROR:
        got = f"{square:g} mm, which puts {first} and {second} {apart:.0f} mm apart"
        allowed = f"about {square * distance / apart:.3g} mm by the measured distance"
        raise InputError(board_file, "square_mm", got, allowed)


def _rotations(rig: Rig) -> Array:
    return np.stack([c.base_from_camera[:3, :3] for c in rig.cameras])


def misfit(rotations: Array, before: Array) -> float:
    """Largest angle, degrees, between rotations (C, 3, 3) and (C, 3, 3) after the best alignment of the bases."""
    change = se3.nearest_rotation((rotations @ np.swapaxes(before, 1, 2)).sum(0))
    return float(np.degrees(se3.angle_of(np.swapaxes(rotations, 1, 2) @ change @ before)).max())


def _common_mistakes(before: Rig, places: Array) -> Iterator[tuple[str, Array]]:
    """Frequent mistakes with cameras, as text, and the rotations (C, 3, 3) that they cause."""
    names = [c.name for c in before.cameras]
    for a, b in combinations(range(len(names)), 2):
        order = np.arange(len(names))
        order[[a, b]] = b, a
        yield f"{names[a]} and {names[b]} are swapped", places[order]
    for c, name in enumerate(names):
        for quarter in (1, 2, 3):
            turned = places.copy()
            turned[c] = turned[c] @ se3.exp_rotation([0.0, 0.0, np.pi / 2 * quarter])
            yield f"the picture of {name} is turned by {90 * quarter} degrees", turned


def _size(rig: Rig) -> float:
    """RMS distance, mm, between the cameras."""
    at = np.stack([c.base_from_camera[:3, 3] for c in rig.cameras])
    return float(np.sqrt(((at[:, None] - at[None]) ** 2).sum(-1).mean()))


def open_source(path: Path) -> tuple[Session, CalibrationInput]:
    """Open a session folder, whose rig.toml may lack lenses and poses, or an .mcap file; InputError if it is wrong."""
    rig_toml = path / "rig.toml"
    if not (path.is_dir() and rig_toml.is_file()):
        session, calibrated, rig = open_session(path), True, None
    elif is_calibrated(rig_toml):
        session, calibrated, rig = open_folder(path), True, read_rig(rig_toml)
    else:
        calibrated, rig = False, read_uncalibrated(rig_toml)
        session = open_folder(path, rig)
    nothing = [None] * len(session.rig)
    images, sigma = (nothing, nothing) if rig is None else (rig.sources, rig.lens_sigma)
    title, pictures = session.path.name, partial(pictures_of, session)
    return session, CalibrationInput(title, session.rig, calibrated, images, sigma, pictures)
