"""`stillbed reach`: whether an arm can print a path, checkpoint by checkpoint, as text, table and page."""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path as File

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array
from hardware.arm.profile import ARM_FROM_BENCH, ArmProfile
from hardware.files.arm_file import read_arm
from hardware.files.path_file import read_path, write_path
from hardware.process.progress import prepare_out
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
)
from planning.path import Path
from planning.robot.kinematics import ELBOWS, POSTURES, SHOULDERS, WRISTS, JointModel
from planning.robot.reach import REASONS, Reach, SurfaceMotion, best_posture, best_spin, reach_at_spin, spin_path

PAGE_WIDTH_PX = 900  # px
PRINTABLE_CLASS, BLOCKED_CLASS, PATH_CLASS = "estimate", "off", "aside"  # classes of report.css


def reach_page(path_name: str, arm: str, text: str, path: Path, found: Reach) -> str:
    """The whole page as HTML. text: the answer as the terminal has it."""
    good, count = int(found.feasible.sum()), len(found.reason)
    rows = [[name, str(int((found.reason == i).sum()))] for i, name in enumerate(REASONS)]
    body = [
        section("From above", "The checkpoints in the surface frame, mm.", _above(path, found)),
        section("Along the path", "The worst over where the surface may be; by checkpoint.", _along(found)),
        section("Why", "Checkpoints by what the arm lacks there.", figures_table(("", "checkpoints"), rows)),
        section("In words", "As in the terminal.", f"<pre>{escape(text)}</pre>"),
    ]
    return document("reach", path_name, f"{arm}: {good} of {count} checkpoints can be printed.", body, "stillbed reach")


def _above(path: Path, found: Reach) -> str:
    """The path seen against the surface's normal; equal scales."""
    places = path.surface_from_nozzle[:, :2, 3]
    middle = (places.min(axis=0) + places.max(axis=0)) / 2
    half = max(float(np.ptp(places, axis=0).max()) / 2, 1.0) * 1.08
    box = [(float(m - half), float(m + half)) for m in middle]
    plot = Plot(
        PAGE_WIDTH_PX, PAGE_WIDTH_PX * 2 // 3, (box[0][0] - half / 2, box[0][1] + half / 2), box[1], label="y, mm"
    )
    many = len(places) > MAX_LINE_POINTS  # no dot could be told from the next
    plot.way(places[:, 0], places[:, 1], PRINTABLE_CLASS if many else PATH_CLASS)
    for style, rows, radius in (
        (PRINTABLE_CLASS, found.feasible & (not many), 1.6),
        (BLOCKED_CLASS, ~found.feasible, 4.0),
    ):
        plot.dots(places[rows, 0], places[rows, 1], style, radius)
    good = (
        [line_key(PRINTABLE_CLASS, "can be printed")]
        if many
        else [dot_key(PRINTABLE_CLASS, "can be printed"), line_key(PATH_CLASS, "path")]
    )
    return legend([*good, dot_key(BLOCKED_CLASS, "cannot")]) + plot.svg()


def _along(found: Reach) -> str:
    degrees = np.rad2deg([found.bound, found.wrist, found.elbow])
    plots = [
        _plot("to the end of a joint's range, degrees", degrees[0]),
        _plot("to a singular wrist, degrees", degrees[1]),
        _plot("to a singular elbow, degrees", degrees[2]),
        _plot("of a joint's speed, %", 100 * found.speed),
    ]
    return "".join(plots)


def _plot(label: str, values: Array) -> str:
    plot = Plot(PAGE_WIDTH_PX, 130, (0.0, float(max(len(values) - 1, 1))), spanning([values, np.zeros(1)]), label=label)
    plot.line(np.arange(len(values), dtype=float), values, PRINTABLE_CLASS)
    return plot.svg()


REACH_COLUMNS = (
    *("checkpoint", "feasible", "reason", *(f"j{i}_deg" for i in range(1, 7)), "to_range_end_deg"),
    *("to_wrist_singularity_deg", "to_elbow_singularity_deg", "to_first_axis_mm", "manipulability"),
    *("joint_speed_share", "spin_deg"),
)


@dataclass(frozen=True, slots=True)
class ReachQuestion:
    """What is asked. surface: (6,) X Y Z mm and A B C degrees of the surface at rest in the arm's frame, None: under
    the default arm's home. amplitude_mm, turn_deg, rate_hz: of the surface's motion. spin: whether the tool may spin.
    """

    surface: tuple[float, ...] | None = None
    amplitude_mm: float = 0.0
    turn_deg: float = 0.0
    rate_hz: float = 0.25
    spin: bool = False


@dataclass(frozen=True, slots=True)
class ReachAnswer:
    """text: for the terminal. feasible: whether all checkpoints are."""

    text: str
    feasible: bool


def run_reach(
    path: File, arm: File, question: ReachQuestion, out: File | None = None, force: bool = False
) -> ReachAnswer:
    """Ask the arm in file `arm` about the path in file `path`; with `out` path.csv, reach.csv and reach.html there."""
    checkpoints = read_path(path)
    model, motion, found = _evaluated(checkpoints, arm, question)
    text = reach_text(model, found, best_posture(model, _arm_from_surface(question), checkpoints, motion), question)
    if out is not None:
        prepare_out(out, force)
        _write(out, with_feasible_column(checkpoints, found), found)
        (out / "reach.html").write_text(reach_page(path.name, model.name, text, checkpoints, found), encoding="utf-8")
    return ReachAnswer(text, bool(found.feasible.all()))


