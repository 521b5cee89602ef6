"""`stillbed plan`: a scan or a contour in; path, G-code, pictures, report and figures out.

With a session, the scan is also registered in its first pictures, point to plane as in tracking. The result is checked
in the thesis's own way (5.2): the centroid of the segmented wound beside that of the planned outline, in each camera.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.errors import InputError
from estimation.rig import ideal_pixels
from estimation.scans.scan import triangulate_lattice
from estimation.se3 import Array
from hardware.arm.profile import ArmProfile
from hardware.files.arm_file import read_arm
from hardware.files.mesh_file import write_ply
from hardware.files.path_file import gcode_text, write_path
from hardware.offline.reach import read_jointed_arm, with_feasible
from hardware.plan.order import Index, PlanFiles, PlanRequest, PlanSubject, check_out, plan_order, subject_of, tool_of
from hardware.plan.page import (
    ReportText,
    layer_bounds,
    layer_svg,
    layers_text,
    len_text,
    material_text,
    page_text,
    tool_facts,
    tool_text,
    unscanned_text,
    volume_text,
)
from hardware.process.clock import WallClock
from hardware.process.progress import Progress, count_text, duration_text, write_atomically
from hardware.process.system import provenance
from hardware.report.evaluation import percent
from planning.layers.plan import (
    LayerFigures,
    Plan,
    PlannedLayer,
    PlanTotal,
    figures_of,
    make_plan,
    total_of,
    unscanned_beads,
)
from planning.layers.wound import WoundVolume
from planning.motion.retime import run_times
from planning.path import check_path
from planning.placement import PathPlacement, placement_by_scan

if TYPE_CHECKING:
    from estimation.pose import SurfacePose
    from estimation.rig import Camera
    from hardware.files.session import Session
    from perception.frames import FrameSet

# from the normal: the finite tip then pushes a bead aside by a fifth of its width
MAX_TILT_OFF_NORMAL_DEG = 35.0
NO_ARM_TEXT = "no column `feasible` without --arm ARM.toml; `stillbed reach` can add it"
MAX_FRAME_SETS = 12  # for the first map, its confirmation, averaging, and some failures
MAX_CENTROID_DISTANCE = 3.0  # mm between the centroids: a network's outline of an oblique wound is good to about 1 mm
LAYER_COLUMNS = (
    "layer", "tissue", "material", "area_mm2", "covered", "double", "over", "gap_mm2", "gap_over_half_a_bead_mm2",
    "gap_over_a_bead_mm2", "runs", "checkpoints", "printed_mm", "travelled_mm", "time_s", "volume_mm3",
)  # fmt: skip
REPAIRED_SCAN_STEP = 0.5  # mm between the vertices of the repaired scan that is written


def run_plan(request: PlanRequest) -> tuple[str, str]:
    """Plan, and write all files, the path first; returns a summary and the damage of the session's file, as texts.

    InputError for wrong files, before the long work.
    """
    from hardware.recording.session_reader import open_session

    flat = request.scan is not None and request.scan.suffix.lower() == ".csv"
    if flat or request.example is not None:
        _check_scan_options(request)
    order = replace(plan_order(request.settings, flat), tool=tool_of(request))
    if request.arm is not None:
        read_jointed_arm(request.arm)  # reports a wrong file before the long work
    damage = ""
    if request.session is not None:
        if flat:
            allowed = "no session with a contour: a contour cannot be registered"
            raise InputError("command line", "--session", request.session, allowed)
        damage = open_session(request.session).damage  # reports a wrong file before anything is written
    check_out(request)
    with _progress("scan", "steps (read, repair, find the wound)") as progress:
        subject = subject_of(request, flat, progress)
    with _progress("plan", "layers") as progress:
        plan = make_plan(subject.wound, order, subject.name, progress)
    path, arm = (plan.path, NO_ARM_TEXT) if request.arm is None else with_feasible(plan.path, request.arm)
    check_path(path)
    PlanFiles(request.out).remove_companions()
    write_atomically(request.out, lambda file: write_path(file, path))
    if request.gcode is not None:
        write_atomically(request.gcode, gcode_text(plan.path))
    with _progress("measure", "layers") as progress:
        profile = ArmProfile() if request.arm is None else read_arm(request.arm)
        moments = run_times(path, profile.arm, profile.limits, profile.tick)
        layers = figures_of(plan, progress, moments)
    total = total_of(layers)
    written = [request.out.name, *_tables(request, plan, subject, layers, total, arm)]
    if request.pictures:
        written += _pictures(request, plan, subject, layers, total, arm, moments)
    placement = []
    if request.session is not None:
        placement = placement_lines(*scan_placement(request.session, PlanFiles(request.out).scan, plan.wound.rim))
    return "\n".join([_summary_text(plan, subject, total, request.out, written), arm, *placement]), damage


def _check_scan_options(request: PlanRequest) -> None:
    """InputError where an option says how to read a scan and there is none: a contour, or a built-in example."""
    given = {
        "--unit": request.unit if request.unit != "mm" else None, "--flip": True if request.flip else None,
        "--outline": request.outline, "--clicks": request.clicks, "--wound": request.wound,
    }  # fmt: skip
    for option, value in given.items():
        if value is not None:
            raise InputError("command line", option, value, "only with the scan of a wound, a mesh or points")


def _tables(
    request: PlanRequest, plan: Plan, subject: PlanSubject, layers: Sequence[LayerFigures], total: PlanTotal, arm: str
) -> list[str]:  # fmt: skip
    """Write the table of layers, the summary, the repaired scan, and an example's scan; their names."""
    files = PlanFiles(request.out)
    written = [files.layer_table.name, files.summary.name]
    write_atomically(files.layer_table, lambda file: _write_layers(file, layers))
    facts = {
        "checkpoints": len(plan.path), "mode": plan.order.mode, "missing_tissues": plan.stack.missing,
        "wound": asdict(plan.wound.findings), "total": asdict(total),
        "repairs": None if subject.repairs is None else asdict(subject.repairs), "settings": asdict(request.settings),
        "bumps": bump_facts(plan), "feasible": arm, "tool": tool_facts(plan),
        "surface_from_plane": plan.wound.surface_from_plane.tolist(), "provenance": provenance().table(),
    }  # fmt: skip
    write_atomically(files.summary, json.dumps(facts, indent=1) + "\n")
    meshes = {files.scan: None if subject.repairs is None else _surface(plan.wound), files.example: subject.example}
    for file, mesh in meshes.items():
        if mesh is not None:
            write_atomically(file, partial(write_ply, vertices=mesh[0], triangles=mesh[1]))
            written.append(file.name)
    return written


