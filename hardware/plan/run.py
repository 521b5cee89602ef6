"""`stillbed plan`: a scan or a contour in; path, G-code, pictures, report and figures out."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array
from hardware.contour_file import read_contour
from hardware.files.mesh_file import read_raw_mesh
from hardware.files.path_file import write_path
from hardware.gcode_file import gcode_text
from hardware.offline.reach import with_feasible
from hardware.plan.findings import NOT_ASKED, bump_facts, bumps_text, bumpy, findings_rows, notes_of
from hardware.plan.layer_picture import bounds_of, layer_svg, len_text
from hardware.plan.order import Wishes, check_out, order_of
from hardware.plan.page import Story, material_text, page_text
from hardware.ply_file import write_ply
from hardware.process.clock import WallClock
from hardware.process.progress import Progress, counted, duration
from hardware.scan_units import in_mm
from planning.layers.figures import LayerFigures, Total, figures_of, total_of
from planning.layers.flat_wound import flat_wound
from planning.layers.plan import Plan, make_plan
from planning.layers.repair import Repairs, repaired
from planning.layers.wound import Wound, wound_in
from planning.path import check_path

Index = NDArray[np.int64]
GRID = 0.6  # of a bead between nodes of the wound's grid: finer changes no layer's area by a thousandth
FINEST, COARSEST = 0.1, 0.5  # mm
EXAMPLE_STEP = 0.75  # mm between the vertices of an example scan, as of a handheld scanner
EXAMPLE_SIZE, EXAMPLE_DEPTH, EXAMPLE_SEED = (42.0, 31.0), 3.5, 1  # mm
LAYER_COLUMNS = (
    "layer", "tissue", "material", "area_mm2", "covered", "double", "over", "gap_mm2", "gap_over_half_a_bead_mm2",
    "gap_over_a_bead_mm2", "runs", "checkpoints", "printed_mm", "travelled_mm", "time_s", "volume_mm3",
)  # fmt: skip
REPAIRED_STEP = 0.5  # mm between the vertices of the repaired scan that is written


@dataclass(frozen=True, slots=True)
class Request:
    """What is to be planned and written. scan: mesh or contour; example: a built-in body instead.

    outline: of the wound on the scan. unit: of the scan's numbers. flip: it was scanned inside out. session: in whose
    pictures the scan is to be found. arm: whose joints are asked about each checkpoint.
    """

    out: Path
    scan: Path | None = None
    example: str | None = None
    outline: Path | None = None
    unit: str = "mm"
    flip: bool = False
    gcode: Path | None = None
    session: Path | None = None
    pictures: bool = True
    force: bool = False
    arm: Path | None = None
    wishes: Wishes = field(default_factory=Wishes)


@dataclass(frozen=True, slots=True, eq=False)
class Subject:
    """The wound to be planned, and what was done to its scan; None where there is none.

    example: a built-in scan, as vertices and triangles, to be written beside the path.
    """

    name: str
    wound: Wound
    repairs: Repairs | None
    example: tuple[Array, Index] | None = None


def run_plan(request: Request) -> str:
    """Plan and write; what it came to, in words. The path is whole before anything beside it is begun."""
    flat = request.scan is not None and request.scan.suffix.lower() == ".csv"
    order = order_of(request.wishes, flat)
    if request.session is not None:
        _check_session(request.session, flat)
    check_out(request.out, request.gcode, request.force)
    subject = _subject(request, flat)
    with _progress("plan", "layers") as progress:
        plan = make_plan(subject.wound, order, subject.name, progress)
    path, arm = (plan.path, NOT_ASKED) if request.arm is None else with_feasible(plan.path, request.arm)
    check_path(path)
    _whole(request.out, lambda file: write_path(file, path))
    if request.gcode is not None:
        _whole(request.gcode, lambda file: file.write_text(gcode_text(plan.path), encoding="utf-8"))
    with _progress("measure", "layers") as progress:
        layers = figures_of(plan, progress)
    total = total_of(layers)
    written = [request.out.name, *_tables(request, plan, subject, layers, total, arm)]
    if request.pictures:
        written += _pictures(request, plan, subject, layers, total, arm)
    placed = [] if request.session is None else _placed(request.session, request.out, plan)
    return "\n".join([_told(plan, subject, total, request.out, written), arm, *placed])


def planned_scan(vertices: Array, triangles: Index, step: float, where: object, flip: bool = False) -> Subject:
    """The wound in a mesh, vertices (V, 3) mm, triangles (T, 3), that may be damaged."""
    scan, repairs = repaired(vertices, triangles, where, flip)
    return Subject(str(where), wound_in(scan, step, where, flipped=flip), repairs)


def _subject(request: Request, flat: bool) -> Subject:
    step = float(np.clip(GRID * request.wishes.bead, FINEST, COARSEST))
    if request.example is not None and request.scan is not None:
        raise InputError("command line", "SCAN", request.scan, "none beside --example")
    if request.example is not None:
        vertices, triangles = example_scan(request.example)
        found = planned_scan(vertices, triangles, step, f"{request.example} (example)")
        return replace(found, example=(vertices, triangles))
    if request.scan is None:
        raise InputError("command line", "SCAN", "none", "a mesh, a contour, or --example forearm, chest or foot")
    if flat:
        height = request.wishes.layer_height or request.wishes.bead
        contour = read_contour(request.scan)
        if contour.shape[1] != 2:
            raise InputError(request.scan, "header", "x_mm,y_mm,z_mm", "x_mm,y_mm: a flat contour")
        return Subject(request.scan.name, flat_wound(contour, height, request.scan), None)
    raw = read_raw_mesh(request.scan)
    vertices = in_mm(raw.vertices, raw.triangles, request.unit, request.scan)
    scan, repairs = repaired(vertices, raw.triangles, request.scan, request.flip)
    outline = None if request.outline is None else _outline(request.outline, scan.vertices)
    return Subject(request.scan.name, wound_in(scan, step, request.scan, outline, request.flip), repairs)


def _outline(file: Path, vertices: Array) -> Array:
    """An outline (N, 3), mm; without z it is laid on the scan as seen along the scan's z."""
    points = read_contour(file)
    if points.shape[1] == 3:
        return points
    near = [int(np.argmin(np.sum((vertices[:, :2] - point) ** 2, axis=1))) for point in points]
    return np.column_stack([points, vertices[near, 2]])


