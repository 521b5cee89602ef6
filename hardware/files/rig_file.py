"""rig.toml: the calibrated cameras of a session and where each one's images are. board.toml: the printed board."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.rig import Camera, Rig
from estimation.se3 import Array
from hardware.files.mesh_file import read_mesh
from hardware.files.session import SURFACE_SUFFIXES
from hardware.process import checks
from hardware.process.checks import Table

if TYPE_CHECKING:
    from perception.boards.board import Board

RIG_FILE = "rig.toml"
CAMERA_KEYS = ("name", "size", "matrix", "distortion", "base_from_camera")
SIGMA_KEY = "lens_sigma"  # standard deviations of fx fy cx cy k1 k2 p1 p2 k3, where a calibration gave them
RECORDED_KEYS = ("video", "images")  # where a recorded session's images are
# of live cameras, read by hardware/cameras
LIVE_KEYS = ("source", "exposure_s", "gain", "focus_abs", "white_balance_k", "fps", "format", "trigger", "ptp")
PINHOLE = "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in px"
ROTATION_TOLERANCE = 1e-3  # four digits written by hand pass (and are made orthonormal); a wrong matrix does not
EXACT_ROTATION = 1e-12  # below, the matrix is kept bit by bit, so that a rig written by us comes back the same
MIN_RIG_SPAN = 10.0  # mm: two lenses cannot stand closer, but a rig of up to 10 m given in metres does
MAX_RIG_SPAN = 1e5  # mm: 100 m
MIN_FOCAL_SHARE = 0.1  # of the image's longer side: 157 degrees; a focal length in mm instead of px is far below


@dataclass(frozen=True, slots=True)
class ImageSource:
    """Where one camera's images are."""

    kind: str  # "video" (a file), "images" (a glob) or "source" (live)
    pattern: str  # relative to the folder; a live source as its key has it


@dataclass(frozen=True, slots=True)
class RigFile:
    """The contents of a rig.toml."""

    rig: Rig
    sources: tuple[ImageSource | None, ...]  # of each camera
    surface: str | None  # the scan's file
    lens_sigma: tuple[Array | None, ...]  # (9,) of each camera, standard deviations of fx fy cx cy k1 k2 p1 p2 k3


def read_rig(path: str | Path) -> RigFile:
    """Read and check a rig.toml; InputError names the key that is wrong."""
    path = Path(path)
    table = checks.read_toml(path)
    checks.check_keys(path, "", table, ["camera"], ["surface"])
    surface = table.get("surface")
    rig = rig_from_table(path, table, (*RECORDED_KEYS, *LIVE_KEYS))
    sources = tuple(_source(path, camera) for camera in table["camera"])
    sigmas = tuple(_lens_sigma(path, camera) for camera in table["camera"])
    return RigFile(rig, sources, None if surface is None else checks.text(path, "surface", surface), sigmas)


def read_uncalibrated(path: Path) -> RigFile:
    """A rig.toml with only `name`, `size` and images of each camera; lens and place are placeholders."""
    table = checks.read_toml(path)
    checks.check_keys(path, "", table, ["camera"], ["surface"])
    entries = checks.tables(path, "camera", table.get("camera"))
    for number, entry in enumerate(entries):
        checks.check_keys(path, f"camera[{number}].", entry, ("name", "size"), RECORDED_KEYS)
        size = checks.numbers(path, f"camera[{number}].size", entry["size"], (2,), "[width, height] in px")
        f, middle = float(size.max()), (size - 1) / 2
        entry["matrix"] = [[f, 0.0, float(middle[0])], [0.0, f, float(middle[1])], [0.0, 0.0, 1.0]]
        entry["distortion"] = [0.0] * 5
        entry["base_from_camera"] = se3.make(np.eye(3), [MIN_RIG_SPAN * number, 0.0, 0.0]).tolist()
    rig = rig_from_table(path, table, RECORDED_KEYS)
    return RigFile(rig, tuple(_source(path, entry) for entry in entries), None, (None,) * len(rig))


