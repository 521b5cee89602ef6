"""`stillbed plan`: its command line; what does the work is loaded when it is asked for."""

from __future__ import annotations

import argparse
from pathlib import Path

from hardware.cli.parser import Commands
from perception.package_data import named_path

TEXT = """\
Plan the print of a wound. SCAN is a mesh (.ply, .stl, .obj) of the wound with skin around it, or a flat contour
(.csv with x_mm,y_mm): one layer. The mesh is repaired, the wound found as the depression in the skin, the healthy
skin interpolated over it, the volume between cut into layers, each filled with beads, and the tool led over them.

Writes PATH.csv, whole or not at all, and beside it PATH_layers.csv and PATH.json (coverage, lengths, times, volumes),
PATH_scan.ply (the scan as repaired), PATH_layers/ (a picture of each layer) and PATH.html (a report with a view in
three dimensions, without a network). The path is in the scan's frame: a session whose surface.ply is the same scan
is printed with it as it stands."""

EXAMPLES = """\
examples:
  stillbed plan --example forearm -o out/path.csv
  stillbed plan wound.stl -o out/path.csv --material collagen --pattern contour --bead 0.4
  stillbed plan wound.ply -o out/path.csv --unit m --layers conformal \\
      --tissue hypodermis=rest:adipose:37 --tissue dermis=1.5:collagen:20:12 --tissue epidermis=0.3:keratinocytes
  stillbed plan contour.csv -o out/path.csv --bead 0.8 --pattern zigzag --angle shorter --gcode out/path.gcode"""


