"""board.toml: the calibration board as it was printed."""

from __future__ import annotations

from pathlib import Path

from estimation.errors import InputError
from hardware.process import checks
from perception.boards.board import DICTIONARIES, KINDS, Board

USUAL = Board()
KEYS = ("kind", "squares", "square_mm")
MORE = ("marker", "dictionary", "inverted", "legacy")
FEWEST, MOST = 3, 60  # squares along an edge
SIZES = (0.5, 500.0)  # mm, a square: from under a microscope to a wall
MARKERS = (0.3, 0.95)  # of a square: bits large enough to be read, and white around them


def read_board(path: str | Path) -> Board:
    """Read and check a board.toml; InputError names the key that is wrong."""
    path = Path(path)
    table = checks.read_toml(path)
    checks.check_keys(path, "", table, KEYS, MORE)
    kind = checks.text(path, "kind", table["kind"])
    if kind not in KINDS:
        raise InputError(path, "kind", kind, " or ".join(KINDS))
    given = checks.numbers(path, "squares", table["squares"], (2,), "[columns, rows]")
    if (given != given.round()).any() or (given < FEWEST).any() or (given > MOST).any():
        raise InputError(path, "squares", table["squares"], f"[columns, rows], whole, {FEWEST} to {MOST} each")
    square = _within(path, "square_mm", table["square_mm"], *SIZES)
    marker = _within(path, "marker", table.get("marker", USUAL.marker), *MARKERS)
    dictionary = str(table.get("dictionary", USUAL.dictionary)).removeprefix("DICT_")
    if dictionary not in DICTIONARIES:
        raise InputError(path, "dictionary", dictionary, checks.meant(dictionary, DICTIONARIES))
    flags = [_flag(path, key, table.get(key, False)) for key in ("inverted", "legacy")]
    columns, rows = int(given[0]), int(given[1])
    board = Board(kind, (columns, rows), square, marker, dictionary, *flags)
    _check_whole(path, board)
    return board


def write_board(path: Path, board: Board) -> None:
    """Write a board.toml that `read_board` reads back to the same board."""
    lines = [
        f'kind = "{board.kind}"',
        f"squares = {list(board.squares)}",
        f"square_mm = {checks.toml_number(board.square)}",
    ]
    if board.kind == "charuco":
        lines += [f"marker = {checks.toml_number(board.marker)}  # of a square", f'dictionary = "{board.dictionary}"']
        lines += [f"legacy = {str(board.legacy).lower()}"]
    lines.append(f"inverted = {str(board.inverted).lower()}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _check_whole(path: Path, board: Board) -> None:
    holds = int(board.dictionary.split("_")[1])
    if board.markers() > holds:
        raise InputError(path, "dictionary", board.dictionary, f"one with {board.markers()} markers or more")
    if board.kind == "chessboard" and sum(board.squares) % 2 == 0:
        allowed = "an even and an odd number: only then can the board not be taken upside down"
        raise InputError(path, "squares", list(board.squares), allowed)


def _within(path: Path, key: str, value: object, low: float, high: float) -> float:
    number = checks.number(path, key, value)
    if not low <= number <= high:
        raise InputError(path, key, number, f"{low:g} to {high:g}")
    return number


def _flag(path: Path, key: str, value: object) -> bool:
    if not isinstance(value, bool):
        raise InputError(path, key, value, "true or false")
    return value
