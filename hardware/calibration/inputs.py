"""What is wrong with a recording or a board file, told from the pictures: each wrong thing by its name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from estimation.calibration.camera_rig import FEWEST
from estimation.errors import InputError
from hardware.files.session import FrameRef, Session
from perception.boards.board import DICTIONARIES, Board
from perception.boards.collection import BLURRED, CornerTable
from perception.boards.corners import LEAST, CornerFinder
from perception.frames import Image

TRIED = 5  # pictures that other boards are looked for in
MARKER = 0.08  # of the marker's edge, between printed and found: thresholds shrink markers by 4 %
STRANGE = 0.1  # of the pictures, that one unknown marker is seen in


Pictures = Callable[[int], list[Image]]  # some pictures of a camera, by its number


def check_table(table: CornerTable, board: Board, board_file: Path, names: Sequence[str], pictures: Pictures) -> None:
    """InputError that names what is wrong, where the corners found show that something is; names: of the cameras."""
    _check_strangers(table, board, board_file)
    _check_markers(table, board, board_file)
    for c, name in enumerate(names):
        views = int((table.camera == c).sum())
        where = f"camera {name}"
        if views < FEWEST:
            looked = int(table.looked[c])
            few = 0 < looked <= 2 * views
            why = "record more" if few else why_unseen(pictures(c), board)
            raise InputError(
                where, "pictures that show the board", views, f"{FEWEST} or more; it has {looked} pictures: {why}"
            )
        blur = float(np.median(table.blur[table.camera == c]))
        if blur > BLURRED:
            allowed = f"{BLURRED:g} px or less: focus the lens, more light, slower hands"
            raise InputError(where, "blur of the edges", f"{blur:.1f} px", allowed)


def _check_strangers(table: CornerTable, board: Board, board_file: Path) -> None:
    ids, counts = np.unique(table.strangers, return_counts=True)
    often = ids[counts > max(STRANGE * table.looked.sum() / len(table.looked), 3)]
    if len(often):
        got = f"{board.squares[0]} x {board.squares[1]}, markers 0 to {board.markers() - 1}"
        seen = ", ".join(str(i) for i in often[:6])
        raise InputError(board_file, "squares", got, f"those of the board that was held: it has markers {seen} too")


def _check_markers(table: CornerTable, board: Board, board_file: Path) -> None:
    known = table.marker[np.isfinite(table.marker)]
    if len(known) < FEWEST:
        return
    found = float(np.median(known))
    if abs(found / board.marker - 1) > MARKER:
        raise InputError(board_file, "marker", board.marker, f"what the pictures show: about {found:.2f} of a square")


def why_unseen(pictures: list[Image], board: Board) -> str:
    """Why pictures do not show the board, as far as other boards and mirrors tell."""
    if not pictures:
        return "it has no pictures"
    half, shown = len(pictures) // 2, _showing(pictures, board)
    for words, other in _others(board).items():
        if _showing(pictures, other) > max(half, shown):
            return f"they show another board: {words}"
    if _showing([np.ascontiguousarray(p[:, ::-1]) for p in pictures], board) > max(half, shown):
        return "they are mirrored: switch the camera's mirroring off"
    if max(float(picture.std()) for picture in pictures) < 5:
        return "they are of one grey, as behind a cover"
    if shown:
        return "the others do not show it; is it in view, sharp and lit?"
    return "none of them shows a board that is known; is it in view, sharp and lit?"


def _showing(pictures: list[Image], board: Board) -> int:
    """How many pictures show a board."""
    finder = CornerFinder(board)
    return sum(finder(picture).count >= LEAST for picture in pictures)


def pictures_of(session: Session, camera: int) -> list[Image]:
    """A few pictures of a camera, spread over a recording."""
    refs: list[FrameRef] = [ref for refs in session.sets for ref in refs if ref.camera == camera]
    chosen = refs[:: max(len(refs) // TRIED, 1)][:TRIED]
    reader = session.store.open()
    try:
        return [reader.read(ref) for ref in chosen]
    finally:
        reader.close()


def _others(board: Board) -> dict[str, Board]:
    """Boards that are easily taken for this one, by what differs."""
    columns, rows = board.squares
    out = {
        "black and white exchanged (`inverted`)": replace(board, inverted=not board.inverted),
        f"{rows} x {columns} squares": replace(board, squares=(rows, columns)),
        "the other layout (`legacy`)": replace(board, legacy=not board.legacy),
    }
    if board.kind == "charuco":
        size = board.dictionary.split("_")[1]
        for name in DICTIONARIES:
            if name.endswith(f"_{size}") and name != board.dictionary:
                out[f"dictionary {name}"] = replace(board, dictionary=name)
    return out