def add_plan(commands: Commands) -> None:
    """Add the sub-command `plan`."""
    command: argparse.ArgumentParser = commands.add_parser(
        "plan",
        help="plan the print of a scanned wound: layers, beads, checkpoints",
        description=TEXT,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.add_argument("scan", type=Path, nargs="?", metavar="SCAN", help="mesh of the wound, or contour")
    command.add_argument("-o", "--out", type=Path, required=True, metavar="PATH.csv", help="path to write")
    command.add_argument(
        "--example", choices=("forearm", "chest", "foot"), help="a built-in scan instead of SCAN; also written"
    )
    command.add_argument("--gcode", type=Path, metavar="FILE", help="also write the path as plain G-code text")
    command.add_argument(
        "--session", type=Path, metavar="SESSION",
        help="also lay the scan into this session's first pictures, and say how well it fits the wound they show",
    )  # fmt: skip
    command.add_argument(
        "--arm", type=named_path, metavar="ARM.toml",
        help="ask this arm's joints about each checkpoint and write the column `feasible`; without, there is none, and "
        "`stillbed reach` adds it",
    )  # fmt: skip
    command.add_argument("--no-pictures", action="store_true", help="write neither pictures nor the report")
    command.add_argument("--force", action="store_true", help="overwrite PATH.csv and what stands beside it")
    _add_scan(command)
    _add_layers(command)
    _add_pattern(command)
    _add_way(command)
    command.set_defaults(run=_plan)


def _add_scan(command: argparse.ArgumentParser) -> None:
    group = command.add_argument_group("the scan")
    group.add_argument("--unit", choices=("mm", "cm", "m", "inch"), default="mm", help="of SCAN's numbers; default mm")
    group.add_argument("--flip", action="store_true", help="turn SCAN over, whose normals point inwards")
    group.add_argument(
        "--outline", type=Path, metavar="CSV",
        help="outline of the wound, x_mm,y_mm[,z_mm] in SCAN's frame, mm; default: found",
    )  # fmt: skip


def _add_layers(command: argparse.ArgumentParser) -> None:
    group = command.add_argument_group("layers")
    group.add_argument(
        "--layers", choices=("skin", "conformal", "horizontal"), default="skin",
        help="parallel to the restored skin; from the bed blending into the skin; flat, as the thesis; default skin",
    )  # fmt: skip
    group.add_argument(
        "--tissue", action="append", default=[], metavar="NAME=THICKNESS:MATERIAL[:TEMPERATURE[:SPEED[:HEIGHT]]]",
        help="bottom up, mm (or 'rest'), degrees C, mm/s, mm of a layer; "
        "default hypodermis=rest, dermis=1.6, epidermis=0.4",
    )  # fmt: skip
    group.add_argument(
        "--material", default="1,2,3", metavar="M[,M,M]", help="of all, or of each default tissue; default 1,2,3"
    )
    group.add_argument("--layer-height", type=float, metavar="MM", help="about; default: as wide as a bead")
    group.add_argument(
        "--bump", type=float, metavar="MM",
        help="bumps of the bed that stand over a layer by this at most are gone over, higher ones round; default half "
        "a layer, so that the layer above still has room over them",
    )  # fmt: skip
    group.add_argument(
        "--bump-clearance", type=float, metavar="MM",
        help="left free around bumps that are gone round; default half a bead, room for a needle's outside",
    )  # fmt: skip
    group.add_argument("--temperature", type=float, default=20.0, metavar="C", help="degrees C; default 20")


def _add_pattern(command: argparse.ArgumentParser) -> None:
    group = command.add_argument_group("pattern")
    group.add_argument(
        "--pattern", choices=("zigzag", "raster", "contour", "spiral", "hybrid", "best"), default="contour",
        help="contour: closed lines, nothing left open; zigzag, raster: straight lines, the quickest to plan; hybrid: "
        "rims around a zigzag; spiral: closed lines joined; best: the faster of contour and spiral; default contour",
    )  # fmt: skip
    group.add_argument(
        "--angle", default="fastest", metavar="DEG",
        help="of the lines, or 'shorter' (of 0 and 90) or 'fastest' (of 12), judged on the largest layer; "
        "default fastest",
    )  # fmt: skip
    group.add_argument("--parallel", action="store_true", help="lines of all layers alike, not every second across")
    group.add_argument("--bead", type=float, default=0.4, metavar="MM", help="width of a bead; default 0.4")
    group.add_argument("--overlap-percent", type=float, default=0.0, metavar="P", help="of neighbours; default 0")
    group.add_argument("--inset", type=float, default=0.0, metavar="MM", help="left free along the rim; default 0")
    group.add_argument("--rims", type=int, default=1, metavar="N", help="closed lines of hybrid; default 1")


def _add_way(command: argparse.ArgumentParser) -> None:
    group = command.add_argument_group("the tool's way")
    for name, default, metavar, text in (
        ("--speed", 20.0, "MM/S", "of printing"),
        ("--travel", 60.0, "MM/S", "between beads"),
        ("--lift", 2.0, "MM", "along the tool, for travels"),
        ("--wait", 0.0, "S", "before each layer"),
        ("--spacing", 1.0, "MM", "between checkpoints: the shortest length the ink can be laid over"),
        ("--chord", 0.02, "MM", "by which straight ways may depart from curves: where they would, nearer checkpoints"),
        ("--sideways", 200.0, "MM/S2", "acceleration in bends, which are slowed down to it"),
        ("--tilt-deg", 30.0, "DEG", "most the tool leans off the plane's normal"),
        ("--turning-deg-mm", 5.0, "DEG/MM", "most it turns on its way"),
        ("--spin-deg", 0.0, "DEG", "about its own axis, free for a round nozzle"),
    ):
        group.add_argument(name, type=float, default=default, metavar=metavar, help=f"{text}; default {default:g}")


def _plan(arguments: argparse.Namespace) -> None:
    from hardware.plan.order import Wishes
    from hardware.plan.run import Request, run_plan

    a = arguments
    wishes = Wishes(
        a.material, tuple(a.tissue), a.layers, a.layer_height, a.pattern, a.angle, a.parallel, a.bead,
        a.overlap_percent, a.inset, a.rims, a.speed, a.travel, a.temperature, a.spacing, a.chord, a.lift, a.wait,
        a.sideways, a.tilt_deg, a.turning_deg_mm, a.spin_deg, a.bump, a.bump_clearance,
    )  # fmt: skip
    print(
        run_plan(
            Request(
                a.out,
                a.scan,
                a.example,
                a.outline,
                a.unit,
                a.flip,
                a.gcode,
                a.session,
                not a.no_pictures,
                a.force,
                a.arm,
                wishes,
            )
        )
    )
