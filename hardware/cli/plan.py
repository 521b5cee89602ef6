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
    positive,
    wrong_option,
)
from perception import named_path

if TYPE_CHECKING:
    from hardware.live.settings import LiveSettings
    from perception.wound.segmentation import Segmenter

PLAN_TEXT = """\
Plan the print of a wound. SCAN is a mesh (.ply, .stl, .obj, .off, .gltf, .glb) or a cloud of points (.ply, .pcd,
.xyz) of the wound with skin around it, or a flat contour (.csv with x_mm,y_mm): one layer. The mesh is repaired, the
wound found as the depression in the skin, the healthy skin interpolated over it, the volume between cut into layers,
each filled with beads, and the tool led over them.

Writes PATH.csv, whole or not at all, and beside it PATH_layers.csv and PATH.json (coverage, lengths, times, volumes),
PATH_scan.ply (the scan as repaired), PATH_layers/ (a picture of each layer) and PATH.html (a report with a view in
three dimensions, without a network). The path is in the scan's frame: a session whose surface.ply is the same scan
is printed with it as it stands."""

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
    add("scan", type=Path, nargs="?", metavar="SCAN", help="mesh or points of the wound, or contour")
    add("-o", "--out", type=Path, required=True, metavar="PATH.csv", help="path to write")
    add("--example", choices=("forearm", "chest", "foot"), help="a built-in scan instead of SCAN; also written")
    add("--gcode", type=Path, metavar="FILE", help="also write the path as plain G-code text")
    add(
        "--session", type=Path, metavar="SESSION",
        help="also lay the scan into this session's first pictures, and say how well it fits the wound they show",
    )  # fmt: skip
    add(
        "--arm", type=named_path, metavar="ARM.toml",
        help="keep this arm's tool clear of the tissue, turning it or leaving beads out; and ask its joints about each "
        "checkpoint, for the column `feasible`, which `stillbed reach` adds without it",
    )  # fmt: skip
    motion = "measure --amplitude-mm: a recording, a folder of `stillbed track`, or a trajectory of the surface"
    add("--motion", metavar="SESSION", help=motion)
    add("--no-pictures", action="store_true", help="write neither pictures nor the report")
    add("--force", action="store_true", help="overwrite PATH.csv and what stands beside it")
    _add_scan(command)
    _add_layers(command)
    _add_pattern(command)
    _add_way(command)


def _add_scan(command: argparse.ArgumentParser) -> None:
    add = command.add_argument_group("the scan").add_argument
    add("--unit", choices=("mm", "cm", "m", "inch"), default="mm", help="of SCAN's numbers; default mm")
    add("--flip", action="store_true", help="turn SCAN over, whose normals point inwards")
    outline = "outline of the wound, x_mm,y_mm[,z_mm] in SCAN's frame, mm; default: found"
    add("--outline", type=Path, metavar="CSV", help=outline)
    clicks = "three places or more on the wound's rim, in SCAN's frame, mm, instead of an outline"
    add("--clicks", metavar="X,Y,Z/X,Y,Z/X,Y,Z", help=clicks)
    add("--wound", type=int, metavar="N", help="which of the places, where a plan was refused with PATH_question.html")


def _add_layers(command: argparse.ArgumentParser) -> None:
    add = command.add_argument_group("layers").add_argument
    add(
        "--layers", choices=("skin", "conformal", "horizontal"), default="skin",
        help="parallel to the restored skin; from the bed blending into the skin; flat, as the thesis; default skin",
    )  # fmt: skip
    add(
        "--tissue", action="append", default=[], metavar="NAME=THICKNESS:MATERIAL[:TEMPERATURE[:SPEED[:HEIGHT]]]",
        help="bottom up, mm (or 'rest'), degrees C, mm/s, mm of a layer; "
        "default hypodermis=rest, dermis=1.6, epidermis=0.4",
    )  # fmt: skip
    add("--material", default="1,2,3", metavar="M[,M,M]", help="of all, or of each default tissue; default 1,2,3")
    add("--layer-height", type=float, metavar="MM", help="about; default: as wide as a bead")
    add(
        "--bump", type=float, metavar="MM",
        help="bumps of the bed that stand over a layer by this at most are gone over, higher ones round; default half "
        "a layer, so that the layer above still has room over them",
    )  # fmt: skip
    add(
        "--bump-clearance", type=float, metavar="MM",
        help="left free around bumps that are gone round; default half a bead, room for a needle's outside",
    )  # fmt: skip
    add("--temperature", type=float, default=20.0, metavar="C", help="degrees C; default 20")


