"""`stillbed reach`: whether an arm can print a path, checkpoint by checkpoint, as text, table and page."""

from __future__ import annotations

from dataclasses import dataclass, replace
from html import escape
from pathlib import Path as File

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array
from hardware.arm.profile import ARM_FROM_BENCH, ArmProfile, far_limits_text, unreached_limits_text
from hardware.files.arm_file import read_arm, tool_body_of
from hardware.files.folder_tables import csv_table
from hardware.files.mesh_file import read_mesh
from hardware.files.path_file import read_path, write_path
from hardware.process.clock import WallClock
from hardware.process.progress import Progress, check_apart, duration_text, prepare_out
from hardware.report.page import (
    MAX_LINE_POINTS,
    Plot,
    document,
    dot_key,
    figures_table,
    legend,
    line_key,
    section,
    spanning,
    two_views,
)
from planning.clearance import BASE_MARGIN
from planning.kinematics import ELBOWS, POSTURES, SHOULDERS, WRISTS, JointModel, SimpleArm, link_chain
from planning.layers.clearing import path_rooms
from planning.motion.retime import run_times
from planning.path import (
    LEANS,
    MIN_SHOULDER_DISTANCE,
    MIN_SINGULAR_ANGLE,
    REACH_REASONS,
    TISSUE,
    Path,
    Reach,
    SurfaceMotion,
    best_posture,
    best_spin,
    reach_at_spin,
    spin_path,
    unturned_reach,
)
from planning.urdf import UrdfKinematics, urdf_reach

PAGE_WIDTH_PX = 900
WRITTEN = "path.csv", "reach.csv", "reach.html"
PRINTABLE_CLASS, BLOCKED_CLASS, PATH_CLASS, TRUTH_CLASS = "estimate", "off", "aside", "truth"  # of report.css

REMEDIES = {  # by REACH_REASONS
    "too far": "move the surface nearer to the arm (--surface), or extend the limits in the arm file",
    "joint range": "allow the tool to spin (--spin), use the better posture, or rotate the surface",
    "singular": "allow the tool to spin (--spin), or move or tilt the surface",
    "joint speed": "print slower there (speed_mm_s of the path), or reduce the surface's motion",
    LEANS: "level the surface, reduce its motion, or increase max_lean_deg in the arm file",
    TISSUE: "plan with --arm, which tilts the tool or omits the bead; or use a longer needle",
}
MAX_STRETCHES = 60  # rows of infeasible checkpoints on the page; reach.csv has all


def reach_page(path_name: str, arm: str, text: str, path: Path, reach: Reach, model: ArmModel | None = None) -> str:
    """The whole page as HTML. text: the answer as the terminal has it. model: of the arm that is drawn."""
    good, count = int(reach.feasible.sum()), len(reach.reason)
    rows = [[name, str(int((reach.reason == i).sum()))] for i, name in enumerate(REACH_REASONS)]
    body = [section("From above", "The checkpoints in the surface frame, mm.", _above(path, reach))]
    if isinstance(model, JointModel) and np.isfinite(reach.joints).all(axis=1).any():
        words = "Links at the first checkpoint and at the worst one, in the arm's frame, mm."
        body.append(section("The arm", words, _arm_picture(model, reach)))
    words = "Worst value over the surface's motion, by checkpoint. Dashed: the limit."
    body += [
        section("Along the path", words, _along(reach, model)),
        section("Reasons", "Number of checkpoints by reason.", figures_table(("", "checkpoints"), rows)),
    ]
    if good < count:
        head = ("checkpoints", "layer", "reason", "remedy")
        body.append(
            section("Infeasible checkpoints", "In the order of the path.", figures_table(head, _red(path, reach)))
        )
    body.append(section("Summary", "As in the terminal.", f"<pre>{escape(text)}</pre>"))
    return document("reach", path_name, f"{arm}: {good} of {count} checkpoints are feasible.", body, "stillbed reach")


