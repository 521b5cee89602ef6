"""`stillbed calibrate board` and `cameras`: a board to print at true scale; a rig, a report and a verdict out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimation.calibration.camera_rig import Calibration, calibrate, rebase
from estimation.errors import InputError
from estimation.rig import Rig
from estimation.se3 import Array
from hardware.calibration.corners import collect_corners, coverage_hints
from hardware.calibration.inputs import (
    CalibrationInput,
    camera_shifts,
    check_against,
    check_distance,
    check_table,
    open_source,
)
from hardware.calibration.live import WavingPage, devices_named, watch
from hardware.calibration.report import MAX_PREDICTED_ERROR, CalibrationVerdict, judge_rig, page, rig_json, rig_text
from hardware.cameras.live import LiveCameras
from hardware.files.rig_file import MARKER_SHARE_RANGE, read_board, write_board, write_rig
from hardware.operator.shared_state import WavingStage
from hardware.process.checks import one_of_text
from hardware.process.clock import Clock
from hardware.process.progress import Progress, ProgressReport, check_new
from perception.boards.board import (
    DICTIONARIES,
    Board,
    CornerTable,
    cells_per_square,
    ink_cells,
    thumbnail,
    undistort,
    usable_views,
)

PAGE_SIZES = {"A5": (148, 210), "A4": (210, 297), "A3": (297, 420), "A2": (420, 594), "letter": (215.9, 279.4)}
PAGE_MARGIN = 10.0  # mm that no printer prints on, and of white around the board
PAGE_FOOTER = 16.0  # mm below the board for the ruler and the words
RULER_LENGTH = 100.0  # mm, or half of that on a small page
POINTS_PER_MM = 72 / 25.4  # a PDF's units a mm


@dataclass(frozen=True, slots=True)
class PrintOptions:
    """Options of a printed board."""

    kind: str = "charuco"
    squares: tuple[int, int] | None = None  # columns and rows, or None for as many as fit the page
    square: float = 25.0  # mm
    marker: float = 0.75  # ratio of a marker's edge to a square's
    dictionary: str = "4X4_50"
    inverted: bool = False
    page: str = "A4"


@dataclass(frozen=True, slots=True, eq=False)
class PageDrawing:
    """A page."""

    size: tuple[float, float]  # (W, H) mm
    ink: Array  # (N, 4) black rectangles x y w h, mm from the top left
    words: tuple[tuple[float, float, str], ...]  # x, y mm and text


def write_print(out: Path, options: PrintOptions, force: bool = False) -> str:
    """Write the page, and board.toml beside it; returns a text about it.

    InputError where the options are impossible, or one of the two exists and `force` is not set.
    """
    if out.suffix not in (".svg", ".pdf"):
        raise InputError(out, "--out", out.name, "a file that ends in .svg or .pdf")
    board, size = board_of(options), page_size(options)
    page = drawing(board, size)
    beside = out.with_suffix(".toml")
    for file in (out, beside):
        check_new(file, force)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_bytes(svg(page).encode() if out.suffix == ".svg" else pdf(page))
    write_board(beside, board)
    read_board(beside)  # what was wished is told to be wrong as it would be when read
    return f"{out}: {board}, on {size[0]:g} x {size[1]:g} mm; {beside} describes it. Print at 100 %, measure the ruler."


def page_size(options: PrintOptions) -> tuple[float, float]:
    """(W, H) mm of the page."""
    if options.page in PAGE_SIZES:
        return PAGE_SIZES[options.page]
    allowed = f"{', '.join(PAGE_SIZES)}, or WxH in mm"
    try:
        width, height = (float(word) for word in options.page.lower().split("x"))
    except ValueError:
        raise InputError("--page", "size", options.page, allowed) from None
    if not (width > 0 and height > 0):
        raise InputError("--page", "size", options.page, f"{allowed}, both above 0")
    return width, height


def board_of(options: PrintOptions) -> Board:
    """The board to print; InputError where it does not fit its page."""
    width, height = page_size(options)
    room = np.array([width - 2 * PAGE_MARGIN, height - 2 * PAGE_MARGIN - PAGE_FOOTER])
    if not options.square > 0:
        raise InputError("--square-mm", "square", options.square, "> 0 mm")
    if not MARKER_SHARE_RANGE[0] <= options.marker <= MARKER_SHARE_RANGE[1]:
        raise InputError("--marker", "share", options.marker, f"{MARKER_SHARE_RANGE[0]:g} to {MARKER_SHARE_RANGE[1]:g}")
    if options.dictionary not in DICTIONARIES:
        raise InputError("--dictionary", "name", options.dictionary, one_of_text(options.dictionary, DICTIONARIES))
    fits = np.floor(room / options.square + 1e-9).astype(int)
    if options.squares is None and options.kind == "chessboard" and fits.sum() % 2 == 0:
        fits[1] -= 1
    squares = (int(fits[0]), int(fits[1])) if options.squares is None else options.squares
    board = Board(options.kind, squares, options.square, options.marker, options.dictionary, options.inverted)
    if min(squares) < 3 or (np.array(board.size) > room + 1e-6).any():
        got = f"{squares[0]} x {squares[1]} of {options.square:g} mm"
        raise InputError("--squares", "board", got, f"3 x 3 to {fits[0]} x {fits[1]} squares on {options.page}")
    if not cells_per_square(board):
        allowed = "a share that whole bits of a marker make, as 0.75 or 0.6"
        raise InputError("--marker", "share", options.marker, allowed)
    return board


def drawing(board: Board, size: tuple[float, float]) -> PageDrawing:
    """The page: board, ruler and words."""
    cells, edge = ink_cells(board)
    left, top = (size[0] - board.size[0]) / 2, PAGE_MARGIN
    ink = _rectangles(cells) * edge + [left, top, 0, 0]
    if board.inverted:  # white squares at the rim need ink around them
        rim = 0.2 * board.square
        w, h = board.size
        frame = [[-rim, -rim, w + 2 * rim, rim], [-rim, h, w + 2 * rim, rim], [-rim, 0, rim, h], [w, 0, rim, h]]
        ink = np.vstack([ink, np.array(frame) + [left, top, 0, 0]])
    below = top + board.size[1] + 6
    long = RULER_LENGTH if size[0] >= RULER_LENGTH + 2 * PAGE_MARGIN else RULER_LENGTH / 2
    start = (size[0] - long) / 2
    ticks = [[start + x - 0.15, below, 0.3, 4 if x % 10 == 0 else 2] for x in np.arange(0, long + 1, 5)]
    ink = np.vstack([ink, [[start, below, long, 0.3]], ticks])
    remedy = "If it is not, write the measured square_mm into board.toml. Mount the sheet on glass, flat."
    words = (
        (start + long + 2, below + 3.5, f"{long:g} mm"),
        (PAGE_MARGIN, below + 8.0, f"{board}. Print at 100 %: the ruler must be {long:g} mm long."),
        (PAGE_MARGIN, below + 11.0, remedy),
    )
    return PageDrawing(size, ink, words)


def _rectangles(cells: NDArray[np.bool_]) -> Array:
    """Rectangles (N, 4) x y w h, in cells, that cover the True ones of (H, W): runs along x, joined down y."""
    open_runs: dict[tuple[int, int], list[float]] = {}
    out: list[list[float]] = []
    for y, row in enumerate(np.vstack([cells, np.zeros_like(cells[:1])])):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], row.astype(int), [0]])))
        runs = {(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)}
        for run in [r for r in open_runs if r not in runs]:
            out.append(open_runs.pop(run))
        for a, b in sorted(runs):
            page = open_runs.setdefault((a, b), [a, y, b - a, 0])
            page[3] += 1
    return np.array(out, float).reshape(-1, 4)


def svg(page: PageDrawing) -> str:
    """The page as SVG in mm."""
    w, h = page.size
    path = "".join(f"M{x:.4f} {y:.4f}h{a:.4f}v{b:.4f}h{-a:.4f}z" for x, y, a, b in page.ink)
    words = "".join(f'<text x="{x:.2f}" y="{y:.2f}">{escape(text)}</text>' for x, y, text in page.words)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{w:g}mm" height="{h:g}mm" viewBox="0 0 {w:g} {h:g}">'
        f'<rect width="{w:g}" height="{h:g}" fill="#fff"/><path fill="#000" shape-rendering="crispEdges" d="{path}"/>'
        f'<g font-family="sans-serif" font-size="2.6">{words}</g></svg>\n'
    )


def pdf(page: PageDrawing) -> bytes:
    """The page as PDF 1.4: one content stream of rectangles filled as one, and text in Helvetica."""
    k = POINTS_PER_MM
    w, h = (side * k for side in page.size)
    boxes = "\n".join(f"{x * k:.4f} {h - (y + b) * k:.4f} {a * k:.4f} {b * k:.4f} re" for x, y, a, b in page.ink)
    text = "\n".join(f"BT /F1 7.4 Tf {x * k:.3f} {h - y * k:.3f} Td ({_plain(t)}) Tj ET" for x, y, t in page.words)
    stream = f"0 g\n{boxes}\nf\n{text}\n".encode("latin-1")
    parts = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {w:.4f} {h:.4f}] /Contents 4 0 R "
        "/Resources << /Font << /F1 5 0 R >> >> >>".encode(),
        b"<< /Length %d >>\nstream\n%s\nendstream" % (len(stream), stream),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]
    out, places = b"%PDF-1.4\n", []
    for number, part in enumerate(parts, 1):
        places.append(len(out))
        out += b"%d 0 obj\n%s\nendobj\n" % (number, part)
    table = b"".join(b"%010d 00000 n \n" % place for place in places)
    count = len(parts) + 1
    tail = b"trailer << /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (count, len(out))
    return out + b"xref\n0 %d\n0000000000 65535 f \n%s" % (count, table) + tail


def _plain(text: str) -> str:
    return text.replace("\\", "\\\\").replace("(", "\\(").replace(")", "\\)")


SURFACE_SPEED = 20.0  # mm/s, for the effect of clock errors: the peak of a deep breath
PICTURE_WIDTH = 640  # px, of a picture in the report


@dataclass(frozen=True, slots=True)
class CalibrationOptions:
    """Options of a rig's calibration."""

    limit: float = MAX_PREDICTED_ERROR  # mm, of the predicted error
    distance: tuple[str, str, float] | None = None  # two cameras and the measured distance of their lenses, mm
    keep_lenses: bool = False  # whether the given lenses are used, within their sigma
    new_rig: bool = False  # whether the session's rig is ignored


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationResult:
    """A calibration and its verdict."""

    calibration: Calibration
    verdict: CalibrationVerdict
    text: str  # for the terminal
    damage: str = ""  # what was lost of the recording's file, "" if nothing