def with_feasible(path: Path, arm: File) -> tuple[Path, str]:
    """The path with the column `feasible` as the arm in a file has it, over a surface at rest, and that in words."""
    model, _, found = _evaluated(path, arm, ReachQuestion())
    count = f"{int(found.feasible.sum())} of {len(path)} checkpoints can be printed, the surface at rest"
    return with_feasible_column(path, found), f"arm {model.name}: {count}; how, and on a moving one: stillbed reach"


def _evaluated(path: Path, arm: File, question: ReachQuestion) -> tuple[JointModel, SurfaceMotion, Reach]:
    """The arm's model, the surface's motion, and what the path asks of the one over the other."""
    profile = read_arm(arm)
    model = profile.arm.joints
    if model is None:
        raise InputError(arm, "kinematics", "missing", "a table [kinematics]: data/arms has examples")
    motion, place = (
        SurfaceMotion(question.amplitude_mm, float(np.deg2rad(question.turn_deg)), question.rate_hz),
        _arm_from_surface(question),
    )
    spin = best_spin(model, place, path, motion) if question.spin else np.zeros(len(path))
    return model, motion, _within(profile, place, path, motion, reach_at_spin(model, place, path, motion, spin))


def with_feasible_column(path: Path, found: Reach) -> Path:
    """The path with the spin that was found and the column `feasible`, 1 or 0."""
    column = np.where(found.feasible, "1", "0")
    return replace(path, surface_from_nozzle=spin_path(path, found.spin), extra={**path.extra, "feasible": column})


def reach_text(model: JointModel, found: Reach, best: tuple[int, int], question: ReachQuestion) -> str:
    """The answer for people."""
    count, good = len(found.reason), int(found.feasible.sum())
    swing = f"{question.amplitude_mm:g} mm and {question.turn_deg:g} degrees at {question.rate_hz:g} Hz"
    rows = [
        ("arm", model.name + (" (NOMINAL: its numbers are made up)" if model.nominal else "")),
        ("posture", ", ".join(model.posture)),
        ("surface moves by", f"+-{swing}" if question.amplitude_mm or question.turn_deg else "nothing"),
        ("checkpoints", f"{good} of {count} can be printed"),
        *((f"  {name}", str(int((found.reason == i).sum()))) for i, name in enumerate(REASONS) if i),
        ("nearest to a joint's end", f"{_smallest_angle(found.bound)} degrees"),
        ("nearest to a singular wrist", f"{_smallest_angle(found.wrist)} degrees"),
        ("nearest to a singular elbow", f"{_smallest_angle(found.elbow)} degrees"),
        ("wrist to the first axis", f"{_number(found.shoulder)} mm"),
        ("most of a joint's speed", f"{100 * _largest(found.speed):.0f} %"),
        ("spin of the tool", f"{np.rad2deg(found.spin.min()):.0f} to {np.rad2deg(found.spin.max()):.0f} degrees"),
    ]
    if best[1] > good:
        rows.append(
            ("better posture", f"{', '.join(_posture_names(POSTURES[best[0]]))}: {best[1]} of {count}, without spin")
        )
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name:<{width}}  {value}" for name, value in rows)


def _arm_from_surface(question: ReachQuestion) -> Array:
    if question.surface is None:
        return ARM_FROM_BENCH
    values = np.array(question.surface, float)
    if values.shape != (6,) or not np.isfinite(values).all():
        raise InputError("command line", "--surface", question.surface, "6 finite numbers X Y Z A B C, mm and degrees")
    return se3.make(se3.rotation_from_euler(np.deg2rad(values[3:])), values[:3])


def _within(profile: ArmProfile, place: Array, path: Path, motion: SurfaceMotion, found: Reach) -> Reach:
    """The same, checkpoints beyond the arm file's own limits of X Y Z being too far."""
    tips = (place @ motion.places[:, None] @ path.surface_from_nozzle)[..., :3, 3]
    low, high = profile.limits.low[:3], profile.limits.high[:3]
    beyond = ((tips < low) | (tips > high)).any(axis=(0, 2))
    return replace(found, reason=np.where(beyond & found.feasible, REASONS.index("too far"), found.reason))


def _write(out: File, path: Path, found: Reach) -> None:
    write_path(out / "path.csv", path)
    angles = np.rad2deg([found.bound, found.wrist, found.elbow])
    table = np.column_stack(
        [np.rad2deg(found.joints), *angles, found.shoulder, found.manipulability, found.speed, np.rad2deg(found.spin)]
    )
    with (out / "reach.csv").open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(REACH_COLUMNS)
        for i, row in enumerate(table.tolist()):
            numbers = [f"{value:.4f}" if np.isfinite(value) else "" for value in row]
            writer.writerow([i, int(found.feasible[i]), REASONS[found.reason[i]], *numbers])


def _posture_names(signs: Array) -> list[str]:
    return [pair[0 if sign > 0 else 1] for sign, pair in zip(signs, (SHOULDERS, ELBOWS, WRISTS), strict=True)]


def _smallest_angle(angles: Array) -> str:
    return _number(np.rad2deg(angles))


def _number(values: Array) -> str:
    known = values[np.isfinite(values)]
    return f"{known.min():.1f}" if len(known) else "unknown"


def _largest(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.max()) if len(known) else float("nan")