def _write_layers(file: Path, layers: Sequence[LayerFigures]) -> None:
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(LAYER_COLUMNS)
        for f in layers:
            shares = (f.coverage.covered, f.coverage.double, f.coverage.over)
            writer.writerow(
                [f.number, f.tissue, f.material, f"{f.area:.3f}", *(f"{share:.6f}" for share in shares)]
                + [f"{gap:.4f}" for gap in (f.gap, f.half_gap, f.bead_gap)]
                + [f.beads, f.checkpoints]
                + [f"{value:.3f}" for value in (f.printed, f.travelled, f.seconds, f.volume)]
            )


def _surface(wound: WoundVolume) -> tuple[Array, Index]:
    """The used scan around the wound, holes closed: vertices (V, 3) mm, scan frame, and triangles (T, 3)."""
    every = max(1, round(REPAIRED_SCAN_STEP / wound.grid.step))
    nodes = np.dstack([wound.grid.nodes, wound.bed])[::every, ::every]
    _, triangles = triangulate_lattice(np.ones(nodes.shape[:2], bool))
    return se3.transform_points(wound.surface_from_plane, nodes.reshape(-1, 3)), triangles


def _pictures(
    request: PlanRequest, plan: Plan, subject: PlanSubject, layers: Sequence[LayerFigures], total: PlanTotal, arm: str,
    moments: Array,
) -> list[str]:  # fmt: skip
    """Write a picture of each layer and the report; their names. moments: times (N,), s, of the checkpoints."""
    folder, report = PlanFiles(request.out).pictures, PlanFiles(request.out).report
    folder.mkdir(exist_ok=True)
    bounds = layer_bounds(plan.layers)
    pictures: list[str] = []
    with _progress("draw", "layers") as progress:
        for i, figures in enumerate(layers):
            pictures.append(layer_svg(plan.layers[figures.number], figures, bounds))
            name = f"layer_{figures.number + 1:03d}.svg"
            (folder / name).write_text(pictures[-1], encoding="utf-8")
            progress(i + 1, len(layers))
    repairs = [] if subject.repairs is None else subject.repairs.rows()
    findings = [*findings_rows(plan), ("reachable checkpoints", arm), ("clearance of the tool", tool_text(plan))]
    text = ReportText(subject.name, findings, repairs, request.settings.rows(), plan_notes(plan))
    write_atomically(report, page_text(plan, layers, total, text, pictures, moments))
    return [f"{folder.name}/ ({len(pictures)} pictures)", report.name]


