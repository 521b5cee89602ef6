"""`stillbed track`, `replay`, `smooth`, `compare`, `view`, `import`, `export`: recorded sessions. Imports lazily."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from estimation.errors import InputError
from hardware.cli.parser import Commands, add_command, add_fault
from hardware.offline.track import MAP_METHOD, TRACKING_METHODS
from hardware.process.progress import prepare_out
from perception.package_data import named_path

if TYPE_CHECKING:
    from hardware.process.progress import Progress

FRAMES_DIFFER = 1  # exit code of a replayed run whose frames are not those that were recorded
SMOOTHING_FAILED = 1  # exit code where one of several sessions could not be smoothed


def add_track(commands: Commands) -> None:
    """Add the sub-command `track`."""
    command = add_command(
        commands,
        "track",
        "follow the surface through a session",
        "Follow the surface through a recorded session, causally: the pose of a frame set uses nothing after it.\n"
        "Writes, as it goes, poses.csv and poses.tum, and at the end report.html and summary.json.",
        "stillbed track sessions/monday -o out/monday",
    )
    add = command.add_argument
    add("session", type=Path, metavar="SESSION", help="session folder or .mcap file")
    add("-o", "--out", type=Path, required=True, help="folder to write to, new or empty")
    add(
        "--method",
        choices=TRACKING_METHODS,
        default=MAP_METHOD,
        help="; ".join(f"{name}: {what}" for name, what in TRACKING_METHODS.items()),
    )
    add("--arm", type=named_path, metavar="ARM.toml", help="what tool hangs on the session's arm")
    add(
        "--prefilter",
        choices=("none", "bilateral"),
        default="none",
        help="done to each picture first: the thesis's bilateral filter (4.6), 50 ms a picture",
    )
    add("--wound", action="store_true", help="also segment the wound beside it, into wound.csv")
    add("--record", type=Path, metavar="X.mcap", help="also record images, tracks and poses as MCAP")
    add("--force", action="store_true", help="write into a folder that is not empty")
    command.set_defaults(run=_track)


def add_replay(commands: Commands) -> None:
    """Add the sub-command `replay`."""
    command = add_command(
        commands,
        "replay",
        "run tracking and motion on a session under a simulated clock",
        "Run tracking and motion on a recorded session under a simulated clock, as a live run would, without an arm.\n"
        "Writes commands.csv, frames.bin, the bytes the arm would get, and arm.toml, what was assumed of the arm.\n"
        "Same input, same bytes. Without --path, the recording of a live run is replayed as it was: from its poses\n"
        "and ticks planner and guard decide anew, and each frame is compared. Any other recording knows no arm:\n"
        "without --arm the default one is placed so that the first surface lies under its home.",
        "stillbed replay sessions/monday --path data/paths/square_10mm.csv -o out/replay",
    )
    add = command.add_argument
    add("session", type=Path, metavar="SESSION", help="session folder or .mcap file")
    add(
        "--path",
        type=named_path,
        metavar="PATH.csv",
        help="checkpoints on the surface; left out: those of a recorded run",
    )
    add("--arm", type=named_path, metavar="ARM.toml", help="the arm's place, limits and dialect of the link")
    add("--resume", type=Path, metavar="PROGRESS.toml", help="go on where an earlier run stopped")
    add_fault(command)
    add("-o", "--out", type=Path, required=True, help="folder to write to, new or empty")
    add("--force", action="store_true", help="write into a folder that is not empty")
    command.set_defaults(run=_replay)


def add_import(commands: Commands) -> None:
    """Add the sub-command `import`."""
    command = add_command(
        commands,
        "import",
        "turn a session folder into one MCAP file",
        "Turn a session folder (rig.toml, frames.csv, a video or images per camera) into one MCAP file.",
        "stillbed import sessions/monday -o monday.mcap",
    )
    add = command.add_argument
    add("folder", type=Path, metavar="FOLDER", help="session folder")
    add("-o", "--out", type=Path, required=True, metavar="X.mcap", help="file to write")
    add("--jpeg-quality", type=int, metavar="Q", help="store images smaller and not exactly, 0 to 100")
    add("--force", action="store_true", help="overwrite the file")
    command.set_defaults(run=_import)


def add_export(commands: Commands) -> None:
    """Add the sub-command `export`."""
    command = add_command(
        commands,
        "export",
        "turn an MCAP file into a session folder",
        "Turn an MCAP file into a session folder: rig.toml, frames.csv and the images of each camera.",
        "stillbed export monday.mcap -o sessions/monday",
    )
    command.add_argument("mcap", type=Path, metavar="X.mcap", help="recording")
    command.add_argument(
        "-o", "--out", type=Path, required=True, metavar="FOLDER", help="folder to write, new or empty"
    )
    command.set_defaults(run=_export)


def _track(arguments: argparse.Namespace) -> None:
    from hardware.files.arm_file import read_arm
    from hardware.offline.track import run_track

    tool = None if arguments.arm is None else read_arm(arguments.arm).tool
    a = arguments
    print(run_track(a.session, a.out, a.record, a.force, a.method, tool, a.prefilter, a.wound))


def _replay(arguments: argparse.Namespace) -> int | None:
    from hardware.files.arm_file import read_arm
    from hardware.files.path_file import read_path, read_progress
    from hardware.files.session import damage_text
    from hardware.offline.replay import replay_session
    from hardware.process.faults import faults_from_texts
    from hardware.recording.session_reader import open_session

    faults = faults_from_texts("command line", "--fault", arguments.fault)
    if arguments.path is None:
        if faults:
            raise InputError("command line", "--fault", str(faults[0]), "with --path: what was recorded is over")
        return _replay_run(arguments)
    session = open_session(arguments.session)
    path = read_path(arguments.path)  # what is wrong with it is told before anything is made
    if arguments.resume is not None:
        read_progress(arguments.resume, path)
    profile = None if arguments.arm is None else read_arm(arguments.arm)
    prepare_out(arguments.out, arguments.force)
    with _progress("replay", "frame sets") as progress:
        out = arguments.out
        moves, holds = replay_session(session, arguments.path, out, progress, profile, arguments.resume, faults)
    _print_sentence(damage_text(session.damage))
    print(f"{moves} moves and {holds} holds: commands.csv and frames.bin in {arguments.out}")
    return None


def _replay_run(arguments: argparse.Namespace) -> int:
    from hardware.files.session import damage_text
    from hardware.live.recorded_run import write_replay

    count = write_replay(arguments.session, arguments.out, arguments.force)
    same = "all as they were given" if not count.other else f"{count.other} of them not as they were given"
    _print_sentence(damage_text(count.damage))
    print(f"{count.frames} frames, {same}: commands.csv and frames.bin in {arguments.out}")
    return FRAMES_DIFFER if count.other else 0


def _import(arguments: argparse.Namespace) -> None:
    from hardware.offline.convert import import_folder

    with _progress("import", "images") as progress:
        import_folder(arguments.folder, arguments.out, progress, arguments.force, arguments.jpeg_quality)
    print(f"{arguments.out}: {arguments.out.stat().st_size / 1e6:.1f} MB")


def _export(arguments: argparse.Namespace) -> None:
    from hardware.files.session import damage_text
    from hardware.offline.convert import export_recording

    with _progress("export", "images") as progress:
        damage = export_recording(arguments.mcap, arguments.out, progress)
    _print_sentence(damage_text(damage))
    print(f"a session folder is in {arguments.out}")


def _print_sentence(sentence: str) -> None:
    """Print a sentence, where there is one."""
    if sentence:
        print(sentence)


def _progress(what: str, unit: str) -> Progress:
    from hardware.process.clock import WallClock
    from hardware.process.progress import Progress

    return Progress(what, unit, WallClock().now)


def add_smooth(commands: Commands) -> None:
    """Add the sub-command `smooth`."""
    command = add_command(
        commands,
        "smooth",
        "the best estimate of recorded sessions, from all frame sets at once",
        "Estimate all poses of a recorded session, its landmarks and its cameras' clocks at once, looking\n"
        "ahead as well as back. Tracks are those of the recording; where it has none, its images are tracked first.\n"
        "Then all images are searched for landmarks that the tracks do not have there, and all is smoothed again.\n"
        "Writes smoothed.tum, smoothed.csv (covariances and twists), rig.toml (the cameras as corrected), map.ply,\n"
        "summary.json, report.html and, of an .mcap file, smoothed.mcap: a copy with the channel /smoothed.\n"
        "Of several sessions, and of those in a folder of sessions, each gets a folder of its own; one that fails\n"
        "does not stop the others (exit code 1), and sessions.csv has a line for each. What is done already is not\n"
        "done again. With --scheduler they are smoothed on a Dask cluster, a task each.",
        "stillbed smooth out/calm/session.mcap -o out/smoothed --rate 1000",
        "stillbed smooth sessions/ -o out/all --scheduler local --workers 4",
    )
    add = command.add_argument
    add("sessions", type=Path, nargs="+", metavar="SESSION", help="session folder, .mcap file, or a folder of such")
    add("-o", "--out", type=Path, required=True, help="folder to write to")
    add("--rate", type=float, metavar="HZ", help="rows of smoothed.csv a second; default: the stamps")
    add(
        "--refine-cameras",
        action="store_true",
        help="let the recording also correct the cameras' places and lenses, with their calibration as prior",
    )
    add(
        "--no-relink",
        action="store_true",
        help="take the tracks as they are; without it, all images are searched for landmarks that the tracks do not "
        "say to be seen, such as before they joined the map",
    )
    add(
        "--scheduler",
        metavar="ADDRESS",
        help="of a Dask scheduler, such as tcp://host:8786, whose workers reach sessions and OUT under the same paths; "
        "local: start one here; needs the extra [cluster]",
    )
    add("--workers", type=int, metavar="N", help="processes of --scheduler local; default: the cores")
    command.set_defaults(run=_smooth)


def _smooth(arguments: argparse.Namespace) -> int:
    from estimation.errors import InputError
    from hardware.offline.smooth import Cluster, SmoothOptions, run_smooth

    a, failed = arguments, 0
    if a.workers is not None and a.scheduler != "local":
        raise InputError("command line", "--workers", a.workers, "with --scheduler local")
    cluster = None if a.scheduler is None else Cluster(a.scheduler, a.workers)
    wishes = SmoothOptions(a.rate, a.refine_cameras, relink=not a.no_relink)
    for outcome in run_smooth(a.sessions, a.out, wishes, cluster):
        print(f"{outcome.job.session}: not smoothed: {outcome.text}" if outcome.failed else outcome.text, flush=True)
        failed += outcome.failed
    return SMOOTHING_FAILED if failed else 0


def add_compare(commands: Commands) -> None:
    """Add the sub-command `compare`."""
    command = add_command(
        commands,
        "compare",
        "one trajectory judged by another: APE, RPE, NEES",
        "Judge poses by others of the same instants, in the numbers that evo gives: absolute and relative\n"
        "errors, translation and rotation, as they stand and aligned, without scale; and NEES where there are\n"
        "covariances. Each of the two is a TUM or CSV file, an .mcap file, or a folder that stillbed wrote; of an\n"
        ".mcap file FILE:smoothed, FILE:pose or FILE:truth. Writes report.html and compare.json with -o.",
        "stillbed compare out/smoothed out/calm/session/truth.tum -o out/compared",
    )
    add = command.add_argument
    add("estimated", metavar="A", help="the poses that are judged")
    add("reference", metavar="B", nargs="?", help="what they are judged by; default: the truth in A")
    add("--delta", type=int, default=1, metavar="N", help="poses over which relative errors are counted; default 1")
    add("-o", "--out", type=Path, help="folder to write report.html and compare.json to")
    command.set_defaults(run=_compare)


def _compare(arguments: argparse.Namespace) -> None:
    from hardware.offline.compare import run_compare

    a = arguments
    print(run_compare(a.estimated, a.reference, a.delta, a.out))


def add_view(commands: Commands) -> None:
    """Add the sub-command `view`."""
    command = add_command(
        commands,
        "view",
        "a recorded session in a browser, with a slider over its time",
        "Show a recorded or smoothed session in a browser of this machine: the cameras' pictures with the\n"
        "tracks, the surface in three dimensions with cameras, trajectory, path and nozzle, and the state, at any of\n"
        "its instants. Prints the address to open; nothing is written. Ctrl-C ends it.",
        "stillbed view out/smoothed",
    )
    add = command.add_argument
    add(
        "session", type=Path, metavar="SESSION", help="session folder, .mcap file, or what stillbed smooth wrote of one"
    )
    add("--poses", metavar="FILE", help="other poses than the recording's, as stillbed compare reads")
    add("--path", type=Path, metavar="PATH.csv", help="the path, where the recording has none")
    add("--port", type=int, default=0, metavar="N", help="of 127.0.0.1; default: whichever is free")
    command.set_defaults(run=_view)


def _view(arguments: argparse.Namespace) -> None:
    from hardware.offline.viewer import run_view

    a = arguments
    run_view(a.session, a.poses, a.path, a.port)