def _red(path: Path, reach: Reach) -> list[list[str]]:
    """Rows of stretches of checkpoints with one layer and one reason: which, the layer, the reason, the remedy."""
    same = (np.diff(reach.reason) == 0) & (np.diff(path.layer) == 0)
    first = np.concatenate([[0], np.flatnonzero(~same) + 1])
    last = np.append(first[1:] - 1, len(reach.reason) - 1)
    rows = []
    for a, b in zip(first.tolist(), last.tolist(), strict=True):
        if reason := int(reach.reason[a]):
            which = str(a) if a == b else f"{a} to {b}"
            rows.append([which, str(path.layer[a]), REACH_REASONS[reason], REMEDIES[REACH_REASONS[reason]]])
    rest = len(rows) - MAX_STRETCHES
    return rows if rest <= 0 else [*rows[:MAX_STRETCHES], [f"and {rest} more rows", "", "", "see reach.csv"]]


def _arm_picture(model: JointModel, reach: Reach) -> str:
    """The links from the side that shows them, and from above, at the first checkpoint and at the worst."""
    known = np.flatnonzero(np.isfinite(reach.joints).all(axis=1))
    red = known[~reach.feasible[known]]
    worst = int((red if len(red) else known)[0])
    if not len(red):  # the nearest to an end of a range
        worst = int(known[np.argmin(np.where(np.isfinite(reach.bound[known]), reach.bound[known], np.inf))])
    shown = {int(known[0]): PRINTABLE_CLASS, worst: BLOCKED_CLASS if len(red) else TRUTH_CLASS}
    links = [(np.vstack([np.zeros((1, 3)), link_chain(model, reach.joints[k])[:, :3, 3]]), shown[k]) for k in shown]
    keys = [line_key(style, f"checkpoint {k}: {REACH_REASONS[reach.reason[k]]}") for k, style in shown.items()]
    return legend(keys) + two_views(links)