def run_calibration(
    session: Path, board_file: Path, out: Path, options: CalibrationOptions, report: ProgressReport
) -> CalibrationResult:
    """Calibrate the cameras of a session; writes `out` and beside it .report.html, .json and .corners.npz.

    InputError, Undetermined and Implausible say what is wrong; then only the corners are written.
    """
    board = _check_paths(board_file, out)
    recording, material = open_source(session)
    _check_options(material.names, material.calibrated, recording.path, options)
    table = collect_corners(recording, board, corners_of(out), report)
    return replace(finish(material, table, board, board_file, out, options), damage=recording.damage)


def run_live(
    which: Sequence[str],
    board_file: Path,
    out: Path,
    options: CalibrationOptions,
    seconds: float | None,
    clock: Clock,
    progress: Progress,
    open_page: Callable[[], AbstractContextManager[WavingPage | None]] = nullcontext,
) -> CalibrationResult:
    """Calibrate live cameras, named as for `stillbed cameras`, while a board is waved; writes the same files.

    seconds: at most, None until the coverage suffices. open_page: opens the page that shows where to hold the board,
    and the result. An interrupted run leaves its corners, and the next one goes on.
    """
    board = _check_paths(board_file, out)
    devices = devices_named(which)
    _check_options(devices.names, devices.rig is not None, "command line", options)
    with open_page() as shown:
        with LiveCameras(devices.places, devices.sources, clock) as live:
            material, table = watch(live, devices, board, corners_of(out), seconds, clock, progress, shown)
        if shown is not None:
            shown.enter(WavingStage.SOLVE)
        outcome = finish(material, table, board, board_file, out, options)
        if shown is not None:
            shown.enter(WavingStage.PASSED if outcome.verdict.passed else WavingStage.FAILED, *outcome.text.split("\n"))
    return outcome