def is_calibrated(path: Path) -> bool:
    """Whether a camera of a rig.toml has a lens or a place."""
    table = checks.read_toml(path)
    entries = checks.tables(path, "camera", table.get("camera"))
    return any("matrix" in entry or "base_from_camera" in entry for entry in entries)


def rig_from_table(where: object, table: Table, also: Sequence[str] = ()) -> Rig:
    """The rig in a table with a `camera` list (rig.toml's or a recording's); `also`: further keys a camera may have."""
    cameras: list[Camera] = []
    for number, entry in enumerate(checks.tables(where, "camera", table.get("camera"))):
        cameras.append(_camera(where, f"camera[{number}]", entry, also))
        if cameras[-1].name in [c.name for c in cameras[:-1]]:
            raise InputError(where, f"camera[{number}].name", cameras[-1].name, "a name that no other camera has")
    _check_scale(where, cameras)
    return Rig(tuple(cameras))


def table_from_rig(rig: Rig) -> Table:
    """The rig as plain lists and numbers, keys as in rig.toml; `rig_from_table` reads the same rig back, bit by bit."""
    entries: list[Table] = []
    for c in rig.cameras:
        arrays = {key: getattr(c, key).tolist() for key in ("matrix", "distortion", "base_from_camera")}
        entries.append({"name": c.name, "size": list(c.size), **arrays, "clock_offset_s": c.clock_offset})
    return {"camera": entries}


def write_rig(
    path: str | Path, rig: Rig, sources: Sequence[ImageSource | None], lens_sigma: Sequence[Array | None] | None = None
) -> None:
    """Write a rig.toml that `read_rig` reads back to the same rig, bit by bit. lens_sigma: (9,) per camera, or None."""
    sigmas = [None] * len(rig) if lens_sigma is None else lens_sigma
    blocks = ["# mm, px; base_from_camera carries camera coordinates (x right, y down, z into the scene) to the base\n"]
    for camera, source, sigma in zip(rig.cameras, sources, sigmas, strict=True):
        values = {
            "name": camera.name,
            **({} if source is None else {source.kind: source.pattern}),
            "size": camera.size,
            **{key: getattr(camera, key) for key in ("matrix", "distortion", "base_from_camera")},
            "clock_offset_s": camera.clock_offset or None,
            SIGMA_KEY: sigma,
        }
        blocks.append("\n".join(["[[camera]]", *checks.toml_lines(values)]) + "\n")
    Path(path).write_text("\n".join(blocks), encoding="utf-8")


def _source(path: Path, camera: Table) -> ImageSource | None:
    name = camera["name"]
    keys = [key for key in RECORDED_KEYS if key in camera]
    if len(keys) > 1:
        raise InputError(path, f"camera {name!r}", "video and images", "one of the two")
    return ImageSource(keys[0], checks.text(path, f"camera {name!r}: {keys[0]}", camera[keys[0]])) if keys else None


def _lens_sigma(path: Path, camera: Table) -> Array | None:
    if SIGMA_KEY not in camera:
        return None
    key = f"camera {camera['name']!r}: {SIGMA_KEY}"
    allowed = "nine numbers of 0 or more, for fx fy cx cy k1 k2 p1 p2 k3"
    sigma = checks.numbers(path, key, camera[SIGMA_KEY], (9,), allowed)
    if (sigma < 0).any():
        raise InputError(path, key, camera[SIGMA_KEY], allowed)
    return sigma


def _camera(where: object, key: str, entry: Table, also: Sequence[str]) -> Camera:
    checks.check_keys(where, f"{key}.", entry, CAMERA_KEYS, [*also, "clock_offset_s", SIGMA_KEY])
    name = _name(where, f"{key}.name", entry["name"])
    key = f"camera {name!r}: "
    size = checks.whole_pair(1, np.inf, "[width, height], whole px >= 1")(where, key + "size", entry["size"])
    matrix = checks.numbers(where, key + "matrix", entry["matrix"], (3, 3), PINHOLE)
    _check_matrix(where, key + "matrix", matrix, float(max(size)))
    distortion = checks.numbers(where, key + "distortion", entry["distortion"], (5,), "k1 k2 p1 p2 k3")
    base_from_camera = checks.numbers(where, key + "base_from_camera", entry["base_from_camera"], (4, 4), "mm")
    offset = checks.number(where, key + "clock_offset_s", entry.get("clock_offset_s", 0.0))
    extrinsics = _rigid(where, key + "base_from_camera", base_from_camera)
    return Camera(name, size, matrix, distortion, extrinsics, offset)


