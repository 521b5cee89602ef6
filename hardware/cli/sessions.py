"""`stillbed track`, `replay`, `trace`, `smooth`, `compare`, `view`, `import`, `export`: recordings. Imports lazily."""

from __future__ import annotations

import argparse
from pathlib import Path

from hardware.cli.parser import FAILED, MODEL_HELP, Commands, add_fault, damage_code, option_error, progress_bar
from hardware.process.progress import check_new, prepare_out
from perception import named_path
from perception.tracking import MAP_METHOD, TRACKING_METHODS


def add_track(commands: Commands) -> None:
    """Add the sub-command `track`."""
    add = commands.add(
        "track",
        _track,
        "track the surface through a recorded session",
        "Track the surface through a recorded session, causally: the pose of a frame set uses no later frame set.\n"
        "Writes poses.csv and poses.tum during the run, and report.html and summary.json at the end.",
        "stillbed track sessions/monday -o out/monday",
    ).add_argument
    add("session", type=Path, metavar="SESSION", help="session folder or .mcap file")
    add("-o", "--out", type=Path, required=True, help="output folder, new or empty")
    method_help = "; ".join(f"{name}: {what}" for name, what in TRACKING_METHODS.items())
    add("--method", choices=TRACKING_METHODS, default=MAP_METHOD, help=method_help)
    add("--arm", type=named_path, metavar="ARM.toml", help="arm file with the tool of the session's arm")
    prefilter_help = "filter for each picture before tracking; bilateral: as in the thesis (4.6), 50 ms a picture"
    add("--prefilter", choices=("none", "bilateral"), default="none", help=prefilter_help)
    add("--wound", action="store_true", help="also segment the wound; writes wound.csv")
    add("--model", type=Path, metavar="X.onnx", help=MODEL_HELP)
    add("--record", type=Path, metavar="X.mcap", help="also record images, tracks and poses as MCAP")
    add("--graph", type=Path, metavar="X.dot", help="also write the factor graph of the last poses, for Graphviz")
    add("--force", action="store_true", help="write into a folder that is not empty")


def add_replay(commands: Commands) -> None:
    """Add the sub-command `replay`."""
    add = commands.add(
        "replay",
        _replay,
        "run tracking and motion on a session with a simulated clock",
        "Run tracking and motion on a recorded session with a simulated clock, as in a live run, without an arm.\n"
        "Writes commands.csv, frames.bin (the bytes for the arm) and arm.toml (the assumed arm).\n"
        "The same input gives the same bytes. Without --path, SESSION is the recording of a live run: planner and\n"
        "guard run again on its poses and ticks, and each frame is compared with the recorded one. Other\n"
        "recordings contain no arm: without --arm, the default arm is placed with its home above the first surface.",
        "stillbed replay sessions/monday --path data/paths/square_10mm.csv -o out/replay",
    ).add_argument
    add("session", type=Path, metavar="SESSION", help="session folder or .mcap file")
    path_help = "checkpoints on the surface; default: those of the recorded run"
    add("--path", type=named_path, metavar="PATH.csv", help=path_help)
    add("--arm", type=named_path, metavar="ARM.toml", help="arm file: base pose, limits, dialect of the link")
    add("--resume", type=Path, metavar="PROGRESS.toml", help="continue at the place where an earlier run stopped")
    add_fault(add)
    add("-o", "--out", type=Path, required=True, help="output folder, new or empty")
    add("--force", action="store_true", help="write into a folder that is not empty")


def add_trace(commands: Commands) -> None:
    """Add the sub-command `trace`."""
    add = commands.add(
        "trace",
        _run_trace,
        "show the processing times of a live run's slowest frame sets",
        "Read the trace in the recording of a live run: the time of the frame sets from their pixels in memory to the\n"
        "first move on the wire, and the work of the processes in that time, for all sets and for the slowest 1 %.",
        "stillbed trace run.mcap -o run.json --page run.trace.html",
    ).add_argument
    add("recording", type=Path, metavar="X.mcap", help="recording of a live run")
    add("-o", "--out", type=Path, metavar="X.json", help="write it for Perfetto (ui.perfetto.dev), chrome://tracing")
    add("--page", type=Path, metavar="X.html", help="write a page: causes, and timelines of the slowest sets")
    add("--force", action="store_true", help="overwrite these files")


def _run_trace(a: argparse.Namespace) -> None:
    from hardware.live.trace import chrome_trace, read_trace, trace_page, trace_text

    for flag, file in (("--out", a.out), ("--page", a.page)):
        if file is not None:
            check_new(file, a.force, flag, a.recording)
    trace = read_trace(a.recording)
    print(trace_text(trace))
    if a.out is not None:
        a.out.write_text(chrome_trace(trace), encoding="utf-8")
    if a.page is not None:
        a.page.write_text(trace_page(trace, a.recording.stem), encoding="utf-8")


