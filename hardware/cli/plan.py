"""`stillbed plan`, `reach`, `segment` and `train`: planning and the wound network. Imports lazily."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from estimation.errors import InputError, StillbedError
from hardware.cli.parser import (
    FAILED,
    MODEL_HELP,
    ROI_HELP,
    Commands,
    damage_code,
    not_negative,
    option_error,
    positive,
)
from perception import named_path

if TYPE_CHECKING:
    from hardware.live.settings import LiveSettings
    from perception.wound.segmentation import Segmenter

PLAN_TEXT = """\
Plan the print of a wound. SCAN is a mesh (.ply, .stl, .obj, .off, .gltf, .glb) or a cloud of points (.ply, .pcd,
.xyz) of the wound with skin around it, or a flat contour (.csv with x_mm,y_mm) for one layer. Steps: repair the mesh;
find the wound, a depression in the skin; interpolate the healthy skin over it; divide the volume into layers; fill
each layer with beads; plan the tool's motion along them.

Writes PATH.csv (atomically), PATH_layers.csv and PATH.json (coverage, lengths, times, volumes), PATH_scan.ply (the
repaired scan), PATH_layers/ (a picture of each layer) and PATH.html (a report with a 3D view; needs no network).
The path is in the scan's frame: it needs no further registration for a session whose surface.ply is the same
scan."""

PLAN_EXAMPLES = (
    "stillbed plan --example forearm -o out/path.csv",
    "stillbed plan wound.stl -o out/path.csv --material collagen --pattern contour --bead 0.4",
    "stillbed plan wound.ply -o out/path.csv --unit m --layers conformal \\\n"
    "      --tissue hypodermis=rest:adipose:37 --tissue dermis=1.5:collagen:20:12 --tissue epidermis=0.3:keratinocytes",
    "stillbed plan contour.csv -o out/path.csv --bead 0.8 --pattern zigzag --angle shorter --gcode out/path.gcode",
)

UNET_METHOD, SHAPE_METHOD = "unet", "shape"


def add_plan(commands: Commands) -> None:
    """Add the sub-command `plan`."""
    summary = "plan the print of a scanned wound: layers, beads, checkpoints"
    command = commands.add("plan", _run_plan, summary, PLAN_TEXT, *PLAN_EXAMPLES)
    add = command.add_argument
    add("scan", type=Path, nargs="?", metavar="SCAN", help="mesh or point cloud of the wound, or contour")
    add("-o", "--out", type=Path, required=True, metavar="PATH.csv", help="output file of the path")
    add("--example", choices=("forearm", "chest", "foot"), help="built-in scan instead of SCAN; it is also written")
    add("--gcode", type=Path, metavar="FILE", help="also write the path as plain G-code text")
    add(
        "--session", type=Path, metavar="SESSION",
        help="also register the scan to this session's first pictures, and print how well it fits the wound there",
    )  # fmt: skip
    add(
        "--arm", type=named_path, metavar="ARM.toml",
        help="keep this arm's tool clear of the tissue: tilt it, or omit beads; check its joints and add the "
        "column `feasible`, as `stillbed reach` does",
    )  # fmt: skip
    motion = "measure --amplitude-mm from a recording, a folder of `stillbed track`, or a trajectory of the surface"
    add("--motion", metavar="SESSION", help=motion)
    add("--no-pictures", action="store_true", help="do not write pictures and report")
    add("--force", action="store_true", help="overwrite PATH.csv and the other output files")
    _add_scan(command)
    _add_layers(command)
    _add_pattern(command)
    _add_tool_motion(command)


def _add_scan(command: argparse.ArgumentParser) -> None:
    add = command.add_argument_group("the scan").add_argument
    add("--unit", choices=("mm", "cm", "m", "inch"), default="mm", help="unit of SCAN; default mm")
    add("--flip", action="store_true", help="reverse the normals of SCAN, if they point inwards")
    outline = "outline of the wound, x_mm,y_mm[,z_mm] in SCAN's frame; default: automatic"
    add("--outline", type=Path, metavar="CSV", help=outline)
    clicks = "three or more points on the wound's rim, in SCAN's frame, mm, instead of an outline"
    add("--clicks", metavar="X,Y,Z/X,Y,Z/X,Y,Z", help=clicks)
    add("--wound", type=int, metavar="N", help="number of the wound in PATH_question.html")


def _add_layers(command: argparse.ArgumentParser) -> None:
    add = command.add_argument_group("layers").add_argument
    add(
        "--layers", choices=("skin", "conformal", "horizontal"), default="skin",
        help="skin: parallel to the restored skin; conformal: blended from bed to skin; horizontal: flat (thesis); "
        "default skin",
    )  # fmt: skip
    add(
        "--tissue", action="append", default=[], metavar="NAME=THICKNESS:MATERIAL[:TEMPERATURE[:SPEED[:HEIGHT]]]",
        help="tissue, repeatable, from the bottom: mm (or 'rest'), degrees C, mm/s, mm; "
        "default hypodermis=rest, dermis=1.6, epidermis=0.4",
    )  # fmt: skip
    add("--material", default="1,2,3", metavar="M[,M,M]", help="material, or one per default tissue; default 1,2,3")
    add("--layer-height", type=float, metavar="MM", help="approximate height; default: the bead's width")
    add(
        "--bump", type=float, metavar="MM",
        help="print over bumps of the bed up to this height above a layer; avoid higher ones; default: half "
        "a layer, which leaves room for the next layer",
    )  # fmt: skip
    add(
        "--bump-clearance", type=float, metavar="MM",
        help="distance from avoided bumps; default: half a bead, for the needle's outside",
    )  # fmt: skip
    add("--temperature", type=float, default=20.0, metavar="C", help="temperature, degrees C; default 20")


def _add_pattern(command: argparse.ArgumentParser) -> None:
    add = command.add_argument_group("pattern").add_argument
    add(
        "--pattern", choices=("zigzag", "raster", "contour", "spiral", "hybrid", "best"), default="contour",
        help="contour: closed lines, no gaps; zigzag, raster: straight lines, the fastest to plan; hybrid: "
        "rims around a zigzag; spiral: closed lines joined; best: the faster of contour and spiral; default contour",
    )  # fmt: skip
    add(
        "--angle", default="fastest", metavar="DEG",
        help="angle of the lines; shorter: of 0 and 90; fastest: of 12, both for the largest layer; "
        "default fastest",
    )  # fmt: skip
    add("--parallel", action="store_true", help="same direction in all layers, instead of crossed in turn")
    add("--bead", type=float, default=0.4, metavar="MM", help="bead width; default 0.4")
    add("--overlap-percent", type=float, default=0.0, metavar="P", help="overlap of adjacent beads; default 0")
    add("--inset", type=float, default=0.0, metavar="MM", help="margin along the wound's rim; default 0")
    add("--rims", type=int, default=1, metavar="N", help="closed lines of the hybrid pattern; default 1")


def _add_tool_motion(command: argparse.ArgumentParser) -> None:
    add = command.add_argument_group("tool motion").add_argument
    for name, default, metavar, text in (
        ("--speed", 20.0, "MM/S", "printing speed"),
        ("--travel", 60.0, "MM/S", "speed between beads"),
        ("--lift", 2.0, "MM", "lift between beads, along the tool"),
        ("--wait", 0.0, "S", "pause before each further layer, with the tool lifted"),
        ("--spacing", 1.0, "MM", "distance of checkpoints: shortest length that the ink can bridge"),
        ("--chord", 0.02, "MM", "maximum deviation of segments from curves"),
        ("--sideways", 200.0, "MM/S2", "maximum lateral acceleration; limits the speed in bends"),
        ("--tilt-deg", 30.0, "DEG", "maximum tilt of the tool from the plane's normal"),
        ("--turning-deg-mm", 5.0, "DEG/MM", "maximum rotation of the tool per mm"),
        ("--spin-deg", 0.0, "DEG", "tool angle about its own axis; any value for a round nozzle"),
        (
            "--amplitude-mm",
            0.0,
            "MM",
            "amplitude of the tissue's motion, added to the clearance of --arm's tool, 0.5 mm",
        ),
    ):
        add(name, type=float, default=default, metavar=metavar, help=f"{text}; default {default:g}")


def _run_plan(a: argparse.Namespace) -> int:
    from dataclasses import fields

    from hardware.plan.order import PlanRequest, PlanSettings
    from hardware.plan.run import run_plan

    values = {f.name: getattr(a, f.name) for f in fields(PlanSettings) if f.name != "tissues"}
    settings = PlanSettings(tissues=tuple(a.tissue), **values)
    sources = a.out, a.scan, a.example, a.outline, a.unit, a.flip, a.gcode, a.session
    request = PlanRequest(
        *sources, not a.no_pictures, a.force, a.arm, clicks=a.clicks, wound=a.wound, motion=a.motion, settings=settings
    )
    text, damage = run_plan(request)
    print(text)
    return damage_code(damage)


def add_reach(commands: Commands) -> None:
    """Add the sub-command `reach`."""
    add = commands.add(
        "reach",
        _run_reach,
        "check, before printing, if an arm can print a path",
        "Check each checkpoint of a path with the arm's kinematics: reach, joint ranges, joint speeds,\n"
        "singularities, on the surface at rest and in motion. Prints a table. With -o, writes path.csv (the path with\n"
        "the column `feasible`), reach.csv (joint angles and clearances of each checkpoint) and reach.html.\n"
        "Exit code: 0 if all checkpoints are feasible, 1 if not.",
        "stillbed reach data/paths/wound_raster.csv --arm data/arms/s6h4d.toml --amplitude-mm 10",
    ).add_argument
    add("path", type=named_path, metavar="PATH.csv", help="checkpoints on the surface")
    add("--arm", type=named_path, required=True, metavar="ARM.toml", help="arm file with a table [kinematics]")
    surface_help = (
        "pose of the surface at rest, in the arm's frame, mm and degrees; default: level, under the default home"
    )
    add("--surface", type=_six_numbers, metavar="X,Y,Z,A,B,C", help=surface_help)
    add("--amplitude-mm", type=not_negative, default=0.0, metavar="MM", help="motion amplitude along the normal")
    add("--turn-deg", type=not_negative, default=0.0, metavar="DEG", help="motion amplitude about x, y and z")
    add("--rate-hz", type=not_negative, default=0.25, metavar="HZ", help="frequency of the motion; default 0.25")
    scan_help = "obstacle for the tool, a scan in the path's frame; default: PATH_scan.ply, if it exists"
    add("--scan", type=named_path, metavar="SCAN", help=scan_help)
    add("--spin", action="store_true", help="allow rotation of the tool about its own axis")
    add("-o", "--out", type=Path, metavar="OUT", help="output folder, new or empty")
    add("--force", action="store_true", help="write into a folder that is not empty")


def _six_numbers(text: str) -> tuple[float, ...]:
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != 6:
        raise argparse.ArgumentTypeError(f"{text!r}, needed are 6 numbers: X,Y,Z,A,B,C")
    return values


def _run_reach(a: argparse.Namespace) -> int:
    from hardware.offline.reach import ReachQuestion, run_reach

    request = ReachQuestion(a.surface, a.amplitude_mm, a.turn_deg, a.rate_hz, a.spin, a.scan)
    result = run_reach(a.path, a.arm, request, a.out, a.force)
    print(result.text)
    return 0 if result.feasible else FAILED


def add_segment(commands: Commands) -> None:
    """Add the sub-command `segment`."""
    add = commands.add(
        "segment",
        _run_segment,
        "segment the wound in pictures, a video or a session",
        "Segment the wound in pictures, folders of pictures, videos or sessions. Writes a PNG mask (0 or 255) of each\n"
        "picture, with its size and name, and wounds.csv: confidence, area, centroid, box and time. The mask of a\n"
        "picture without a wound is empty. If two or more calibrated cameras of a session see the whole wound, prints\n"
        "its area in mm^2 with a 95 % interval, and writes areas.csv, the area at nine instants. Ctrl-C keeps the\n"
        "results so far.",
        "stillbed segment photos/ -o masks --overlay",
        "stillbed segment try.mcap -o masks",
        "stillbed segment ward.mp4 -o masks --method shape",
    ).add_argument
    add("inputs", type=Path, nargs="+", metavar="INPUT", help="picture, folder of pictures, video, or SESSION")
    add("-o", "--out", type=Path, required=True, metavar="MASKS", help="output folder, new or empty")
    method_help = "unet: trained network; shape: matching of outlines"
    add("--method", choices=(UNET_METHOD, SHAPE_METHOD), default=UNET_METHOD, help=method_help)
    add("--model", type=Path, metavar="X.onnx", help=MODEL_HELP)
    add("--version", action=_NetworkVersion, nargs=0, help="print name, licence and source of the network, and exit")
    add("--scan", type=Path, metavar="SCAN", help="with --method shape: scan of the wound, z upwards")
    add("--overlay", action="store_true", help="also write the pictures with outlines")
    add("--mm-per-px", type=float, metavar="S", help="scale at the wound, for the areas in wounds.csv")
    add("--threads", type=int, default=2, metavar="N", help="threads of the network; they do not change results")
    add("--force", action="store_true", help="write into a folder that is not empty")


class _NetworkVersion(argparse.Action):
    """Prints the terms of the network: the shipped one, or that of a preceding --model."""

    def __call__(self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, *_: object) -> None:
        from perception.wound.network import WoundNetwork, shipped_model

        model = getattr(namespace, "model", None)
        try:
            print(WoundNetwork(shipped_model() if model is None else model).terms)
        except StillbedError as error:
            parser.error(str(error))
        parser.exit()


def add_train(commands: Commands) -> None:
    """Add the sub-command `train`."""
    add = commands.add(
        "train",
        _run_train,
        "train the wound network on labelled pictures",
        "Train the wound network. Each DATASET contains images/ and labels/, a mask of the same name and\n"
        "size for each picture. The pictures of the first are grouped by wound and divided into folds. For each\n"
        "fold, a network is trained without it: cross-validation, which also sets the thresholds. The written\n"
        "network is trained with all pictures.\n"
        "Writes X.onnx, X.toml (hash and settings), X.md (model card), X_curves.png, X_reliability.png and\n"
        "X_trained.txt (list of the training pictures); an interrupted training continues from X_PART.ckpt.\n"
        "Six networks take hours on a processor, or minutes on a large GPU.\n"
        "Needs the extra [train]: pip install 'stillbed[train]'.",
        "stillbed train data/fuseg data/medetec -o wound.onnx",
        "stillbed train data/fuseg -o ward.onnx --add monday.mcap tuesday.mcap",
        "stillbed train data/fuseg data/medetec -o wound.onnx --part 0",
    ).add_argument
    add("datasets", type=Path, nargs="+", metavar="DATASET", help="data sets; cross-validation uses the first")
    add("-o", "--out", type=Path, required=True, metavar="X.onnx", help="output file")
    add_help = "recordings of live runs: adds the pictures with outlines corrected by an operator to the first data set"
    add("--add", type=Path, nargs="+", default=[], metavar="RECORDING", help=add_help)
    network_help = "thesis: U-Net of section 3.3; shape: no network, the outlines for segment --method shape (X.toml)"
    add("--network", choices=("wound", "thesis", "shape"), default="wound", help=network_help)
    add("--rounds", type=int, metavar="N", help="training rounds of 200 steps (thesis: 100)")
    add("--rendered", type=int, default=140, metavar="N", help="number of rendered pictures to add")
    add("--folds", type=int, default=5, metavar="N", help="folds of the first data set")
    part_help = "train only one network, without fold 0, 1, ... or `all`, and stop: for several processes"
    add("--part", metavar="PART", help=part_help)
    add("--device", choices=("cpu", "cuda"), help="default: cuda if torch has a GPU; results differ")
    add("--licence", metavar="TEXT", help="licence of the network, written to X.toml")
    add("--source", metavar="TEXT", help="source of the pictures, written to X.toml")
    add("--threads", type=int, default=1, metavar="N", help="threads of torch")
    add("--seed", type=int, default=1, metavar="N", help="seed of the weights and of all random numbers")
    add("--force", action="store_true", help="overwrite X.onnx; continue from checkpoints of the same training")


def _run_segment(a: argparse.Namespace) -> int:
    from hardware.offline.segment import SegmentOptions, run_segment

    if a.mm_per_px is not None and not 0 < a.mm_per_px < 100:
        raise option_error("--mm-per-px", a.mm_per_px, "above 0 and below 100")
    if not 1 <= a.threads <= 64:
        raise option_error("--threads", a.threads, "1 to 64")
    if a.method == SHAPE_METHOD and a.model is not None:
        raise option_error("--model", a.model, "nothing with --method shape, which has no network")
    if a.method == UNET_METHOD and a.scan is not None:
        raise option_error("--scan", a.scan, "a scan only with --method shape")
    segmenter = _segmenter(a)
    text, damage = run_segment(a.inputs, a.out, segmenter, SegmentOptions(a.overlay, a.mm_per_px, a.force))
    print(text)
    return damage_code(damage)


def _segmenter(a: argparse.Namespace) -> Segmenter:
    """The segmenter of the method. A scan gives the outline, and with a known scale also its size."""
    from hardware.files.mesh_file import read_mesh
    from perception.wound.network import WoundNetwork, shipped_model
    from perception.wound.segmentation import NetworkSegmenter
    from perception.wound.shape_matching import ShapeSegmenter, read_shape_model, scan_outline

    if a.method == UNET_METHOD:
        network = WoundNetwork(shipped_model() if a.model is None else a.model, a.threads)
        return NetworkSegmenter(network, network.settings)
    pattern, area = None, None
    if a.scan is not None:
        pattern, outline_area = scan_outline(read_mesh(a.scan))
        area = None if a.mm_per_px is None else outline_area / a.mm_per_px**2
    return ShapeSegmenter(read_shape_model(shipped_model("shape", ".toml")), pattern, area)


def _run_train(arguments: argparse.Namespace) -> None:
    from hardware.offline.train import run_train
    from hardware.simulator.scene.render import wound_view

    print(run_train(arguments, wound_view))


def add_scan(commands: Commands) -> None:
    """Add the sub-command `scan`."""
    add = commands.add(
        "scan",
        _run_scan,
        "scan the surface with the calibrated cameras",
        "Scan the surface with the calibrated cameras: track it for some seconds; fuse the pictures of some instants\n"
        "to a mesh with a colour and a standard deviation per vertex, in the surface frame of that session. Parts\n"
        "without agreement of two cameras remain open. X.html shows it from three sides, the coverage and accuracy\n"
        "of the region, and the best place for another camera. Ctrl-C ends the tracking early and fuses.",
        "stillbed scan rig.toml -o wound.ply",
        "stillbed scan try.mcap -o wound.ply --sets 12",
        "stillbed scan data/scenarios/breathing_calm.toml -o wound.ply",
    ).add_argument
    source_help = "rig.toml or session.toml of live cameras, scenario.toml, session folder or .mcap file"
    add("source", type=named_path, metavar="RIG_OR_SESSION", help=source_help)
    add("-o", "--out", type=Path, required=True, metavar="X.ply", help="output file; X.html beside it")
    add("--sets", type=int, default=6, metavar="N", help="number of fused instants, 2 to 40; default 6")
    add("--seconds", type=positive, default=4.0, metavar="S", help="tracking time; default 4, a breath")
    add("--region", type=Path, metavar="FILE.toml", help=ROI_HELP)
    add("--force", action="store_true", help="overwrite the files")


def _run_scan(a: argparse.Namespace) -> None:
    from hardware.files.region_table import ANY_REGION, read_region
    from hardware.live.surface_scan import ScanOrder, run_scan

    region = ANY_REGION if a.region is None else read_region(a.region)
    print(run_scan(ScanOrder(a.source, a.out, a.sets, a.seconds, region, a.force)))


def scanned_settings(settings: LiveSettings, where: object, force: bool) -> LiveSettings:
    """The settings of a run with "from the cameras", completed by a scan made now and a path planned on it.

    Both are written beside the recording. A missing path is planned with the defaults of `plan`; at a terminal the
    operator confirms it. InputError for wrong settings, StillbedError if it is not confirmed.
    """
    from dataclasses import replace

    from hardware.live.settings import FROM_CAMERAS, check_settings
    from hardware.live.surface_scan import ScanOrder, run_scan
    from hardware.plan.order import PlanRequest
    from hardware.plan.run import run_plan

    if settings.scan is None or settings.scan.name != FROM_CAMERAS:
        return settings
    source, record = settings.simulated or settings.rig, settings.record
    check_settings(replace(settings, scan=None, path=settings.path or source), where)
    assert source is not None and record is not None
    if record.exists() and not force:
        raise InputError(record, "--record", "a file that exists", "a new file, or --force")
    scan, path = (record.with_name(f"{record.stem}_{name}") for name in ("scan.ply", "path.csv"))
    print(run_scan(ScanOrder(source, scan, region=settings.region, force=True)), flush=True)
    if settings.path is not None:
        return replace(settings, scan=scan)
    print(run_plan(PlanRequest(path, scan, force=True))[0], flush=True)
    if not settings.unattended and sys.stdin.isatty():
        answer = input(f"The layers are in {path.with_suffix('.html')}. Print them? yes or no: ")
        if answer.strip().lower() not in ("y", "yes"):
            raise StillbedError(f"not confirmed. The plan is kept: {path}, on {scan}")
    return replace(settings, scan=scan, path=path)