def _summary_text(plan: Plan, subject: PlanSubject, total: PlanTotal, out: Path, written: Sequence[str]) -> str:
    f = plan.wound.findings
    lines = [
        f"wound: {f.area:.0f} mm^2, up to {f.depth:.2f} mm deep, {volume_text(f)}"
        + ("" if f.given else f"; outline detected at a depth of {f.level:.2f} mm"),
        f"path: {count_text(sum(bool(layer.beads) for layer in plan.layers), 'layer')}, {len(plan.path)} checkpoints, "
        f"{len_text(total.printed)} of bead, {len_text(total.travelled)} of travel, {duration_text(total.seconds)}",
        f"coverage: {percent(total.covered, 2)} covered, {percent(total.double, 2)} twice, "
        f"{percent(total.over, 2)} beside, {total.gap:.2f} mm^2 open",
        "ink: " + ", ".join(f"{volume / 1000:.3f} ml of {material_text(name)}" for name, volume in total.volume),
    ]
    lines += [f"bumps: {bumps_text(plan)}"] if layers_with_bumps(plan) else []
    lines += [f"tool: {tool_text(plan)}"] if plan.clearance is not None and not plan.clearance.left_out else []
    repairs = [] if subject.repairs is None else [f"{what} ({n})" for what, n in subject.repairs.rows()[2:] if n]
    if repairs:
        lines.append("scan: " + ", ".join(repairs))
    lines += [f"note: {note}" for note in plan_notes(plan)]
    return "\n".join([*lines, f"in {out.parent}: {', '.join(written)}"])


def _progress(task: str, unit: str) -> Progress:
    return Progress(task, unit, WallClock().now)


def findings_rows(plan: Plan) -> list[tuple[str, str]]:
    """Rows about the wound and its scan: name, value."""
    f = plan.wound.findings
    low_tilt, high_tilt = (np.rad2deg(t.departure) for t in (plan.ground.low, plan.ground.high))
    rows = [
        ("outline", "given" if f.given else f"detected, at a depth of {f.level:.2f} mm"),
        ("open area", f"{f.area:.1f} mm²"),
        ("largest depth under the restored skin", f"{f.depth:.2f} mm"),
        ("volume up to the restored skin", volume_text(f)),
        ("volume of the beads", f"{plan.points.volume.sum():.0f} mm³"),
    ]
    rows += [("bumps of the bed", bumps_text(plan))] if layers_with_bumps(plan) else []
    if not f.noise and not f.scatter:
        return rows
    return rows + [
        ("noise of the scan", f"{f.noise:.3f} mm, smoothed over {f.smoothing:.2f} mm"),
        ("deviation of the skin around the wound from the restored skin", f"{f.scatter:.3f} mm"),
        ("largest standard deviation of the restored skin", f"{f.skin_sigma:.2f} mm"),
        ("margin of skin not used along the rim", f"{f.margin:.1f} mm"),
        ("interpolated holes of the scan", f"{f.closed:.1f} mm²"),
        ("hidden under overhangs", f"{f.hidden:.1f} mm²"),
        ("largest angle between tool and normal, first and last layer", f"{low_tilt:.1f}°, {high_tilt:.1f}°"),
    ]