def _above(path: Path, reach: Reach) -> str:
    """The path seen along the surface's normal; equal scales."""
    places = path.surface_from_nozzle[:, :2, 3]
    middle = (places.min(axis=0) + places.max(axis=0)) / 2
    half = max(float(np.ptp(places, axis=0).max()) / 2, 1.0) * 1.08
    x, y = ((float(m - half), float(m + half)) for m in middle)
    plot = Plot(PAGE_WIDTH_PX, PAGE_WIDTH_PX * 2 // 3, (x[0] - half / 2, x[1] + half / 2), y, label="y, mm")
    many = len(places) > MAX_LINE_POINTS  # dots would run into each other
    plot.way(places[:, 0], places[:, 1], PRINTABLE_CLASS if many else PATH_CLASS)
    printable, blocked = places[reach.feasible & (not many)], places[~reach.feasible]
    plot.dots(printable[:, 0], printable[:, 1], PRINTABLE_CLASS, 1.6)
    plot.dots(blocked[:, 0], blocked[:, 1], BLOCKED_CLASS, 4.0)
    keys = [(line_key if many else dot_key)(PRINTABLE_CLASS, "feasible")]
    keys += [] if many else [line_key(PATH_CLASS, "path")]
    return legend([*keys, dot_key(BLOCKED_CLASS, "infeasible")]) + plot.svg()


def _along(reach: Reach, model: ArmModel | None) -> str:
    angle = float(np.rad2deg(MIN_SINGULAR_ANGLE))
    lean, most = np.full_like(reach.speed, np.nan), 0.0
    if isinstance(model, SimpleArm) and reach.lean is not None:
        lean, most = np.rad2deg(reach.lean), float(np.rad2deg(model.max_lean or 0.0))
    curves = {
        "distance to a joint limit, degrees": (np.rad2deg(reach.bound), 0.0),
        "distance to the wrist singularity, degrees": (np.rad2deg(reach.wrist), angle),
        "distance to the elbow singularity, degrees": (np.rad2deg(reach.elbow), angle),
        "distance of the wrist from the first axis, mm": (reach.shoulder, MIN_SHOULDER_DISTANCE),
        "joint speed, % of the maximum": (100 * reach.speed, 100.0),
        "lean of the tool, degrees": (lean, most),
    }
    plots, span = [], (0.0, float(max(len(reach.speed) - 1, 1)))
    for label, (values, limit) in curves.items():
        if not np.isfinite(values).any():
            continue
        plot = Plot(PAGE_WIDTH_PX, 130, span, spanning([values, np.array([0.0, 1.05 * limit])]), label=label)
        plot.level(limit, f"limit {limit:g}", "limit")
        plot.line(np.arange(len(values), dtype=float), values, PRINTABLE_CLASS)
        plots.append(plot.svg())
    return "".join(plots)


ArmModel = JointModel | UrdfKinematics | SimpleArm  # the last: a machine that does not turn
REACH_COLUMNS = (
    *("checkpoint", "feasible", "reason", *(f"j{i}_deg" for i in range(1, 7)), "to_range_end_deg"),
    *("to_wrist_singularity_deg", "to_elbow_singularity_deg", "to_first_axis_mm", "manipulability"),
    *("joint_speed_share", "spin_deg"),
)


@dataclass(frozen=True, slots=True)
class ReachQuestion:
    """Pose and motion of the surface, and whether the tool may spin."""

    surface: tuple[float, ...] | None = None  # (6,) at rest, arm frame, mm and degrees; None: on the default bench
    amplitude_mm: float = 0.0  # of the surface's motion, as the next two
    turn_deg: float = 0.0
    rate_hz: float = 0.25
    spin: bool = False
    scan: File | None = None  # that the tool must stay out of; None: PATH_scan.ply beside the path, where plan wrote it


@dataclass(frozen=True, slots=True)
class ReachAnswer:
    """The reach of a path as a text, and whether all checkpoints are feasible."""

    text: str
    feasible: bool


def run_reach(
    path: File, arm: File, question: ReachQuestion, out: File | None = None, force: bool = False
) -> ReachAnswer:
    """Whether an arm can print a path, given their files; writes path.csv, reach.csv and reach.html into `out`."""
    checkpoints = read_path(path)
    if out is not None:
        check_apart("--out", out / WRITTEN[0], path)
        prepare_out(out, force)
        for stale in WRITTEN:  # an earlier run's, which nobody is to take for this one's
            (out / stale).unlink(missing_ok=True)
    with Progress("reach", "steps", WallClock().now) as progress:
        progress.note = "joints and speeds of each checkpoint, with the surface's motion"
        progress(0, 4)
        model, motion, reach = _evaluated(checkpoints, arm, question)
        best, profile, scan = None, read_arm(arm), _scan_of(path, question)
        progress.note = "clearance between tool and tissue"
        progress(1, 4)
        reach, met = _with_tissue(reach, checkpoints, profile, scan, question)
        progress.note = "other postures"
        progress(2, 4)
        if isinstance(model, JointModel):
            best = best_posture(model, _arm_from_surface(question), checkpoints, motion)
        progress.note = "printing time"
        progress(3, 4)
        seconds = float(run_times(checkpoints, profile.arm, profile.limits, profile.tick)[-1])
    text = reach_text(model, reach, best, question, seconds, float(profile.tool[0, 1]))
    text = "\n".join(filter(None, [text, met, far_limits_text(profile.limits), unreached_limits_text(profile)]))
    if out is not None:
        _write(out, with_feasible_column(checkpoints, reach), reach)
        page = reach_page(path.name, _name(model), text, checkpoints, reach, model)
        (out / "reach.html").write_text(page, encoding="utf-8")
    return ReachAnswer(text, bool(reach.feasible.all()))


def _scan_of(path: File, question: ReachQuestion) -> File | None:
    """The scan that a path was planned on."""
    scan_file = path.with_name(f"{path.stem}_scan.ply")
    return question.scan if question.scan is not None else scan_file if scan_file.is_file() else None


def _with_tissue(
    reach: Reach, path: Path, profile: ArmProfile, scan: File | None, question: ReachQuestion
) -> tuple[Reach, str]:
    """The reach with checkpoints marked at which the tool has no room, and a line about that."""
    if scan is None:
        return reach, "tool: clearance not checked without --scan SCAN"
    spun = replace(path, surface_from_nozzle=spin_path(path, reach.spin))
    try:
        body = tool_body_of(profile, BASE_MARGIN + question.amplitude_mm)
        room, part = path_rooms(read_mesh(scan), spun, body)
    except InputError as error:
        raise InputError(scan, error.what, error.got, error.allowed) if error.where == "scan" else error from None
    short, worst = room < 0, int(room.argmin())
    marked = replace(reach, reason=np.where(short & reach.feasible, REACH_REASONS.index(TISSUE), reach.reason))
    if not short.any():
        return marked, f"tool: {body.margin:g} mm or more from the tissue at all checkpoints"
    return marked, (
        f"tool: too near to the tissue at {int(short.sum())} checkpoints, by up to {-room[worst]:.2f} mm: the "
        f"{part[worst]} at checkpoint {worst}; required: {body.margin:g} mm"
    )


def with_feasible(path: Path, arm: File) -> tuple[Path, str]:
    """The path with the column `feasible` for the arm in a file over a surface at rest, and a sentence about it."""
    model, _, reach = _evaluated(path, arm, ReachQuestion())
    count = f"{int(reach.feasible.sum())} of {len(path)} checkpoints are feasible, surface at rest"
    return with_feasible_column(
        path, reach
    ), f"arm {_name(model)}: {count}; details, and moving surfaces: stillbed reach"


def _evaluated(path: Path, arm: File, question: ReachQuestion) -> tuple[ArmModel, SurfaceMotion, Reach]:
    """The arm's model, the surface's motion, and the arm's reach along the path over that motion."""
    profile, model = read_arm(arm), _arm_model(arm, question)
    motion = SurfaceMotion(question.amplitude_mm, float(np.deg2rad(question.turn_deg)), question.rate_hz)
    place = _arm_from_surface(question, None if isinstance(model, JointModel) else profile)
    if isinstance(model, SimpleArm):
        reach = unturned_reach(model, profile.limits.speed[:3], place, path, motion)
    elif isinstance(model, UrdfKinematics):
        reach = urdf_reach(model, place, path, motion)
    else:
        spin = best_spin(model, place, path, motion) if question.spin else np.zeros(len(path))
        reach = reach_at_spin(model, place, path, motion, spin)
    return model, motion, _within(profile, place, path, motion, reach)


def _arm_model(arm: File, question: ReachQuestion) -> ArmModel:
    """The model of an arm's joints; the tool of one by a URDF file is not spun."""
    profile = read_arm(arm)
    if profile.arm.max_lean is not None:
        return profile.arm
    if profile.urdf is None:
        return read_jointed_arm(arm)[1]
    if question.spin:
        raise InputError("command line", "--spin", "given", "an arm of six joints with a table of them")
    if profile.flange_from_nozzle is None:
        raise InputError(profile.urdf.file, "flange_from_nozzle", "missing", "a 4x4 matrix in the arm file, mm")
    return UrdfKinematics(profile.urdf, profile.flange_from_nozzle)


def read_jointed_arm(arm: File) -> tuple[ArmProfile, JointModel]:
    """The profile in an arm file and the model of its joints; InputError where it has none."""
    profile = read_arm(arm)
    if profile.arm.joints is None:
        raise InputError(arm, "kinematics", "missing", "a table [kinematics]: data/arms has examples")
    return profile, profile.arm.joints


def with_feasible_column(path: Path, reach: Reach) -> Path:
    """The path with the reach's tool spin and the column `feasible`, 1 or 0."""
    column = reach.feasible.astype(np.int64)
    return replace(path, surface_from_nozzle=spin_path(path, reach.spin), extra={**path.extra, "feasible": column})


def reach_text(
    model: ArmModel,
    reach: Reach,
    best: tuple[int, int] | None,
    question: ReachQuestion,
    seconds: float,
    edge: float = 0.0,
) -> str:
    """The answer as a table of text.

    best: posture by its row of POSTURES, and its number of printable checkpoints; None of an arm by a URDF file.
    seconds: that a run takes. edge: mm from the tool's axis to the edge of its tip.
    """
    count, good = len(reach.reason), int(reach.feasible.sum())
    speed = reach.speed[np.isfinite(reach.speed)]
    swing = f"{question.amplitude_mm:g} mm and {question.turn_deg:g} degrees at {question.rate_hz:g} Hz"
    nominal = isinstance(model, JointModel) and model.nominal
    rows = [
        ("arm", _name(model) + (" (NOMINAL: not measured)" if nominal else "")),
        ("motion of the surface", f"+-{swing}" if question.amplitude_mm or question.turn_deg else "none"),
        ("checkpoints", f"{good} of {count} are feasible"),
        *((f"  {name}", str(int((reach.reason == i).sum()))) for i, name in enumerate(REACH_REASONS) if i),
        *_stance(model, reach, edge),
        ("largest joint speed", f"{100 * speed.max() if len(speed) else np.nan:.0f} %"),
        ("printing time, surface at rest", f"{duration_text(seconds)} from the first checkpoint"),
    ]
    if best is not None and best[1] > good:
        names = zip(POSTURES[best[0]], (SHOULDERS, ELBOWS, WRISTS), strict=True)
        posture = ", ".join(pair[0 if sign > 0 else 1] for sign, pair in names)
        rows.append(("better posture", f"{posture}: {best[1]} of {count}, without spin"))
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name:<{width}}  {value}" for name, value in rows)