def _name(where: object, key: str, value: object) -> str:
    name = checks.text(where, key, value)
    if name.startswith(".") or len(name) > 64 or any(c in '/\\,"' or not c.isprintable() for c in name):
        raise InputError(where, key, name, 'up to 64 printable characters without / \\ , " and no dot in front')
    return name


def _check_matrix(where: object, key: str, matrix: Array, longer_side: float) -> None:
    for name, focal in (("fx", matrix[0, 0]), ("fy", matrix[1, 1])):
        if focal <= 0:
            raise InputError(where, f"{key} {name}", focal, "a focal length > 0 px")
        if focal < MIN_FOCAL_SHARE * longer_side:
            minimum = MIN_FOCAL_SHARE * longer_side
            allowed = f">= {minimum:g} px, {MIN_FOCAL_SHARE} of the image's longer side (px, not mm)"
            raise InputError(where, f"{key} {name}", focal, allowed)
    if matrix[0, 1] or matrix[1, 0] or (matrix[2] != [0, 0, 1]).any():
        raise InputError(where, key, matrix.tolist(), PINHOLE)


def _rigid(where: object, key: str, matrix: Array) -> Array:
    if not se3.is_transform(matrix, ROTATION_TOLERANCE):
        rotation = matrix[:3, :3]
        with np.errstate(over="ignore", invalid="ignore"):
            error = np.abs(rotation @ rotation.T - np.eye(3)).max()
            got = f"R R^T off by {error:.3g}, det {np.linalg.det(rotation):.3g}, last row {matrix[3].tolist()}"
        raise InputError(where, key, got, "a rotation (orthonormal, right-handed) and a shift in mm, last row 0 0 0 1")
    return matrix if se3.is_transform(matrix, EXACT_ROTATION) else se3.orthonormalise(matrix)


def _check_scale(where: object, cameras: Sequence[Camera]) -> None:
    """Refuse a rig in metres, in which all lenses seem to stand within 10 mm of each other; no two can.

    One camera alone has no baseline, so its unit cannot be told. One near pair among others is not refused.
    """
    centres = np.stack([c.base_from_camera[:3, 3] for c in cameras])
    if (farthest := float(np.abs(centres).max())) > MAX_RIG_SPAN:  # its square may overflow
        allowed = f"at most {MAX_RIG_SPAN:g} mm along each axis (lengths are in mm)"
        raise InputError(where, "base_from_camera of all cameras", f"up to {farthest:.4g} mm from the base", allowed)
    spread = float(np.linalg.norm(centres[:, None] - centres[None], axis=-1).max())
    if len(cameras) > 1 and spread < MIN_RIG_SPAN:
        allowed = f"{MIN_RIG_SPAN:g} mm or more between the outermost cameras (lengths are in mm, not m)"
        raise InputError(where, "base_from_camera of all cameras", f"at most {spread:.4g} mm apart", allowed)
    if max(spread, float(np.linalg.norm(centres, axis=1).max())) > MAX_RIG_SPAN:
        allowed = f"at most {MAX_RIG_SPAN:g} mm from the base and from each other (lengths are in mm)"
        raise InputError(where, "base_from_camera of all cameras", f"{spread:.4g} mm apart", allowed)


MIN_SQUARES, MAX_SQUARES = 3, 60  # squares along an edge
SQUARE_SIZE_RANGE = (0.5, 500.0)  # mm, a square: from under a microscope to a wall
MARKER_SHARE_RANGE = (0.3, 0.95)  # of a square: bits large enough to be read, and white around them