def plan_notes(plan: Plan) -> list[str]:
    """Notes to check before printing."""
    notes = list(plan.wound.findings.notes)
    if plan.clearance is not None and plan.clearance.left_out:
        notes.append(f"tool: {tool_text(plan)}")
    notes += [unscanned_text(each) for each in unscanned_beads(plan)]
    if plan.stack.missing:
        notes.append(f"not printed, because the wound is too shallow: {', '.join(plan.stack.missing)}")
    tilt_deg = max(np.rad2deg(t.departure) for t in (plan.ground.low, plan.ground.high))
    if tilt_deg > MAX_TILT_OFF_NORMAL_DEG:
        tilt = f"the tool is tilted up to {tilt_deg:.0f} degrees from the normal"
        notes.append(f"{tilt} on the steepest walls, because of its limits")
    empty = sum(not layer.beads for layer in plan.layers)
    if empty:
        notes.append(f"{empty} of {len(plan.layers)} layers have no space for a bead and are omitted")
    return notes


def layers_with_bumps(plan: Plan) -> list[PlannedLayer]:
    """The layers with bumps of the bed."""
    return [p for p in plan.layers if not (p.over.is_empty and p.around.is_empty)]


def bump_facts(plan: Plan) -> dict[str, Any]:
    """The clearance to bumps, and the bumps of each layer (counted from 1). mm, mm2."""
    passing, width = plan.order.passing, plan.order.pattern.width
    bumps = [
        {
            "layer": p.layer.number + 1, "limit_mm": passing.limit(p.layer.height), "over": len(p.over.geoms),
            "over_mm2": p.over.area, "around": len(p.around.geoms), "around_mm2": p.around.area,
            "highest_mm": p.layer.bumps.highest,
        }
        for p in layers_with_bumps(plan)
    ]  # fmt: skip
    return {"clearance_mm": passing.clear(width), "layers": bumps}


def bumps_text(plan: Plan) -> str:
    """A text about the bumps: layers that print over some, and layers that avoid some."""
    over = [p.layer.number + 1 for p in plan.layers if not p.over.is_empty]
    around = [p.layer.number + 1 for p in plan.layers if not p.around.is_empty]
    parts = []
    if over:
        parts.append(f"printed over in {layers_text(over)}")
    if around:
        clear = plan.order.passing.clear(plan.order.pattern.width)
        highest = max(p.layer.bumps.highest for p in plan.layers if not p.around.is_empty)
        text = f"avoided with a clearance of {clear:.2f} mm in {layers_text(around)}"
        parts.append(f"{text}, height up to {highest:.2f} mm over the layer")
    return "; ".join(parts)


@dataclass(frozen=True, slots=True)
class WoundSighting:
    """The wound in one camera's picture, compared with the planned wound."""

    camera: str
    distance: float  # mm between the centroids, across the camera's view; NaN without a wound
    share: float  # smaller area / larger area of the two outlines