def _name(model: ArmModel) -> str:
    return "a machine without rotations" if isinstance(model, SimpleArm) else model.name


def _stance(model: ArmModel, reach: Reach, edge: float) -> list[tuple[str, str]]:
    """Posture of the arm and distances to its limits; without rotations, the lean of the tool."""
    if isinstance(model, SimpleArm):
        assert reach.lean is not None and model.max_lean is not None
        lean, nearer = float(reach.lean.max()), edge * float(np.sin(reach.lean.max()))
        allowed = f"{np.rad2deg(model.max_lean):g} allowed"
        cost = f"{np.rad2deg(lean):.1f} degrees ({allowed}): an edge of its tip is {nearer:.2f} mm nearer to the tissue"
        return [("largest lean of the tool", cost)]
    ends = [("distance to a joint limit", f"{_smallest(np.rad2deg(reach.bound))} degrees")]
    if isinstance(model, UrdfKinematics):
        near = f"near {', '.join(f'{angle:.0f}' for angle in np.rad2deg(model.ready))} degrees"
        return [("posture", near), *ends, ("least manipulability", f"{_smallest(reach.manipulability, 3)}")]
    return [
        ("posture", ", ".join(model.posture)),
        *ends,
        ("distance to the wrist singularity", f"{_smallest(np.rad2deg(reach.wrist))} degrees"),
        ("distance to the elbow singularity", f"{_smallest(np.rad2deg(reach.elbow))} degrees"),
        ("wrist from the first axis", f"{_smallest(reach.shoulder)} mm"),
        ("spin of the tool", f"{np.rad2deg(reach.spin.min()):.0f} to {np.rad2deg(reach.spin.max()):.0f} degrees"),
    ]