def _add_pattern(command: argparse.ArgumentParser) -> None:
    add = command.add_argument_group("pattern").add_argument
    add(
        "--pattern", choices=("zigzag", "raster", "contour", "spiral", "hybrid", "best"), default="contour",
        help="contour: closed lines, nothing left open; zigzag, raster: straight lines, the quickest to plan; hybrid: "
        "rims around a zigzag; spiral: closed lines joined; best: the faster of contour and spiral; default contour",
    )  # fmt: skip
    add(
        "--angle", default="fastest", metavar="DEG",
        help="of the lines, or 'shorter' (of 0 and 90) or 'fastest' (of 12), judged on the largest layer; "
        "default fastest",
    )  # fmt: skip
    add("--parallel", action="store_true", help="lines of all layers alike, not every second across")
    add("--bead", type=float, default=0.4, metavar="MM", help="width of a bead; default 0.4")
    add("--overlap-percent", type=float, default=0.0, metavar="P", help="of neighbours; default 0")
    add("--inset", type=float, default=0.0, metavar="MM", help="left free along the rim; default 0")
    add("--rims", type=int, default=1, metavar="N", help="closed lines of hybrid; default 1")


def _add_way(command: argparse.ArgumentParser) -> None:
    add = command.add_argument_group("the tool's way").add_argument
    for name, default, metavar, text in (
        ("--speed", 20.0, "MM/S", "of printing"),
        ("--travel", 60.0, "MM/S", "between beads"),
        ("--lift", 2.0, "MM", "along the tool, for travels"),
        ("--wait", 0.0, "S", "before each further layer, lifted off the last"),
        ("--spacing", 1.0, "MM", "between checkpoints: the shortest length the ink can be laid over"),
        ("--chord", 0.02, "MM", "by which straight ways may depart from curves: where they would, nearer checkpoints"),
        ("--sideways", 200.0, "MM/S2", "acceleration in bends, which are slowed down to it"),
        ("--tilt-deg", 30.0, "DEG", "most the tool leans off the plane's normal"),
        ("--turning-deg-mm", 5.0, "DEG/MM", "most it turns on its way"),
        ("--spin-deg", 0.0, "DEG", "about its own axis, free for a round nozzle"),
        ("--amplitude-mm", 0.0, "MM", "by which the tissue moves, kept free around the tool of --arm beside 0.5 mm"),
    ):
        add(name, type=float, default=default, metavar=metavar, help=f"{text}; default {default:g}")


def _run_plan(a: argparse.Namespace) -> int:
    from dataclasses import fields

    from hardware.plan.order import PlanRequest, PlanSettings
    from hardware.plan.run import run_plan

    values = {f.name: getattr(a, f.name) for f in fields(PlanSettings) if f.name != "tissues"}
    settings = PlanSettings(tissues=tuple(a.tissue), **values)
    source = a.out, a.scan, a.example, a.outline, a.unit, a.flip, a.gcode, a.session
    order = PlanRequest(
        *source, not a.no_pictures, a.force, a.arm, clicks=a.clicks, wound=a.wound, motion=a.motion, settings=settings
    )
    text, damage = run_plan(order)
    print(text)
    return damage_code(damage)


def add_reach(commands: Commands) -> None:
    """Add the sub-command `reach`."""
    add = commands.add(
        "reach",
        _run_reach,
        "check, before printing, that an arm can print a path",
        "Check each checkpoint of a path against the arm's joints: reach, ranges, speeds, singularities,\n"
        "on the surface at rest and wherever it moves to. Prints a table; with -o also writes path.csv (the path with\n"
        "the column `feasible`), reach.csv (joints and distances of each checkpoint) and reach.html (pictures).\n"
        "Exit code 0 where all can be printed, 1 where not.",
        "stillbed reach data/paths/wound_raster.csv --arm data/arms/s6h4d.toml --amplitude-mm 10",
    ).add_argument
    add("path", type=named_path, metavar="PATH.csv", help="checkpoints on the surface")
    add("--arm", type=named_path, required=True, metavar="ARM.toml", help="with a table [kinematics]")
    surface = "the surface at rest in the arm's frame, mm and degrees; default: level, under the default arm's home"
    add("--surface", type=_six_numbers, metavar="X,Y,Z,A,B,C", help=surface)
    add("--amplitude-mm", type=not_negative, default=0.0, metavar="MM", help="of its motion along its normal")
    add("--turn-deg", type=not_negative, default=0.0, metavar="DEG", help="of its motion about x, y and z")
    add("--rate-hz", type=not_negative, default=0.25, metavar="HZ", help="of that motion; default 0.25")
    scan = "that the tool must stay out of, in the path's frame; default: PATH_scan.ply, where plan wrote it"
    add("--scan", type=named_path, metavar="SCAN", help=scan)
    add("--spin", action="store_true", help="let the tool spin about its own axis where that helps")
    add("-o", "--out", type=Path, metavar="OUT", help="folder to write to, new or empty")
    add("--force", action="store_true", help="write into a folder that is not empty")


