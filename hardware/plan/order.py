"""The plan that the command line asks for, read and checked: settings, tissues, pattern, and the wound of a scan."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np
from numpy.typing import NDArray

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.files.arm_file import read_arm, tool_body_of
from hardware.files.mesh_file import read_raw_mesh
from hardware.files.path_file import read_contour
from hardware.plan.question import parse_clicks, scan_colour, write_question
from hardware.process.progress import ProgressReport, check_apart, check_new, no_progress
from planning.clearance import BASE_MARGIN, ToolBody
from planning.fill import PatternKind
from planning.fill.bead import Pattern
from planning.layers.checkpoints import CheckpointSettings, ToolLimits
from planning.layers.outline import WoundQuestionError
from planning.layers.plan import PlanOrder, flat_wound
from planning.layers.repair import Repairs, repair_mesh
from planning.layers.slicing import BumpPassing, LayerMode, Tissue
from planning.layers.wound import WoundVolume, find_wound
from planning.path import MAX_SPEED, MAX_TEMPERATURE, MIN_TEMPERATURE

Index = NDArray[np.int64]
AngleChoice = Literal["shorter", "fastest"]
COMMAND_LINE = "command line"
# mm, bottom up; the epidermis, in truth 0.1 mm, is one layer of the default bead
DEFAULT_TISSUES = (("hypodermis", None), ("dermis", 1.6), ("epidermis", 0.4))
TISSUE_SYNTAX = "NAME=THICKNESS:MATERIAL[:TEMPERATURE[:SPEED[:LAYER_HEIGHT]]], mm (or rest), degrees C, mm/s, mm"
GRID_PER_BEAD = 0.6  # of a bead between nodes of the wound's grid: finer changes no layer's area by a thousandth
MIN_GRID_STEP, MAX_GRID_STEP = 0.1, 0.5  # mm
EXAMPLE_STEP = 0.75  # mm between the vertices of an example scan, as of a handheld scanner
EXAMPLE_SIZE, EXAMPLE_DEPTH, EXAMPLE_SEED = (42.0, 31.0), 3.5, 1  # mm


@dataclass(frozen=True, slots=True)
class SettingInfo:
    """The metadata of one setting, under "setting"."""

    label: str  # on the page
    unit: str = ""
    limits: tuple[float, float] | None = None  # lowest and highest value; None: checked elsewhere
    default: str = ""  # text of the value None or ()


def _setting(default: Any, label: str, unit: str = "", low: float = math.nan, high: float = 0, text: str = "") -> Any:
    limits = None if math.isnan(low) else (low, high)
    return field(default=default, metadata={"setting": SettingInfo(label, unit, limits, text)})


@dataclass(frozen=True, slots=True)
class PlanSettings:
    """The options of the command line: lengths mm, speeds mm/s, angles degrees. angle: degrees, shorter or fastest."""

    material: str = _setting("1,2,3", "material")
    tissues: tuple[str, ...] = _setting((), "tissues", text="hypodermis=rest, dermis=1.6, epidermis=0.4")
    layers: str = _setting("skin", "shape of the layers")
    layer_height: float | None = _setting(None, "layer height", "mm", 0.02, 20, "as wide as a bead")
    pattern: str = _setting("contour", "pattern")
    angle: str = _setting("fastest", "angle of the lines", "°")
    parallel: bool = _setting(False, "same direction in all layers")
    bead: float = _setting(0.4, "bead width", "mm", 0.01, 20)
    overlap_percent: float = _setting(0.0, "overlap of beads", "%", 0, 90)
    inset: float = _setting(0.0, "margin along the rim", "mm", 0, 100)
    rims: int = _setting(1, "closed lines of the hybrid pattern", "", 0, 100)
    speed: float = _setting(20.0, "printing speed", "mm/s", 0.1, MAX_SPEED)
    travel: float = _setting(60.0, "speed between beads", "mm/s", 0.1, MAX_SPEED)
    temperature: float = _setting(20.0, "temperature", "°C", MIN_TEMPERATURE, MAX_TEMPERATURE)
    spacing: float = _setting(1.0, "distance of checkpoints", "mm", 0.05, 50)
    chord: float = _setting(0.02, "maximum deviation from curves", "mm", 0.001, 1)
    lift: float = _setting(2.0, "lift between beads", "mm", 0, 50)
    wait: float = _setting(0.0, "pause before a layer", "s", 0, 3600)
    sideways: float = _setting(200.0, "maximum lateral acceleration", "mm/s²", 1, 100_000)
    tilt_deg: float = _setting(30.0, "maximum tilt of the tool", "°", 0, 60)
    turning_deg_mm: float = _setting(5.0, "maximum rotation of the tool", "°/mm", 0.01, 90)
    spin_deg: float = _setting(0.0, "spin of the tool", "°", -360, 360)
    bump: float | None = _setting(None, "height of bumps to print over", "mm", 0, 20, "half a layer")
    bump_clearance: float | None = _setting(None, "distance from other bumps", "mm", 0, 20, "half a bead")
    amplitude_mm: float = _setting(0.0, "amplitude of the tissue", "mm", 0, 100)

    def rows(self) -> list[tuple[str, str]]:
        """Each setting with its option, and its value with unit, as texts."""
        return [(f"{info.label}, {option_of(name)}", self._text(name)) for name, info in SETTINGS.items()]

    def _text(self, name: str) -> str:
        value, info = getattr(self, name), SETTINGS[name]
        if value is None or value == ():
            return info.default
        if isinstance(value, bool):
            return "yes" if value else "no"
        if isinstance(value, tuple):
            return "; ".join(value)
        number = f"{value:g}" if isinstance(value, float) else str(value)
        return number if number in get_args(AngleChoice) else f"{number} {info.unit}".rstrip()


SETTINGS: dict[str, SettingInfo] = {each.name: each.metadata["setting"] for each in fields(PlanSettings)}


def option_of(name: str) -> str:
    """The option of the command line for a setting."""
    return "--tissue" if name == "tissues" else "--" + name.replace("_", "-")


@dataclass(frozen=True, slots=True)
class PlanRequest:
    """What is to be planned and written."""

    out: Path
    scan: Path | None = None  # mesh or contour
    example: str | None = None  # a built-in body instead of a scan
    outline: Path | None = None  # of the wound on the scan
    unit: str = "mm"  # of the scan's numbers
    flip: bool = False  # the scan is inside out
    gcode: Path | None = None
    session: Path | None = None  # in whose pictures the scan is to be registered
    pictures: bool = True
    force: bool = False
    arm: Path | None = None  # whose reach of each checkpoint is written
    clicks: str | None = None  # places on the wound's rim, mm, as the command line has them
    wound: int | None = None  # of the places that a question has shown, from 1
    motion: str | None = None  # recording or trajectory by which the tissue's amplitude is measured
    settings: PlanSettings = field(default_factory=PlanSettings)


@dataclass(frozen=True, slots=True, eq=False)
class PlanSubject:
    """The wound to be planned."""

    name: str
    wound: WoundVolume
    repairs: Repairs | None  # of its scan; None for a contour
    example: tuple[Array, Index] | None = None  # vertices and triangles of a built-in scan, written beside the path


def plan_order(settings: PlanSettings, flat: bool) -> PlanOrder:
    """What is to be planned. flat: one layer of one tissue."""
    s = settings
    for name, info in SETTINGS.items():
        value = getattr(s, name)
        if value is not None and info.limits is not None and not info.limits[0] <= value <= info.limits[1]:
            raise InputError(COMMAND_LINE, option_of(name), value, "{:g} to {:g}".format(*info.limits))
    pattern = Pattern(
        kind=cast(PatternKind, s.pattern), width=s.bead, overlap=s.overlap_percent / 100, inset=s.inset,
        angle=_angle(s.angle), rims=s.rims,
    )  # fmt: skip
    tool = ToolLimits(*(math.radians(v) for v in (s.tilt_deg, s.turning_deg_mm, s.spin_deg)))
    checkpoints = CheckpointSettings(
        s.spacing, s.chord, s.sideways, travel=s.travel, lift=s.lift, wait=s.wait, tool=tool
    )
    mode: LayerMode = "skin" if flat else cast(LayerMode, s.layers)
    return PlanOrder(
        _tissues(s, flat), pattern, mode, checkpoints, not s.parallel, BumpPassing(s.bump, s.bump_clearance)
    )


def _angle(text: str) -> float | AngleChoice:
    if text in get_args(AngleChoice):
        return cast(AngleChoice, text)
    try:
        return float(np.deg2rad(float(text)))
    except ValueError:
        raise InputError(COMMAND_LINE, "--angle", text, "degrees, shorter or fastest") from None


def _tissues(settings: PlanSettings, flat: bool) -> tuple[Tissue, ...]:
    height = settings.layer_height if settings.layer_height is not None else settings.bead
    if settings.tissues:
        result = tuple(_tissue(text, settings, height) for text in settings.tissues)
    else:
        names = _materials(settings.material)
        result = tuple(
            Tissue(name, thickness, names[min(i, len(names) - 1)], settings.temperature, settings.speed, height)
            for i, (name, thickness) in enumerate(DEFAULT_TISSUES)
        )
    if len({t.name for t in result}) < len(result):
        raise InputError(COMMAND_LINE, "--tissue", ", ".join(t.name for t in result), "each name once")
    if sum(t.thickness is None for t in result) > 1:
        raise InputError(COMMAND_LINE, "--tissue", ", ".join(settings.tissues), "at most one that takes the rest")
    if flat and len(settings.tissues) > 1:
        raise InputError(COMMAND_LINE, "--tissue", ", ".join(settings.tissues), "one: a contour is one layer")
    if flat:
        return (replace(result[0], name=result[0].name if settings.tissues else "layer", thickness=None),)
    return result


def _materials(text: str) -> Sequence[str]:
    names = [name.strip() for name in text.split(",")]
    if not all(_is_material_name(name) for name in names) or len(names) not in (1, len(DEFAULT_TISSUES)):
        allowed = "one name, or three with commas between: hypodermis, dermis, epidermis"
        raise InputError(COMMAND_LINE, "--material", text, allowed)
    return names


def _is_material_name(name: str) -> bool:
    return bool(name) and name.isprintable() and not any(c in name for c in ',"\n')


def _tissue(text: str, settings: PlanSettings, height: float) -> Tissue:
    name, _, field_text = text.partition("=")
    fields = [word.strip() for word in field_text.split(":")]
    if not _is_material_name(name.strip()) or not 2 <= len(fields) <= 5 or not _is_material_name(fields[1]):
        raise InputError(COMMAND_LINE, "--tissue", text, TISSUE_SYNTAX)
    thickness = None if fields[0] == "rest" else _number(text, fields[0], 0.02, 100)
    limits = ((MIN_TEMPERATURE, MAX_TEMPERATURE), (0.1, MAX_SPEED), (0.02, 20.0))
    numbers = [_number(text, word, *limit) for word, limit in zip(fields[2:], limits, strict=False)]
    values = numbers + [settings.temperature, settings.speed, height][len(numbers) :]
    return Tissue(name.strip(), thickness, fields[1], *values)


def _number(text: str, word: str, low: float, high: float) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        raise InputError(COMMAND_LINE, f"--tissue {text}: {word}", word, f"{low:g} to {high:g}; {TISSUE_SYNTAX}")
    return value


SCAN_UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4}  # mm of each
MAX_COORDINATE = 1e6  # mm: a kilometre; beyond it a scan has lost the hundredth of a millimetre, and sums overflow
MIN_SCAN_WITH_SKIN, MAX_SCAN_WITH_SKIN = 20.0, 1000.0  # mm, longest side: from a finger to a leg


def in_mm(vertices: Array, triangles: Index, unit: str, where: object) -> Array:
    """Vertices (V, 3) in mm; InputError where the scan is too small or too large, with the units that would fit."""
    used = vertices[np.unique(np.clip(triangles, 0, len(vertices) - 1))]
    used = used[np.isfinite(used).all(axis=1)]
    if not len(used):
        raise InputError(where, "vertices", "none that is finite", "a scan with finite coordinates")
    outside = (np.abs(vertices) > MAX_COORDINATE / SCAN_UNITS[unit]).any(axis=1) & np.isfinite(vertices).all(axis=1)
    outliers = np.flatnonzero(outside)
    if len(outliers):
        allowed = f"coordinates within {MAX_COORDINATE:g} mm, or not finite ones, which are left out"
        raise InputError(where, f"vertex {outliers[0]}", vertices[outliers[0]].tolist(), allowed)
    low, high = np.percentile(used, [1, 99], axis=0)  # without stray vertices
    longest = float((high - low).max())
    size = longest * SCAN_UNITS[unit]
    if MIN_SCAN_WITH_SKIN <= size <= MAX_SCAN_WITH_SKIN:
        return np.asarray(vertices * SCAN_UNITS[unit])
    fitting_units = [
        name for name, mm in SCAN_UNITS.items() if MIN_SCAN_WITH_SKIN <= longest * mm <= MAX_SCAN_WITH_SKIN
    ]
    units = " or ".join(f"--unit {name} ({longest * SCAN_UNITS[name]:.0f} mm)" for name in fitting_units)
    hint = f"; its numbers look like another unit: say {units}" if units else ""
    allowed = f"{MIN_SCAN_WITH_SKIN:g} to {MAX_SCAN_WITH_SKIN:g} mm{hint}"
    raise InputError(where, "size of the scan", f"{size:.4g} mm along its longest side, read as {unit}", allowed)


MIN_AMPLITUDE = 0.1  # mm of a motion that is measured: breathing of up to 100 mm, in metres, is below
AMPLITUDE_SHARE = 99.0  # % of the time in which the tissue is within its amplitude: a lost pose is none of it


def tool_of(request: PlanRequest) -> ToolBody | None:
    """The tool of the request's arm, with the margin that it keeps; None without an arm."""
    amplitude = request.settings.amplitude_mm
    if request.motion is not None and amplitude:
        raise InputError(COMMAND_LINE, "--motion", request.motion, "nothing beside --amplitude-mm")
    if request.arm is None:
        for name, value in (("--motion", request.motion), ("--amplitude-mm", amplitude)):
            if value:
                raise InputError(COMMAND_LINE, name, value, "nothing without --arm, whose tool must keep clear")
        return None
    if request.motion is not None:
        amplitude = measured_amplitude(request.motion)
    return tool_body_of(read_arm(request.arm), BASE_MARGIN + amplitude)