def example_scan(kind: str) -> tuple[Array, Index]:
    """A scan of a built-in body with a wound: vertices (V, 3) mm and triangles (T, 3)."""
    from hardware.simulator.bodies import Wound as Carved
    from hardware.simulator.bodies import body

    return body(kind, Carved(EXAMPLE_SIZE, EXAMPLE_DEPTH), EXAMPLE_SEED).mesh(EXAMPLE_STEP)


def _whole(file: Path, write: Callable[[Path], object]) -> None:
    """Write a file under another name first: whoever sees it sees all of it."""
    part = file.with_name(file.name + ".part")
    try:
        write(part)
        os.replace(part, file)
    finally:
        part.unlink(missing_ok=True)


def _tables(
    request: Request, plan: Plan, subject: Subject, layers: Sequence[LayerFigures], total: Total, arm: str
) -> list[str]:  # fmt: skip
    """Write the coverage of each layer, the summary, the scan as it was repaired, and an example's; their names."""
    stem = request.out.with_suffix("")
    table, summary = stem.with_name(stem.name + "_layers.csv"), stem.with_suffix(".json")
    _whole(table, lambda file: _write_layers(file, layers))
    facts = {
        "checkpoints": len(plan.path), "mode": plan.order.mode, "missing_tissues": plan.stack.missing,
        "wound": asdict(plan.wound.findings), "total": asdict(total),
        "repairs": None if subject.repairs is None else asdict(subject.repairs), "settings": asdict(request.wishes),
        "bumps": bump_facts(plan), "feasible": arm,
        "surface_from_plane": plan.wound.surface_from_plane.tolist(),
    }  # fmt: skip
    _whole(summary, lambda file: file.write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8"))
    if subject.repairs is None:
        return [table.name, summary.name]
    mesh = stem.with_name(stem.name + "_scan.ply")
    _whole(mesh, lambda file: write_ply(file, *_surface(plan.wound)))
    if subject.example is None:
        return [table.name, summary.name, mesh.name]
    example, built_in = stem.with_name(stem.name + "_example.ply"), subject.example
    _whole(example, lambda file: write_ply(file, *built_in))
    return [table.name, summary.name, mesh.name, example.name]


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


def _surface(wound: Wound) -> tuple[Array, Index]:
    """The scan around the wound as it was used, its holes closed: vertices (V, 3) mm, scan frame, triangles (T, 3)."""
    every = max(1, round(REPAIRED_STEP / wound.grid.step))
    nodes = np.dstack([wound.grid.nodes, wound.bed])[::every, ::every]
    number = np.arange(nodes.shape[0] * nodes.shape[1]).reshape(nodes.shape[:2])
    a, b, c, d = (m.ravel() for m in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    triangles = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    return se3.transform_points(wound.surface_from_plane, nodes.reshape(-1, 3)), triangles


def _pictures(
    request: Request, plan: Plan, subject: Subject, layers: Sequence[LayerFigures], total: Total, arm: str
) -> list[str]:  # fmt: skip
    """Write a picture of each layer and the report; their names."""
    stem = request.out.with_suffix("")
    folder, report = stem.with_name(stem.name + "_layers"), stem.with_suffix(".html")
    folder.mkdir(exist_ok=True)
    bounds = bounds_of(plan.layers)
    drawn = []
    with _progress("draw", "layers") as progress:
        for i, figures in enumerate(layers):
            drawn.append(layer_svg(plan.layers[figures.number], figures, bounds))
            name = f"layer_{figures.number + 1:03d}.svg"
            (folder / name).write_text(drawn[-1], encoding="utf-8")
            progress(i + 1, len(layers))
    repairs = [] if subject.repairs is None else subject.repairs.rows()
    findings = [*findings_rows(plan), ("what an arm can print", arm)]
    story = Story(subject.name, findings, repairs, request.wishes.rows(), notes_of(plan))
    _whole(report, lambda file: file.write_text(page_text(plan, layers, total, story, drawn), encoding="utf-8"))
    return [f"{folder.name}/ ({len(drawn)} pictures)", report.name]


def _told(plan: Plan, subject: Subject, total: Total, out: Path, written: Sequence[str]) -> str:
    f = plan.wound.findings
    lines = [
        f"wound: {f.area:.0f} mm^2, up to {f.depth:.2f} mm deep, {f.volume:.0f} mm^3"
        + ("" if f.given else f"; outline found where the scan is {f.level:.2f} mm deep"),
        f"path: {counted(sum(bool(layer.beads) for layer in plan.layers), 'layer')}, {len(plan.path)} checkpoints, "
        f"{len_text(total.printed)} of bead, {len_text(total.travelled)} of travel, {duration(total.seconds)}",
        f"coverage: {total.covered:.2%} covered, {total.double:.2%} twice, {total.over:.2%} beside, "
        f"{total.gap:.2f} mm^2 open",
        "ink: " + ", ".join(f"{volume / 1000:.3f} ml of {material_text(name)}" for name, volume in total.volume),
    ]
    lines += [f"bumps: {bumps_text(plan)}"] if bumpy(plan) else []
    done = [] if subject.repairs is None else [f"{what} ({n})" for what, n in subject.repairs.rows()[2:] if n]
    if done:
        lines.append("scan: " + ", ".join(done))
    lines += [f"note: {note}" for note in notes_of(plan)]
    return "\n".join([*lines, f"in {out.parent}: {', '.join(written)}"])


def _check_session(session: Path, flat: bool) -> None:
    from hardware.files.session import open_session

    if flat:
        raise InputError("command line", "--session", session, "nothing with a contour: it has no shape to be found by")
    open_session(session)  # what is wrong with it is told before anything is written


def _placed(session: Path, out: Path, plan: Plan) -> list[str]:
    """Where the scan lies in a session's pictures, in words."""
    from hardware.plan.placing import placing_in

    ring = plan.wound.rim
    return placing_in(session, out.with_name(f"{out.stem}_scan.ply"), ring).lines()


def _progress(what: str, unit: str) -> Progress:
    return Progress(what, unit, WallClock().now)