def _six_numbers(text: str) -> tuple[float, ...]:
    try:
        values = tuple(float(word) for word in text.split(","))
    except ValueError:
        values = ()
    if len(values) != 6:
        raise argparse.ArgumentTypeError(f"{text!r}, needed are 6 numbers: X,Y,Z,A,B,C")
    return values


def _run_reach(a: argparse.Namespace) -> int:
    from hardware.offline.reach import ReachQuestion, run_reach

    question = ReachQuestion(a.surface, a.amplitude_mm, a.turn_deg, a.rate_hz, a.spin, a.scan)
    answer = run_reach(a.path, a.arm, question, a.out, a.force)
    print(answer.text)
    return 0 if answer.feasible else FAILED


def add_segment(commands: Commands) -> None:
    """Add the sub-command `segment`."""
    add = commands.add(
        "segment",
        _run_segment,
        "find the wound in pictures, a video or a session",
        "Find the wound in pictures, folders of pictures, videos or sessions. Writes a PNG mask (0 or 255) of each\n"
        "picture's own size and name, and wounds.csv: confidence, area, centroid, box and time of each. A picture\n"
        "without a wound gets an empty mask. Of a session, where two calibrated cameras or more show the whole wound,\n"
        "it prints the area in mm^2 with a 95 % interval, and areas.csv has it at nine instants. Ctrl-C keeps what\n"
        "is done.",
        "stillbed segment photos/ -o masks --overlay",
        "stillbed segment try.mcap -o masks",
        "stillbed segment ward.mp4 -o masks --method shape",
    ).add_argument
    add("inputs", type=Path, nargs="+", metavar="INPUT", help="picture, folder of pictures, video, or SESSION")
    add("-o", "--out", type=Path, required=True, metavar="MASKS", help="folder, new or empty")
    methods = "unet: a trained network; shape: outlines like the scan's"
    add("--method", choices=(UNET_METHOD, SHAPE_METHOD), default=UNET_METHOD, help=methods)
    add("--model", type=Path, metavar="X.onnx", help=MODEL_HELP)
    add("--version", action=_NetworkVersion, nargs=0, help="print the network's name, licence and source, and exit")
    add("--scan", type=Path, metavar="SCAN", help="with --method shape: of the wound, z upwards")
    add("--overlay", action="store_true", help="also write the pictures with the outlines drawn in")
    add("--mm-per-px", type=float, metavar="S", help="scale at the wound, for areas in wounds.csv")
    add("--threads", type=int, default=2, metavar="N", help="of the network; results do not vary")
    add("--force", action="store_true", help="write into a folder that is not empty")


class _NetworkVersion(argparse.Action):
    """Prints what the network is: the shipped one, or that of a --model that stands before it."""

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
        "Train the wound network. Each DATASET holds images/ and labels/, a mask of the same name and\n"
        "size for each picture. The pictures of the first are grouped by what they show and parted into folds;\n"
        "for each fold a network is trained that never sees it, which judges the recipe and sets the thresholds;\n"
        "the network that is written learns from all.\n"
        "Writes X.onnx, X.toml (hash and settings), X.md (model card), X_curves.png, X_reliability.png and\n"
        "X_trained.txt (the pictures learned from); X_PART.ckpt lets a run that was broken off go on.\n"
        "Six networks take hours of a processor, or minutes of a large GPU.\n"
        "Needs the extra [train]: pip install 'stillbed[train]'.",
        "stillbed train data/fuseg data/medetec -o wound.onnx",
        "stillbed train data/fuseg -o ward.onnx --add monday.mcap tuesday.mcap",
        "stillbed train data/fuseg data/medetec -o wound.onnx --part 0",
    ).add_argument
    add("datasets", type=Path, nargs="+", metavar="DATASET", help="the first is what the recipe is judged by")
    add("-o", "--out", type=Path, required=True, metavar="X.onnx", help="file to write")
    own = "recordings of live runs: pictures whose outline an operator corrected join the first data set"
    add("--add", type=Path, nargs="+", default=[], metavar="RECORDING", help=own)
    networks = "thesis: the U-Net of its 3.3; shape: no network, but what segment --method shape needs, X.toml"
    add("--network", choices=("wound", "thesis", "shape"), default="wound", help=networks)
    add("--rounds", type=int, metavar="N", help="of 200 steps (thesis: 100); more take longer")
    add("--rendered", type=int, default=140, metavar="N", help="rendered pictures to add")
    add("--folds", type=int, default=5, metavar="N", help="that the first data set is parted into")
    only = "train only the network without fold 0, 1, ... or the one of all, and stop: processes can share the work"
    add("--part", metavar="PART", help=only)
    add("--device", choices=("cpu", "cuda"), help="by default cuda where torch sees a GPU; results differ between them")
    add("--licence", metavar="TEXT", help="under which the network may be used, written into X.toml")
    add("--source", metavar="TEXT", help="of its pictures, written into X.toml")
    add("--threads", type=int, default=1, metavar="N", help="of torch")
    add("--seed", type=int, default=1, metavar="N", help="of the weights and of all that is drawn")
    add("--force", action="store_true", help="overwrite X.onnx; checkpoints of the same training are gone on from")