def _arm_from_surface(question: ReachQuestion, profile: ArmProfile | None = None) -> Array:
    """Pose of the surface; default: on the bench, or below the home of `profile`."""
    if question.surface is None and profile is not None:
        return se3.make(np.eye(3), ARM_FROM_BENCH[:3, 3] + (profile.arm.home - ArmProfile().arm.home)[:3])
    if question.surface is None:
        return ARM_FROM_BENCH
    values = np.array(question.surface, float)
    if values.shape != (6,) or not np.isfinite(values).all():
        raise InputError("command line", "--surface", question.surface, "6 finite numbers X Y Z A B C, mm and degrees")
    return se3.make(se3.rotation_from_euler(np.deg2rad(values[3:])), values[:3])


def _within(profile: ArmProfile, place: Array, path: Path, motion: SurfaceMotion, reach: Reach) -> Reach:
    """The same reach, with checkpoints outside the arm file's limits of X Y Z marked as too far."""
    tips = (place @ motion.places[:, None] @ path.surface_from_nozzle)[..., :3, 3]
    low, high = profile.limits.low[:3], profile.limits.high[:3]
    beyond = ((tips < low) | (tips > high)).any(axis=(0, 2))
    return replace(reach, reason=np.where(beyond & reach.feasible, REACH_REASONS.index("too far"), reach.reason))


def _write(out: File, path: Path, reach: Reach) -> None:
    write_path(out / "path.csv", path)
    angles = np.rad2deg([reach.bound, reach.wrist, reach.elbow])
    table = np.column_stack(
        [np.rad2deg(reach.joints), *angles, reach.shoulder, reach.manipulability, reach.speed, np.rad2deg(reach.spin)]
    )
    more = (f"j{i}_deg" for i in range(7, reach.joints.shape[1] + 1))
    with csv_table(out / "reach.csv", [*REACH_COLUMNS[:9], *more, *REACH_COLUMNS[9:]]) as write_row:
        for i, row in enumerate(table.tolist()):
            numbers = [f"{value:.4f}" if np.isfinite(value) else "" for value in row]
            write_row([i, int(reach.feasible[i]), REACH_REASONS[reach.reason[i]], *numbers])


def _smallest(values: Array, digits: int = 1) -> str:
    finite = values[np.isfinite(values)]
    return f"{finite.min():.{digits}f}" if len(finite) else "unknown"