def placement_lines(verdict: str, sightings: Sequence[WoundSighting]) -> list[str]:
    """The placement of the scan in a session as lines: verdict of the registration, and each camera's sighting."""
    lines = [f"placement: {verdict}"]
    for sighting in sightings:
        if not np.isfinite(sighting.distance):
            lines.append(f"placement: no wound in the picture of {sighting.camera}")
            continue
        far = sighting.distance > MAX_CENTROID_DISTANCE
        hint = f", more than {MAX_CENTROID_DISTANCE:g} mm: is it the same wound?" if far else ""
        lines.append(
            f"placement: the wound's centre in {sighting.camera} is {sighting.distance:.2f} mm from the plan's{hint}; "
            f"ratio of the areas: {sighting.share:.2f}"
        )
    return lines


def scan_placement(session_path: Path, scan_file: Path, outline: Array) -> tuple[str, list[WoundSighting]]:
    """Register a scan in a session's first pictures, as a live run does: verdict, and sightings if it is registered.

    outline: (N, 3) mm, of the planned wound, scan frame.
    """
    session, pose, placement, frames = register_in_session(session_path, scan_file, outline.mean(axis=0))
    if placement is None or pose is None or frames is None:
        reason = "no frame set in the session" if pose is None else pose.reason or pose.state.value
        return f"not registered: {reason}", []
    return placement.verdict, _sightings(session.rig.cameras, frames, pose.base_from_surface, outline)


def register_in_session(
    session_path: Path, scan_file: Path, middle: Array
) -> tuple[Session, SurfacePose | None, PathPlacement | None, FrameSet | None]:
    """Registration of a scan in a session's first pictures: pose and placement at the last frame set used.

    middle: (3,) mm, of the planned wound, scan frame. No placement without a measured pose.
    """
    from hardware.offline.track import tracker  # loads gtsam and cv2, which a plan alone does not need
    from hardware.recording.session_reader import open_session

    session = open_session(session_path)
    pose, placement, frames = None, None, None
    with tracker(session.rig, session.roi, scan_file) as step:
        for number, frames in enumerate(session.frame_sets()):
            pose = step(frames)
            step.idle()
            if pose.state.measured and step.registration is not None:
                outward = pose.base_from_surface[:3, 2]
                placement = placement_by_scan(step.registration, middle, outward)
            if placement is not None or number + 1 == MAX_FRAME_SETS:
                break
    return session, pose, placement, frames


def _sightings(cameras: Sequence[Camera], frames: FrameSet, pose: Array, outline: Array) -> list[WoundSighting]:
    from perception.wound.network import WoundNetwork, shipped_model
    from perception.wound.segmentation import NetworkSegmenter  # loads onnxruntime

    network = WoundNetwork(shipped_model(), threads=1)
    segmenter = NetworkSegmenter(network, network.settings)
    masks = ((cameras[frame.camera], segmenter(frame.image).mask) for frame in frames.frames)
    return [_sighting(camera, mask, pose, outline) for camera, mask in masks]


def _sighting(camera: Camera, mask: NDArray[np.bool_], pose: Array, outline: Array) -> WoundSighting:
    from perception.lens import undistort
    from perception.wound.segmentation import centroid

    if not mask.any():
        return WoundSighting(camera.name, float("nan"), float("nan"))
    pixels, depth = ideal_pixels(camera, se3.transform_points(pose, outline))
    area, middle = _area_and_centroid(pixels)
    distance = np.linalg.norm(undistort(camera, centroid(mask)[None])[0] - middle)
    scale = float(depth.mean()) / float(camera.matrix[0, 0])  # mm per px
    areas = sorted([area, float(mask.sum())])
    return WoundSighting(camera.name, float(distance) * scale, areas[0] / max(areas[1], 1e-9))


def _area_and_centroid(ring: Array) -> tuple[float, Array]:
    """Area and centroid (2,) inside a ring (N, 2)."""
    (x, y), (u, v) = ring.T, np.roll(ring, -1, axis=0).T
    cross = x * v - u * y
    area = float(cross.sum()) / 2
    return abs(area), np.array([(x + u) @ cross, (y + v) @ cross]) / (6 * area)