def measured_amplitude(motion: str) -> float:
    """How far, mm, a tracked surface's origin goes from the middle of its motion, most of the time.

    motion: a recording, a folder of `stillbed track` or `smooth`, or a trajectory as TUM or CSV.
    """
    from hardware.offline.trajectory_files import read_pose_series  # loads gtsam

    places = read_pose_series(motion).trajectory.base_from_surface[:, :3, 3]
    if not len(places):
        raise InputError(motion, "poses", "none", "a trajectory of the surface")
    ends = np.percentile(places, [100 - AMPLITUDE_SHARE, AMPLITUDE_SHARE], axis=0)
    distance = np.linalg.norm(places - ends.mean(axis=0), axis=1)
    _, most = SETTINGS["amplitude_mm"].limits or (0.0, math.inf)
    amplitude = float(np.percentile(distance, AMPLITUDE_SHARE))
    if not amplitude <= most:
        raise InputError(motion, "amplitude", f"{amplitude:.1f} mm", f"{most:g} mm or less: of tissue, not of a camera")
    if amplitude < MIN_AMPLITUDE:
        allowed = f"{MIN_AMPLITUDE:g} mm or more; places are in mm, not m; of tissue at rest: --amplitude-mm 0"
        raise InputError(motion, "amplitude", f"{amplitude:.2g} mm", allowed)
    return amplitude