def read_board(path: str | Path) -> Board:
    """Read and check a board.toml; InputError names the key that is wrong."""
    from perception.boards.board import BOARD_KINDS, DICTIONARIES, Board  # loads cv2, which rigs alone do not need

    path = Path(path)

    def dictionary(where: object, key: str, value: object) -> object:
        return checks.word(DICTIONARIES)(where, key, str(value).removeprefix("DICT_"))

    counts = f"[columns, rows], whole, {MIN_SQUARES} to {MAX_SQUARES} each"
    keys: checks.Keys = {
        "kind": ("kind", checks.word(BOARD_KINDS)),
        "squares": ("squares", checks.whole_pair(MIN_SQUARES, MAX_SQUARES, counts)),
        "square_mm": ("square", checks.within(*SQUARE_SIZE_RANGE, "mm")),
        "marker": ("marker", checks.within(*MARKER_SHARE_RANGE, "of a square")),
        "dictionary": ("dictionary", dictionary),
        "inverted": ("inverted", checks.flag),
        "legacy": ("legacy", checks.flag),
    }
    board = checks.record_from_table(path, "", checks.read_toml(path), Board, keys, ("kind", "squares", "square_mm"))
    _check_whole(path, board)
    return board


def write_board(path: Path, board: Board) -> None:
    """Write a board.toml that `read_board` reads back to the same board."""
    values = {"kind": board.kind, "squares": board.squares, "square_mm": float(board.square)}
    if board.kind == "charuco":
        values |= {"marker": float(board.marker), "dictionary": board.dictionary, "legacy": board.legacy}
    lines = checks.toml_lines({**values, "inverted": board.inverted})
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _check_whole(path: Path, board: Board) -> None:
    available = int(board.dictionary.split("_")[1])
    if board.markers() > available:
        raise InputError(path, "dictionary", board.dictionary, f"one with {board.markers()} markers or more")
    if board.kind == "chessboard" and sum(board.squares) % 2 == 0:
        allowed = "an even and an odd number: only then can the board not be taken upside down"
        raise InputError(path, "squares", list(board.squares), allowed)


def surface_of_rig(file: Path, surface: str | None) -> Path | None:
    """The scan that a rig.toml names by `surface`; InputError where it is none."""
    if surface is None:
        return None
    path = file.parent / surface
    if path.suffix.lower() not in SURFACE_SUFFIXES:
        raise InputError(file, "surface", surface, f"a file {', '.join(SURFACE_SUFFIXES)}")
    if not path.is_file():
        raise InputError(file, "surface", surface, "a file that is there")
    return path


def surface_of_folder(folder: Path, rig_file: RigFile) -> Path | None:
    """The scan in a session folder, as its rig.toml names it or by its own name; InputError where it is none."""
    named = surface_of_rig(folder / "rig.toml", rig_file.surface)
    files = [p for s in SURFACE_SUFFIXES if (p := folder / f"surface{s}").exists()] if named is None else [named]
    if len(files) > 1:
        names = ", ".join(p.name for p in files)
        raise InputError(folder, "surface", names, "one of them (or `surface = ` in rig.toml)")
    if files and not files[0].stat().st_size:
        raise InputError(files[0], "file", "empty", "a scan of the surface, mm")
    return files[0] if files else None


def scan_of(given: Path | None, session: Path) -> Path | None:
    """The scan that is given, or that the rig file or session folder names; InputError where it cannot be read."""
    session_scan: Path | None = None
    if session.is_dir():
        session_scan = surface_of_folder(session, read_rig(session / RIG_FILE))
    elif session.suffix == ".toml":
        session_scan = surface_of_rig(session, read_rig(session).surface)
    scan = agreed_scan(given, session_scan, session)
    if scan is not None:
        read_mesh(scan)
    return scan


def agreed_scan(given: Path | None, own: Path | None, where: Path) -> Path | None:
    """The scan that is given or that the cameras' files (where) hold; InputError where these are two different ones."""
    if given is None or own is None:
        return given or own
    if given.read_bytes() != own.read_bytes():
        raise InputError(given, "scan", f"other than {own.name} of {where.name}", "one scan: leave out one of the two")
    return given