def corners_of(out: Path) -> Path:
    """The file of the corners from which a rig.toml is calibrated."""
    return out.with_suffix(".corners.npz")


def _check_paths(board_file: Path, out: Path) -> Board:
    board = read_board(board_file)
    if out.suffix != ".toml":
        raise InputError(out, "--out", out.name, "a file that ends in .toml")
    out.parent.mkdir(parents=True, exist_ok=True)
    return board


def finish(
    material: CalibrationInput, table: CornerTable, board: Board, board_file: Path, out: Path,
    options: CalibrationOptions,
) -> CalibrationResult:  # fmt: skip
    """Calibrate from the corners, and write all files."""
    check_table(table, board, board_file, material.names, material.pictures)
    views, dropped = usable_views(table, board, material.names, tuple(c.size for c in material.rig.cameras))
    result = calibrate(views, known=material.lenses if options.keep_lenses else None)
    if options.distance is not None:
        check_distance(result.rig, *options.distance, board_file, board.square)
    if material.calibrated and not options.new_rig:
        check_against(result.rig, material.rig, board_file, board.square)
    error = result.predicted_error(result.working_volume(), SURFACE_SPEED)
    verdict = judge_rig(result, error, options.limit, coverage_hints(result))
    placed = rebase(result.rig, material.rig.cameras[0].base_from_camera if material.calibrated else np.eye(4))
    sigmas = [np.sqrt(np.diag(result.covariance_of(c))[:9]) for c in range(len(placed))]
    write_rig(out, placed, material.images, sigmas)
    out.with_suffix(".json").write_text(rig_json(result, error, verdict), encoding="utf-8")
    text = page(material.title, result, error, verdict, dropped, _pictures(material, result))
    out.with_suffix(".report.html").write_text(text, encoding="utf-8")
    lines = _shift_lines(placed, material.rig) if material.calibrated else []
    return CalibrationResult(replace(result, rig=placed), verdict, rig_text(result, verdict, dropped, out, lines))


def _shift_lines(rig: Rig, before: Rig) -> list[str]:
    apart = zip(rig.cameras[1:], camera_shifts(rig, before)[1:], strict=True)
    texts = [f"{camera.name} {millimetres:.1f} mm, {degrees:.2f} degrees" for camera, (millimetres, degrees) in apart]
    return [f"away from where the rig.toml had it: {'; '.join(texts)}"] if texts else []


def _check_options(names: Sequence[str], calibrated: bool, where: object, options: CalibrationOptions) -> None:
    if options.keep_lenses and not calibrated:
        raise InputError(where, "--keep-lenses", "a rig.toml without lenses", "one that has them")
    for name in options.distance[:2] if options.distance else ():
        if name not in names:
            raise InputError("--distance-mm", "camera", name, ", ".join(names))


def _pictures(material: CalibrationInput, result: Calibration) -> dict[str, bytes]:
    cameras = enumerate(result.rig.cameras)
    return {camera.name: thumbnail(undistort(camera, material.pictures(c)[-1]), PICTURE_WIDTH) for c, camera in cameras}