def add_import(commands: Commands) -> None:
    """Add the sub-command `import`."""
    add = commands.add(
        "import",
        _import,
        "convert a session folder to one MCAP file",
        "Convert a session folder (rig.toml, frames.csv, a video or images per camera) to one MCAP file.",
        "stillbed import sessions/monday -o monday.mcap",
    ).add_argument
    add("folder", type=Path, metavar="FOLDER", help="session folder")
    add("-o", "--out", type=Path, required=True, metavar="X.mcap", help="output file")
    add("--jpeg-quality", type=int, metavar="Q", help="JPEG quality of images, 0 to 100; default: lossless")
    add("--force", action="store_true", help="overwrite the file")


def add_export(commands: Commands) -> None:
    """Add the sub-command `export`."""
    add = commands.add(
        "export",
        _export,
        "convert an MCAP file to a session folder",
        "Convert an MCAP file to a session folder: rig.toml, frames.csv and the images of each camera.",
        "stillbed export monday.mcap -o sessions/monday",
    ).add_argument
    add("mcap", type=Path, metavar="X.mcap", help="recording")
    add("-o", "--out", type=Path, required=True, metavar="FOLDER", help="folder to write, new or empty")


def _track(a: argparse.Namespace) -> int:
    from hardware.files.session import check_exists

    check_exists(a.session)
    from hardware.files.arm_file import read_arm
    from hardware.offline.track import run_track

    if a.graph is not None and a.method != MAP_METHOD:
        raise option_error("--graph", "given", f"with --method {MAP_METHOD}: only this method has a graph")
    tool = None if a.arm is None else read_arm(a.arm).tool
    paths = a.session, a.out, a.record
    text, damage = run_track(*paths, a.force, a.method, tool, a.prefilter, a.wound, a.model, a.graph)
    print(text)
    return FAILED if damage else 0


def _replay(a: argparse.Namespace) -> int:
    from hardware.files.arm_file import read_arm
    from hardware.files.path_file import read_path, read_progress
    from hardware.offline.replay import replay_session
    from hardware.process.faults import faults_from_texts
    from hardware.recording.session_reader import open_session

    faults = faults_from_texts("command line", "--fault", a.fault)
    if a.path is None:
        if faults:
            raise option_error("--fault", str(faults[0]), "with --path: faults cannot change a recorded run")
        return _replay_run(a)
    session = open_session(a.session)
    path = read_path(a.path)  # reports a wrong file before anything is written
    if a.resume is not None:
        read_progress(a.resume, path)
    profile = None if a.arm is None else read_arm(a.arm)
    prepare_out(a.out, a.force)
    with progress_bar("replay", "frame sets") as progress:
        moves, holds = replay_session(session, a.path, a.out, progress, profile, a.resume, faults)
    code = damage_code(session.damage)
    print(f"{moves} moves and {holds} holds: commands.csv and frames.bin in {a.out}")
    return code


def _replay_run(a: argparse.Namespace) -> int:
    from hardware.live.recorded_run import write_replay

    count = write_replay(a.session, a.out, a.force)
    agreement = (
        "all equal to the recorded ones" if not count.other else f"{count.other} different from the recorded ones"
    )
    code = damage_code(count.damage)
    print(f"{count.frames} frames, {agreement}: commands.csv and frames.bin in {a.out}")
    if count.parted:
        print(f"the replay ended early: {count.parted}")
    return FAILED if count.other or count.parted else code


def _import(a: argparse.Namespace) -> None:
    from hardware.offline.convert import import_folder

    with progress_bar("import", "images") as progress:
        import_folder(a.folder, a.out, progress, a.force, a.jpeg_quality)
    print(f"{a.out}: {a.out.stat().st_size / 1e6:.1f} MB")


def _export(a: argparse.Namespace) -> int:
    from hardware.offline.convert import export_recording

    with progress_bar("export", "images") as progress:
        damage = export_recording(a.mcap, a.out, progress)
    code = damage_code(damage)
    print(f"a session folder is in {a.out}")
    return code