def _run_segment(a: argparse.Namespace) -> int:
    from hardware.offline.segment import SegmentOptions, run_segment

    if a.mm_per_px is not None and not 0 < a.mm_per_px < 100:
        raise wrong_option("--mm-per-px", a.mm_per_px, "above 0 and below 100")
    if not 1 <= a.threads <= 64:
        raise wrong_option("--threads", a.threads, "1 to 64")
    if a.method == SHAPE_METHOD and a.model is not None:
        raise wrong_option("--model", a.model, "nothing with --method shape, which has no network")
    if a.method == UNET_METHOD and a.scan is not None:
        raise wrong_option("--scan", a.scan, "a scan only with --method shape")
    segmenter = _segmenter(a)
    text, damage = run_segment(a.inputs, a.out, segmenter, SegmentOptions(a.overlay, a.mm_per_px, a.force))
    print(text)
    return damage_code(damage)


def _segmenter(a: argparse.Namespace) -> Segmenter:
    """The segmenter of the method. The network is the one that comes along unless another is named; the scan of the
    wound gives its outline, and its size where the scale is known."""
    from hardware.files.mesh_file import read_mesh
    from perception.wound.network import WoundNetwork, shipped_model
    from perception.wound.segmentation import NetworkSegmenter
    from perception.wound.shape_matching import ShapeSegmenter, read_shape_model, scan_outline

    if a.method == UNET_METHOD:
        network = WoundNetwork(shipped_model() if a.model is None else a.model, a.threads)
        return NetworkSegmenter(network, network.settings)
    pattern, area = None, None
    if a.scan is not None:
        pattern, across = scan_outline(read_mesh(a.scan).scan)
        area = None if a.mm_per_px is None else across / a.mm_per_px**2
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
        "scan the surface with the calibrated cameras themselves",
        "Scan the surface with the calibrated cameras: it is tracked for a breath, and pictures of some instants are\n"
        "fused into a mesh with colour and a standard deviation a vertex, in the surface frame of that session. What\n"
        "two cameras do not see alike stays open. X.html beside it shows it from three sides, says how much of the\n"
        "region was seen and how well, and where to put another camera. Ctrl-C fuses what was seen until then.",
        "stillbed scan rig.toml -o wound.ply",
        "stillbed scan try.mcap -o wound.ply --sets 12",
        "stillbed scan data/scenarios/breathing_calm.toml -o wound.ply",
    ).add_argument
    what = "rig.toml or session.toml of live cameras, a scenario.toml, a session folder or an .mcap file"
    add("source", type=named_path, metavar="RIG_OR_SESSION", help=what)
    add("-o", "--out", type=Path, required=True, metavar="X.ply", help="file to write, with X.html beside it")
    add("--sets", type=int, default=6, metavar="N", help="instants whose pictures are fused, 2 to 40; default 6")
    add("--seconds", type=positive, default=4.0, metavar="S", help="in which they are taken; default 4, a breath")
    add("--region", type=Path, metavar="FILE.toml", help=ROI_HELP)
    add("--force", action="store_true", help="overwrite the files")


def _run_scan(a: argparse.Namespace) -> None:
    from hardware.files.region_table import ANY_REGION, read_region
    from hardware.live.surface_scan import ScanOrder, run_scan

    region = ANY_REGION if a.region is None else read_region(a.region)
    print(run_scan(ScanOrder(a.source, a.out, a.sets, a.seconds, region, a.force)))


def scanned_settings(settings: LiveSettings, where: object, force: bool) -> LiveSettings:
    """The settings of a run that scans for itself, with the scan that its cameras make now and the path planned on it.

    Both stand beside the recording. Without a path it is planned with `plan`'s defaults, and at a terminal the operator
    says whether those layers are to be printed. InputError, StillbedError where that is not said.
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
        answer = input(f"The layers are in {path.with_suffix('.html')}. Are they to be printed? yes or no: ")
        if answer.strip().lower() not in ("y", "yes"):
            raise StillbedError(f"not printed, as you said. The plan is kept: {path}, on {scan}")
    return replace(settings, scan=scan, path=path)
