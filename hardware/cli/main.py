"""The command line: stillbed simulate, track, segment, plan, replay, train, bench and others. Imports lazily."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from estimation.errors import InputError, StillbedError
from hardware.arm_commands import add_arm
from hardware.bench.command import add_bench
from hardware.cameras.command import add_cameras
from hardware.cli.calibrate import add_calibrate
from hardware.cli.live import add_init, add_live
from hardware.cli.parser import INTERRUPTED, WRONG_INPUT, Commands, Parser, add_command, told
from hardware.cli.plan import add_plan
from hardware.cli.sessions import add_smooth
from hardware.comparing.command import add_compare
from hardware.doctor.command import add_doctor
from hardware.methods import MAP, METHODS
from hardware.out_folder import kept, prepare_out
from hardware.reach_command import add_reach
from hardware.standard_streams import fill_standard_streams
from hardware.viewing.command import add_view
from hardware.wound_commands import add_segment, add_train
from perception.package_data import named_path

if TYPE_CHECKING:
    from hardware.process.progress import Progress

MISSED = 1  # a simulation that ran to its end and did not reach its own limits


def main(argv: Sequence[str] | None = None) -> int:
    """Run one sub-command; returns its exit code.

    0, 1 where a simulation misses its limits, 2 for wrong input (one line on stderr), 130 after Ctrl-C.
    """
    fill_standard_streams()
    arguments = parser().parse_args(argv)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy: its threads only spin over matrices this small
    code: int | None = None
    out: Path | None = getattr(arguments, "out", None)
    was_there = out is not None and out.exists()
    try:
        _end_in_order()
        code = arguments.run(arguments)
        sys.stdout.flush()
    except BrokenPipeError:  # nobody reads on, as after `| head`; the files are written all the same
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (StillbedError, OSError) as error:
        print(f"stillbed: {told(error)}", file=sys.stderr)
        if out is not None and not was_there:
            with suppress(OSError):
                out.rmdir()  # made for what was not done; what holds anything stays
        return WRONG_INPUT
    except KeyboardInterrupt:
        print(f"\nstillbed: interrupted; {kept(getattr(arguments, 'out', None))}", file=sys.stderr)
        return INTERRUPTED
    return code or 0


def _end_in_order() -> None:
    """What asks this process to end, ends it as Ctrl-C does; outside the main thread that is somebody else's part."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.default_int_handler)


def parser() -> Parser:
    """The whole command line."""
    top = Parser(
        prog="stillbed",
        description="Make a moving wound look like a still print bed.",
        epilog="A SESSION is a folder with rig.toml and frames.csv, or an .mcap file. More: stillbed COMMAND --help",
    )
    top.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = top.add_subparsers(metavar="COMMAND", required=True)
    _add_simulate(commands)
    _add_track(commands)
    add_smooth(commands)
    add_compare(commands)
    add_view(commands)
    add_segment(commands)
    add_plan(commands)
    add_live(commands)
    add_init(commands)
    _add_replay(commands)
    add_calibrate(commands)
    add_reach(commands)
    add_arm(commands)
    add_cameras(commands)
    _add_import(commands)
    _add_export(commands)
    add_train(commands)
    add_bench(commands)
    add_doctor(commands)
    return top