SCAN_STEPS = 3  # a mesh is read, repaired, and its wound found


class PlanFiles:
    """The files of a plan: PATH.csv, and those beside it that are named after it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.layer_table, self.summary = self._beside("_layers.csv"), self._beside(".json")
        self.scan, self.example = self._beside("_scan.ply"), self._beside("_example.ply")
        self.report, self.question = self._beside(".html"), self._beside("_question.html")
        self.pictures = self._beside("_layers")  # a folder
        self.companions = (self.layer_table, self.summary, self.scan, self.example, self.report, self.question)

    def _beside(self, ending: str) -> Path:
        return self.path.with_name(self.path.stem + ending)

    def remove_companions(self) -> None:
        """Remove what an earlier plan left beside its path, so that none of it is taken for this one's."""
        for file in (*self.companions, *self.pictures.glob("layer_*.svg")):
            file.unlink(missing_ok=True)


def check_out(request: PlanRequest) -> None:
    """Make the folder of the file that is written; InputError where it stands there already and no --force is given.

    InputError as well where the scan or the outline would be overwritten, or nothing can be written there.
    """
    out, gcode = request.out, request.gcode
    if out.suffix.lower() != ".csv":
        raise InputError(COMMAND_LINE, "--out", out, "a file that ends in .csv")
    written = [out, *([gcode] if gcode else [])]
    for read in filter(None, (request.scan, request.outline)):
        for file in (*written, *PlanFiles(out).companions):
            check_apart("--out", file, read)
    if gcode in (out, *PlanFiles(out).companions):
        raise InputError(COMMAND_LINE, "--gcode", gcode, "another file than those of the plan")
    for option, file in zip(("--out", "--gcode"), written, strict=False):
        if file.is_dir():
            raise InputError(file, option, "a folder", "a file")
        check_new(file, request.force, option)
        file.parent.mkdir(parents=True, exist_ok=True)