def add_smooth(commands: Commands) -> None:
    """Add the sub-command `smooth`."""
    add = commands.add(
        "smooth",
        _smooth,
        "smooth recorded sessions: all poses from all frame sets at once",
        "Estimate all poses, landmarks and camera clock offsets of a recorded session at once, from past and\n"
        "future frame sets. Uses the recorded tracks; if there are none, the images are tracked first.\n"
        "Then all images are searched for further observations of the landmarks, and the session is smoothed again.\n"
        "Writes smoothed.tum, smoothed.csv (covariances and twists), rig.toml (corrected cameras), map.ply,\n"
        "summary.json, report.html and, for an .mcap file, smoothed.mcap: a copy with the channel /smoothed.\n"
        "Several sessions, or a folder of sessions: each gets its own output folder. A failure does not stop the\n"
        "others (exit code 1). sessions.csv has a line for each. Finished sessions are not smoothed again. With\n"
        "--scheduler, a Dask cluster smooths them, one task per session.",
        "stillbed smooth out/calm/session.mcap -o out/smoothed --rate 1000",
        "stillbed smooth sessions/ -o out/all --scheduler local --workers 4",
    ).add_argument
    add("sessions", type=Path, nargs="+", metavar="SESSION", help="session folder, .mcap file, or a folder of these")
    add("-o", "--out", type=Path, required=True, help="output folder")
    add("--rate", type=float, metavar="HZ", help="rate of smoothed.csv's rows; default: frame sets")
    refine = "also estimate camera poses and lenses, with the calibration as prior"
    add("--refine-cameras", action="store_true", help=refine)
    no_relink = (
        "use only the given tracks: do not search the images for further observations of the landmarks, such as "
        "before they joined the map"
    )
    add("--no-relink", action="store_true", help=no_relink)
    scheduler = (
        "Dask scheduler, such as tcp://host:8786, whose workers see the sessions and OUT under the same paths; "
        "local: start one on this machine; needs the extra [cluster]"
    )
    add("--scheduler", metavar="ADDRESS", help=scheduler)
    add("--workers", type=int, metavar="N", help="worker processes of --scheduler local; default: number of cores")


def _smooth(a: argparse.Namespace) -> int:
    from hardware.files.session import check_exists

    if len(a.sessions) == 1:  # of several, a missing one does not stop the others
        check_exists(a.sessions[0])
    from hardware.offline.smooth import Cluster, SmoothOptions, run_smooth

    if a.workers is not None and a.scheduler != "local":
        raise option_error("--workers", a.workers, "with --scheduler local")
    cluster = None if a.scheduler is None else Cluster(a.scheduler, a.workers)
    options, failed = SmoothOptions(a.rate, a.refine_cameras, relink=not a.no_relink), 0
    for outcome in run_smooth(a.sessions, a.out, options, cluster):
        print(f"{outcome.job.session}: not smoothed: {outcome.text}" if outcome.failed else outcome.text, flush=True)
        failed += outcome.failed or bool(outcome.damage)
    return FAILED if failed else 0


def add_compare(commands: Commands) -> None:
    """Add the sub-command `compare`."""
    add = commands.add(
        "compare",
        _compare,
        "compare a trajectory with a reference: APE, RPE, NEES",
        "Compare poses with reference poses of the same instants, with the error figures of evo: absolute and\n"
        "relative errors, translation and rotation, unaligned and aligned (without scale); and NEES if there are\n"
        "covariances. A and B: a TUM or CSV file, an .mcap file, or a folder written by stillbed. Poses of an\n"
        ".mcap file: FILE:smoothed, FILE:pose or FILE:truth, in this order for A, in the opposite one for B.\n"
        "With -o, writes report.html and compare.json.",
        "stillbed compare out/smoothed out/calm/session/truth.tum -o out/compared",
    ).add_argument
    add("estimated", metavar="A", help="estimated poses")
    add("reference", metavar="B", nargs="?", help="reference poses; default: the truth in A")
    add("--delta", type=int, default=1, metavar="N", help="step of the relative errors, in poses; default 1")
    add("-o", "--out", type=Path, help="output folder for report.html and compare.json")


def _compare(a: argparse.Namespace) -> int:
    from hardware.offline.compare import run_compare
    from hardware.offline.trajectory_files import poses_damage

    print(run_compare(a.estimated, a.reference, a.delta, a.out))
    return max(damage_code(poses_damage(name)) for name in (a.estimated, a.reference) if name is not None)


def add_view(commands: Commands) -> None:
    """Add the sub-command `view`."""
    add = commands.add(
        "view",
        _view,
        "show a recorded session in a browser, with a time slider",
        "Show a recorded or smoothed session in a browser on this machine: the cameras' pictures with the\n"
        "tracks, a 3D view of surface, cameras, trajectory, path and nozzle, and the tracking state, at any time.\n"
        "Prints the address to open. Writes nothing. Ctrl-C ends it.",
        "stillbed view out/smoothed",
    ).add_argument
    session_help = "session folder, .mcap file, or output folder of `stillbed smooth`"
    add("session", type=Path, metavar="SESSION", help=session_help)
    add("--poses", metavar="FILE", help="poses to show instead of the recording's; formats as for `stillbed compare`")
    add("--path", type=Path, metavar="PATH.csv", help="printing path, if the recording has none")
    add("--port", type=int, default=0, metavar="N", help="port of 127.0.0.1; default: any free port")
    add("--open", action="store_true", help="open the page in a browser")


def _view(a: argparse.Namespace) -> None:
    from hardware.files.session import check_exists

    check_exists(a.session)
    from hardware.offline.viewer import run_view

    run_view(a.session, a.poses, a.path, a.port, a.open)