class _Version(argparse.Action):
    """Prints the installed version; asks for it only then."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from importlib.metadata import PackageNotFoundError, version

        try:
            print(f"stillbed {version('stillbed')}")
        except PackageNotFoundError:
            print("stillbed, not installed")
        parser.exit()


def _add_simulate(commands: Commands) -> None:
    command = add_command(
        commands,
        "simulate",
        "print on a simulated wound, and measure the nozzle's error",
        "Run a scenario in virtual time: the wound moves, cameras see it, tracking and motion are a live run's, a\n"
        "virtual arm executes, and every millisecond the nozzle is compared with its true checkpoint.\n"
        "Writes the session (MCAP and folder), tracking/, commands.csv, frames.bin, nozzle.csv, summary.json and\n"
        "report.html. Exit code 0 where the scenario's own limits are met, 1 where they are not.",
        "stillbed simulate data/scenarios/breathing_calm.toml -o out/calm",
    )
    command.add_argument(
        "scenario", type=named_path, metavar="SCENARIO.toml", help="what is simulated; see data/scenarios"
    )
    command.add_argument("-o", "--out", type=Path, required=True, help="folder to write to, new or empty")
    command.add_argument("--trace", type=Path, metavar="FILE", help="a recorded motion, TUM or CSV, instead of its own")
    _add_fault(command)
    command.add_argument("--threads", type=int, default=2, metavar="N", help="threads that render; results do not vary")
    command.add_argument("--pty", action="store_true", help="send the arm's bytes through a pseudo-terminal")
    command.add_argument("--force", action="store_true", help="write into a folder that is not empty")
    command.set_defaults(run=_simulate)


def _add_fault(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="FAULT",
        help='what goes wrong, such as "camera0 stuck at 5s for 2s"; may be given more than once; see docs/faults.md',
    )


def _add_track(commands: Commands) -> None:
    command = add_command(
        commands,
        "track",
        "follow the surface through a session",
        "Follow the surface through a recorded session, causally: the pose of a frame set uses nothing after it.\n"
        "Writes, as it goes, poses.csv and poses.tum, and at the end report.html and summary.json.",
        "stillbed track sessions/monday -o out/monday",
    )
    command.add_argument("session", type=Path, metavar="SESSION", help="session folder or .mcap file")
    command.add_argument("-o", "--out", type=Path, required=True, help="folder to write to, new or empty")
    command.add_argument(
        "--method", choices=METHODS, default=MAP, help="; ".join(f"{name}: {what}" for name, what in METHODS.items())
    )
    command.add_argument("--arm", type=named_path, metavar="ARM.toml", help="what tool hangs on the session's arm")
    command.add_argument(
        "--prefilter",
        choices=("none", "bilateral"),
        default="none",
        help="done to each picture first: the thesis's bilateral filter (4.6), 50 ms a picture",
    )
    command.add_argument("--wound", action="store_true", help="also segment the wound beside it, into wound.csv")
    command.add_argument("--record", type=Path, metavar="X.mcap", help="also record images, tracks and poses as MCAP")
    command.add_argument("--force", action="store_true", help="write into a folder that is not empty")
    command.set_defaults(run=_track)


def _add_replay(commands: Commands) -> None:
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
    command.add_argument("session", type=Path, metavar="SESSION", help="session folder or .mcap file")
    command.add_argument(
        "--path",
        type=named_path,
        metavar="PATH.csv",
        help="checkpoints on the surface; left out: those of a recorded run",
    )
    command.add_argument(
        "--arm", type=named_path, metavar="ARM.toml", help="the arm's place, limits and dialect of the link"
    )
    command.add_argument("--resume", type=Path, metavar="PROGRESS.toml", help="go on where an earlier run stopped")
    _add_fault(command)
    command.add_argument("-o", "--out", type=Path, required=True, help="folder to write to, new or empty")
    command.add_argument("--force", action="store_true", help="write into a folder that is not empty")
    command.set_defaults(run=_replay)


def _add_import(commands: Commands) -> None:
    command = add_command(
        commands,
        "import",
        "turn a session folder into one MCAP file",
        "Turn a session folder (rig.toml, frames.csv, a video or images per camera) into one MCAP file.",
        "stillbed import sessions/monday -o monday.mcap",
    )
    command.add_argument("folder", type=Path, metavar="FOLDER", help="session folder")
    command.add_argument("-o", "--out", type=Path, required=True, metavar="X.mcap", help="file to write")
    command.add_argument("--jpeg-quality", type=int, metavar="Q", help="store images smaller and not exactly, 0 to 100")
    command.add_argument("--force", action="store_true", help="overwrite the file")
    command.set_defaults(run=_import)


def _add_export(commands: Commands) -> None:
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


def _simulate(arguments: argparse.Namespace) -> int:
    from hardware.process.faults import faults_from_texts
    from hardware.simulator.simulate import Options, run_simulation

    faults = faults_from_texts("command line", "--fault", arguments.fault)
    options = Options(arguments.trace, faults, arguments.threads, arguments.pty, arguments.force)
    outcome = run_simulation(arguments.scenario, arguments.out, options)
    print(outcome.text)
    return 0 if outcome.met else MISSED


def _track(arguments: argparse.Namespace) -> None:
    from hardware.files.arm_file import read_arm
    from hardware.offline.track import run_track

    tool = None if arguments.arm is None else read_arm(arguments.arm).tool
    a = arguments
    print(run_track(a.session, a.out, a.record, a.force, a.method, tool, a.prefilter, a.wound))


def _replay(arguments: argparse.Namespace) -> int | None:
    from hardware.bookmark_file import read_start
    from hardware.files.arm_file import read_arm
    from hardware.files.path_file import read_path
    from hardware.files.session import damage_told, open_session
    from hardware.offline.replay import replay_session
    from hardware.process.faults import faults_from_texts

    faults = faults_from_texts("command line", "--fault", arguments.fault)
    if arguments.path is None:
        if faults:
            raise InputError("command line", "--fault", str(faults[0]), "with --path: what was recorded is over")
        return _replay_run(arguments)
    session = open_session(arguments.session)
    path = read_path(arguments.path)  # what is wrong with it is told before anything is made
    if arguments.resume is not None:
        read_start(arguments.resume, path)
    profile = None if arguments.arm is None else read_arm(arguments.arm)
    prepare_out(arguments.out, arguments.force)
    with _progress("replay", "frame sets") as progress:
        replay_session(session, arguments.path, arguments.out, progress, profile, arguments.resume, faults)
    rows = (arguments.out / "commands.csv").read_text(encoding="utf-8").splitlines()[1:]
    moves = sum(row.split(",", 2)[1] == "move" for row in rows)
    _say(damage_told(session.damage))
    print(f"{moves} moves and {len(rows) - moves} holds: commands.csv and frames.bin in {arguments.out}")
    return None


def _replay_run(arguments: argparse.Namespace) -> int:
    from hardware.files.session import damage_told
    from hardware.live.replayed import write_replay

    count = write_replay(arguments.session, arguments.out, arguments.force)
    same = "all as they were given" if not count.other else f"{count.other} of them not as they were given"
    _say(damage_told(count.damage))
    print(f"{count.frames} frames, {same}: commands.csv and frames.bin in {arguments.out}")
    return MISSED if count.other else 0


def _import(arguments: argparse.Namespace) -> None:
    from hardware.offline.convert import import_folder

    with _progress("import", "images") as progress:
        import_folder(arguments.folder, arguments.out, progress, arguments.force, arguments.jpeg_quality)
    print(f"{arguments.out}: {arguments.out.stat().st_size / 1e6:.1f} MB")


def _export(arguments: argparse.Namespace) -> None:
    from hardware.files.session import damage_told
    from hardware.offline.convert import export_recording

    with _progress("export", "images") as progress:
        damage = export_recording(arguments.mcap, arguments.out, progress)
    _say(damage_told(damage))
    print(f"a session folder is in {arguments.out}")


def _say(sentence: str) -> None:
    """Print a sentence, where there is one."""
    if sentence:
        print(sentence)


def _progress(what: str, unit: str) -> Progress:
    from hardware.process.clock import WallClock
    from hardware.process.progress import Progress

    return Progress(what, unit, WallClock().now)


if __name__ == "__main__":
    sys.exit(main())