def subject_of(request: PlanRequest, flat: bool, progress: ProgressReport = no_progress) -> PlanSubject:
    """The wound that is to be planned, read and found. flat: the scan is a contour. progress: of a mesh's steps."""
    step = float(np.clip(GRID_PER_BEAD * request.settings.bead, MIN_GRID_STEP, MAX_GRID_STEP))
    if request.example is not None and request.scan is not None:
        raise InputError(COMMAND_LINE, "SCAN", request.scan, "none beside --example")
    if request.example is not None:
        example, name = example_scan(request.example), f"{request.example} (example)"
        scan, repairs = repair_mesh(*example, name)
        return PlanSubject(name, find_wound(scan, step, name), repairs, example)
    if request.scan is None:
        raise InputError(COMMAND_LINE, "SCAN", "none", "a mesh, a contour, or --example forearm, chest or foot")
    if flat:
        height = request.settings.layer_height or request.settings.bead
        contour = read_contour(request.scan)
        if contour.shape[1] != 2:
            raise InputError(request.scan, "header", "x_mm,y_mm,z_mm", "x_mm,y_mm: a flat contour")
        return PlanSubject(request.scan.name, flat_wound(contour, height, request.scan), None)
    sources = [request.outline, request.clicks, request.wound]
    if sum(source is not None for source in sources) > 1:
        raise InputError(COMMAND_LINE, "--outline, --clicks, --wound", "more than one", "one that says where it is")
    drawn = None if request.outline is None else read_contour(request.outline)
    clicks = None if request.clicks is None else parse_clicks(request.clicks)
    raw = read_raw_mesh(request.scan)
    progress(1, SCAN_STEPS)
    vertices = in_mm(raw.vertices, raw.triangles, request.unit, request.scan)
    scan, repairs = repair_mesh(vertices, raw.triangles, request.scan, request.flip)
    progress(2, SCAN_STEPS)
    outline = None if drawn is None else _outline(drawn, scan.vertices)
    colour = scan_colour(scan, vertices, raw.colours, request.scan) if outline is None and clicks is None else None
    try:
        wound = find_wound(
            scan, step, request.scan, outline, request.flip, clicks=clicks, number=request.wound, colour=colour
        )
    except WoundQuestionError as question:
        page = PlanFiles(request.out).question
        write_question(page, scan, vertices, raw.colours, question)
        allowed = f"{question.allowed}: pictures of them are in {page}"
        raise InputError(question.where, question.what, question.got, allowed) from None
    progress(SCAN_STEPS, SCAN_STEPS)
    return PlanSubject(request.scan.name, wound, repairs)


def _outline(points: Array, vertices: Array) -> Array:
    """An outline (N, 3), mm, of points (N, 2 or 3); without z it is laid on the scan as seen along the scan's z."""
    if points.shape[1] == 3:
        return points
    nearest = [int(np.argmin(np.sum((vertices[:, :2] - point) ** 2, axis=1))) for point in points]
    return np.column_stack([points, vertices[nearest, 2]])


def example_scan(kind: str) -> tuple[Array, Index]:
    """A scan of a built-in body with a wound: vertices (V, 3) mm and triangles (T, 3)."""
    from hardware.simulator.scene.shape import Wound as Carved
    from hardware.simulator.scene.shape import body

    return body(kind, Carved(EXAMPLE_SIZE, EXAMPLE_DEPTH), EXAMPLE_SEED).mesh(EXAMPLE_STEP)
