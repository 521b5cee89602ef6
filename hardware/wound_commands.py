"""`stillbed segment` and `stillbed train`: their command lines; what does the work is loaded when it is asked for."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from hardware.cli.parser import Commands

if TYPE_CHECKING:
    from perception.wound.segmentation import Segmenter


UNET, SHAPE = "unet", "shape"


def add_segment(commands: Commands) -> None:
    """Add the sub-command `segment`."""
    command: argparse.ArgumentParser = commands.add_parser(
        "segment",
        help="find the wound in pictures or a video",
        description="Find the wound in pictures, folders of pictures or videos. Writes a PNG mask (0 or 255) of each\n"
        "picture's own size and name, and wounds.csv: confidence, area, centroid, box and time of each. A picture\n"
        "without a wound gets an empty mask. Ctrl-C keeps what is done.",
        epilog="examples:\n  stillbed segment photos/ -o masks --overlay\n"
        "  stillbed segment ward.mp4 -o masks --method shape",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.add_argument("inputs", type=Path, nargs="+", metavar="INPUT", help="picture, folder of pictures, or video")
    command.add_argument("-o", "--out", type=Path, required=True, metavar="MASKS", help="folder, new or empty")
    command.add_argument(
        "--method", choices=(UNET, SHAPE), default=UNET, help="unet: a trained network; shape: outlines like the scan's"
    )
    command.add_argument("--model", type=Path, metavar="X.onnx", help="another network than the one that comes along")
    command.add_argument("--scan", type=Path, metavar="SCAN", help="with --method shape: of the wound, z upwards")
    command.add_argument("--overlay", action="store_true", help="also write the pictures with the outlines drawn in")
    command.add_argument("--mm-per-px", type=float, metavar="S", help="scale at the wound, for areas in mm^2")
    command.add_argument("--threads", type=int, default=2, metavar="N", help="of the network; results do not vary")
    command.add_argument("--force", action="store_true", help="write into a folder that is not empty")
    command.set_defaults(run=_segment)


def add_train(commands: Commands) -> None:
    """Add the sub-command `train`."""
    command: argparse.ArgumentParser = commands.add_parser(
        "train",
        help="train the wound network on labelled pictures",
        description="Train the wound network. Each DATASET holds images/ and labels/, a mask of the same name and\n"
        "size for each picture. Pictures are grouped by what they show, a part is held out and judged at the end.\n"
        "Writes X.onnx, X.toml (hash and settings), X.md (model card) and X_curves.png; X.ckpt lets a run\n"
        "that was broken off go on. Needs the extra [train]: pip install 'stillbed[train]'.",
        epilog="example:\n  stillbed train data/fuseg data/medetec -o wound.onnx",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.add_argument("datasets", type=Path, nargs="+", metavar="DATASET", help="the first is held out in part")
    command.add_argument("-o", "--out", type=Path, required=True, metavar="X.onnx", help="file to write")
    command.add_argument(
        "--network",
        choices=("wound", "thesis", "shape"),
        default="wound",
        help="thesis: the U-Net of its 3.3; shape: no network, but what segment --method shape needs, X.toml",
    )
    command.add_argument("--rounds", type=int, metavar="N", help="of 250 steps (thesis: 100); more take longer")
    command.add_argument("--rendered", type=int, default=120, metavar="N", help="rendered pictures to add")
    command.add_argument("--hold-out", type=int, default=160, metavar="N", help="pictures to judge by, in groups")
    command.add_argument("--threads", type=int, default=1, metavar="N", help="of torch")
    command.add_argument("--seed", type=int, default=1, metavar="N", help="of the weights and of all that is drawn")
    command.add_argument("--force", action="store_true", help="overwrite X.onnx and begin anew")
    command.set_defaults(run=_train)


def _segment(arguments: argparse.Namespace) -> None:
    from hardware.offline.segment import Options, run_segment

    _check(arguments)
    how = arguments.scan, arguments.mm_per_px, arguments.threads
    segmenter = segmenter_by(arguments.method, arguments.model, *how)
    options = Options(arguments.overlay, arguments.mm_per_px, arguments.force)
    print(run_segment(arguments.inputs, arguments.out, segmenter, options))


def _check(arguments: argparse.Namespace) -> None:
    from estimation.errors import InputError

    if arguments.mm_per_px is not None and not 0 < arguments.mm_per_px < 100:
        raise InputError("command line", "--mm-per-px", arguments.mm_per_px, "above 0 and below 100")
    if not 1 <= arguments.threads <= 64:
        raise InputError("command line", "--threads", arguments.threads, "1 to 64")
    if arguments.method == SHAPE and arguments.model is not None:
        raise InputError(
            "command line", "--model", arguments.model, "nothing with --method shape, which has no network"
        )
    if arguments.method == UNET and arguments.scan is not None:
        raise InputError("command line", "--scan", arguments.scan, "a scan only with --method shape")


def segmenter_by(
    method: str,
    model: Path | None = None,
    scan: Path | None = None,
    mm_per_px: float | None = None,
    threads: int = 2,
) -> Segmenter:
    """A segmenter by the name of its method. model: a network's file, None: the one that comes along. scan: of the
    wound, for its outline, and for its size where mm_per_px is known."""
    if method == UNET:
        from perception.wound.network import WoundNetwork, shipped
        from perception.wound.segmentation import NetworkSegmenter

        network = WoundNetwork(shipped() if model is None else model, threads)
        return NetworkSegmenter(network, network.settings)
    from perception.wound.network import shipped
    from perception.wound.shape_matching import ShapeSegmenter, pattern_of_scan, read_shape_model

    pattern, area = None, None
    if scan is not None:
        from hardware.files.mesh_file import read_mesh

        pattern, across = pattern_of_scan(read_mesh(scan).scan)
        area = None if mm_per_px is None else across / mm_per_px**2
    return ShapeSegmenter(read_shape_model(shipped("shape", ".toml")), pattern, area)


def _train(arguments: argparse.Namespace) -> None:
    from hardware.offline.train import run_train

    print(run_train(arguments))
