"""What a run has before its processes start: files checked, a scenario rendered, an earlier run taken up.

A run leaves these files beside its recording, run.mcap:

run.session.toml     the settings of the run, with whole paths
run.progress.toml    how far the print is
run.surface.toml     where the path lies on the surface, and which recording shows that surface to a run that resumes
run.executed.npz     of a virtual arm: where it was
run.report.html, run.summary.json
"""

from __future__ import annotations

import math
import os
import re
import shutil
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path as File
from typing import Any

from estimation import se3
from estimation.errors import InputError, StillbedError
from estimation.rig import Rig
from estimation.se3 import Array
from hardware.arm.profile import ArmProfile, far_limits_text
from hardware.dispenser.dispenser import check_path_materials
from hardware.files.arm_file import arm_over, read_arm
from hardware.files.dispenser_file import (
    arm_with_dispensers,
    check_arm_moves,
    dispensers_from_text,
    drivers_of,
    outlets_from,
    read_dispensers,
)
from hardware.files.path_file import read_path, read_progress
from hardware.files.region_table import check_region
from hardware.files.rig_file import RIG_FILE, read_rig, scan_of
from hardware.live.checklist import PrintTask, guarded_tissue
from hardware.live.settings import (
    VIRTUAL_ARM,
    LiveSettings,
    check_settings,
    looks_between,
    override_settings,
    page_settings,
    read_settings,
)
from hardware.process import checks
from hardware.process.faults import Fault, FaultPart, FaultRunner, check_faults
from hardware.process.progress import UNFINISHED, cache_error, cache_folder, cached, check_apart
from hardware.process.system import SPAWN, blocked_sigint
from hardware.recording.messages import rig_from_message
from planning.laid_beads import path_with_looks
from planning.material import Outlets, with_offsets
from planning.path import Path

RENDERED = File("session.mcap")  # of a scenario: the session in its folder, which holds no scan


class RunFiles:
    """The files of a run, beside its recording and named after it."""

    def __init__(self, record: File) -> None:
        def beside(end: str) -> File:
            return record.with_name(f"{record.stem}.{end}")

        self.record = record
        self.session = beside("session.toml")  # the settings
        self.progress = beside("progress.toml")  # how far the print is
        self.surface = beside("surface.toml")  # where the path lies
        self.executed = beside("executed.npz")  # the motion of a virtual arm
        self.report = beside("report.html")
        self.summary = beside("summary.json")

    def next(self) -> RunFiles:
        """The files of the run that resumes this one: the next name that is free."""
        named = re.fullmatch(r"(.+)-([0-9]+)", self.record.stem)
        stem, number = (named[1], int(named[2]) + 1) if named else (self.record.stem, 2)
        while (file := self.record.with_name(f"{stem}-{number}.mcap")).exists():
            number += 1
        return RunFiles(file)


@dataclass(frozen=True, slots=True, eq=False)
class SurfacePlacement:
    """Where an earlier run placed its path."""

    map: File  # recording whose first sets show the surface
    until: float  # s, the last stamp of those sets
    surface_from_path: Array  # (4, 4) mm
    arm_from_base: Array  # (4, 4) mm
    since: float = -math.inf  # s, the first stamp of those sets
    certain: bool = False  # whether the operator had confirmed it, or a scan was found without doubt
    verdict: str = ""  # by what it was placed, in words


def placement_text(placement: SurfacePlacement) -> str:
    """The placement as TOML."""
    values = {
        "map": str(placement.map.resolve()),
        "until_s": float(placement.until),
        "surface_from_path": placement.surface_from_path,
        "arm_from_base": placement.arm_from_base,
        "certain": bool(placement.certain),
        "verdict": placement.verdict,
        "since_s": float(placement.since) if math.isfinite(placement.since) else None,
    }
    return "\n".join(checks.toml_lines(values)) + "\n"


def read_placement(file: File) -> SurfacePlacement:
    """The placement in a file; InputError where it makes no sense."""
    required = "map", "until_s", "surface_from_path", "arm_from_base"
    return checks.record_from_table(file, "", checks.read_toml(file), SurfacePlacement, PLACEMENT_KEYS, required)


def _recording(where: object, key: str, value: object) -> File:
    recording = File(checks.text(where, key, value))
    if not os.path.exists(recording):  # False for a name that no file can have, too
        raise InputError(where, key, recording, "the recording that shows the surface")
    return recording


def _pose(where: object, key: str, value: object) -> Array:
    pose = checks.numbers(where, key, value, (4, 4))
    if not se3.is_transform(pose):
        raise InputError(where, key, pose.tolist(), "a finite 4x4 rigid motion, mm")
    return pose


PLACEMENT_KEYS: checks.Keys = {
    "map": ("map", _recording),
    "until_s": ("until", checks.number),
    "surface_from_path": ("surface_from_path", _pose),
    "arm_from_base": ("arm_from_base", _pose),
    "since_s": ("since", checks.number),
    "certain": ("certain", checks.flag),
    "verdict": ("verdict", checks.any_text),
}


@dataclass(frozen=True, slots=True, eq=False)
class Prepared:
    """A run that can be started."""

    settings: LiveSettings  # as used
    session: File  # whose pictures are shown, or the rig file of live cameras
    rig: Rig
    again: bool  # whether the session is shown to and fro for ever; its truth is then exact
    virtual: File | None  # settings of a virtual arm, None for one that answers and is never at fault
    task: PrintTask
    scan: File | None  # that is registered: given, or of the rig file or session folder
    placement: SurfacePlacement | None  # of the run that is resumed, None of a new run
    files: RunFiles
    notes: tuple[str, ...]  # that the operator sees all the time
    faults: tuple[Fault, ...] = ()  # to be injected, before a simulated world alone

    @property
    def live(self) -> bool:
        """Whether live cameras are used, rather than a recorded session shown."""
        return self.session.suffix == ".toml"

    @property
    def inked(self) -> bool:
        """Whether the run has a dispenser, real or simulated."""
        return bool(self.task.dispensers) or self.settings.simulated is not None


def prepare(settings: LiveSettings, where: object, force: bool, faults: tuple[Fault, ...] = ()) -> Prepared:
    """A new run. InputError where a file makes no sense or the recording exists and `force` is not set.

    faults: to be injected, before simulated cameras and a simulated arm alone. Every input is checked before a scenario
    is rendered, and before anything of an earlier run is taken away.
    """
    settings = check_settings(settings, where)
    assert settings.record is not None
    files = RunFiles(settings.record)
    if settings.record.exists() and not force:
        raise InputError(where, "record.file", settings.record, "a new file, or --force: this one exists")
    if settings.rig is not None:
        check_apart("--record", settings.record, settings.rig)
    if not settings.record.parent.is_dir():
        raise InputError(where, "record.file", settings.record, "a file in a folder that exists")
    prepared = _prepared(settings, files, None, faults, where)
    for file in (files.progress, files.surface, files.executed, files.report, files.summary):
        file.unlink(missing_ok=True)  # an earlier run's, which nobody is to take for this one's
    return prepared


def prepare_resumed(record: File, flags: dict[str, Any], faults: tuple[Fault, ...] = ()) -> Prepared:
    """The run that goes on where the one recorded in `record` stopped, with its settings and what `flags` overrides.

    Whether it runs unattended is never taken over: nobody has looked at this run yet.
    """
    files = RunFiles(record)
    if not record.exists():
        raise InputError(record, "--resume", "no such file", "the recording of a run")
    if not files.session.exists():
        raise InputError(record, "--resume", f"no {files.session.name} beside it", "the recording of a run")
    settings = override_settings(replace(read_settings(files.session), unattended=False), flags)
    placement = read_placement(files.surface) if files.surface.exists() else None
    again = files.next()
    settings = check_settings(replace(settings, record=again.record), files.session)
    prepared = _prepared(settings, again, placement, faults, files.session)
    path, profile = prepared.task.path, prepared.task.profile
    start = read_progress(files.progress, path) if files.progress.exists() else 0.0
    if start >= len(path) - 1:
        raise InputError(files.progress, "fraction", start, f"below {len(path) - 1}: the path is printed")
    for earlier, later in ((files.progress, again.progress), (files.surface, again.surface)):
        if earlier.exists():  # before it comes as far itself, this run is where that one was
            shutil.copyfile(earlier, later)
    if placement is not None:
        profile = replace(profile, arm=replace(profile.arm, arm_from_base=placement.arm_from_base))
    task = replace(prepared.task, start=start, profile=profile, place=prepared.task.place and placement is None)
    if settings.adapt:
        from hardware.live.recorded_run import asked_flows, read_run  # loads OpenCV

        task = replace(task, flows=asked_flows(read_run(record, "/loop")))
    place = f"{100 * start / max(len(path) - 1, 1):.0f} %: checkpoint {start:.2f} of {len(path) - 1}"
    return replace(prepared, task=task, notes=(f"goes on at {place}, where {record.name} stopped", *prepared.notes))


def _prepared(
    settings: LiveSettings,
    files: RunFiles,
    placement: SurfacePlacement | None,
    faults: tuple[Fault, ...],
    where: object,
) -> Prepared:
    if settings.page:
        page_settings(settings, where)
    notes = [f"dry run, {settings.lift:g} mm above the path"] if settings.dry_run else []
    scenario, session, virtual = settings.simulated, settings.rig, None
    _check_live_faults(settings, faults)
    check_rig = partial(_check_rig, settings, faults, where)
    profile_given = None if settings.profile is None else read_arm(settings.profile)
    named = settings.path if settings.path is not None or scenario is None else _path_named_in(scenario)
    path = None if named is None else read_path(named)
    dispensers, outlets = _dispensers(settings, path, named)
    notes += _dispenser_notes(settings, dispensers)
    if settings.model is not None:
        from perception.wound.network import hash_of, read_settings  # loads onnxruntime

        read_settings(settings.model.with_suffix(".toml"), hash_of(settings.model))
    scan = scan_of(settings.scan, RENDERED if session is None else session)
    if scenario is not None:
        rendered = _rendered(scenario, check_rig)
        session, virtual = rendered / RENDERED, rendered / "virtual_arm.toml"
        profile_given = profile_given or arm_over(read_arm(rendered / "arm.toml"), settings.arm)
        path = read_path(rendered / "path.csv") if settings.path is None else path
        notes.append("simulated: pictures rendered before, shown in real time; the arm is not in them")
    assert session is not None and path is not None
    path, looks = path_with_looks(path, looks_between(settings), settings.dry_run, named or where)
    task = PrintTask(
        path=path,
        dispensers=dispensers,
        outlets=outlets,
        profile=arm_with_dispensers(profile_given or ArmProfile(), dispensers),
        place=profile_given is None,
        stands_home=settings.stands_home or settings.arm == VIRTUAL_ARM,
        virtual=settings.arm == VIRTUAL_ARM,
        lift=settings.lift if settings.dry_run else None,
        unattended=settings.unattended,
        patience=settings.patience,
        looks=looks,
    )
    if scan is not None:
        task = replace(task, tissue=guarded_tissue(scan, path, task.profile))
    rig, again = rig_from_session(session), scenario is not None
    check_rig(rig)
    notes += filter(None, [far_limits_text(task.profile.limits)])
    notes += [f"will happen: {fault}" for fault in faults]
    return Prepared(settings, session, rig, again, virtual, task, scan, placement, files, tuple(notes), faults)


def _check_rig(settings: LiveSettings, faults: tuple[Fault, ...], where: object, rig: Rig) -> None:
    """InputError where a fault or the region is of a camera that the rig has not."""
    check_faults(faults, FaultRunner.LIVE, "command line", "--fault", len(rig))
    check_region(where, settings.region, rig)


def _path_named_in(scenario: File) -> File | None:
    """The path that a scenario names; None where it names none, which whoever renders it says."""
    named = checks.read_toml(scenario).get("path")
    return scenario.parent / named if isinstance(named, str) and named else None


def _dispensers(settings: LiveSettings, path: Path | None, where: File | None) -> tuple[str, Outlets]:
    """The dispenser file's text and the materials' outlets, none in a dry run; InputError for what no dispenser can."""
    file = settings.dispensers
    if file is None or path is None or settings.dry_run:
        return "", {}
    dispensers_read = read_dispensers(file)
    check_arm_moves(dispensers_read, settings.arm, file)
    dispensers = drivers_of(dispensers_read, file)
    check_path_materials(dispensers, path, where)
    outlets = outlets_from(dispensers_read, file)
    with_offsets(path, outlets)
    selected = [dispensers.for_material(name) for name in dict.fromkeys(path.material[path.extrude].tolist())]
    if settings.unattended and len(set(map(id, selected))) < len(selected):
        allowed = "an operator, or a dispenser for each material: one carries several of this path's"
        raise InputError(file, "print.unattended", "true", allowed)
    if settings.adapt and not all(each is None or each.profile.metered for each in selected):
        raise InputError(file, "print.adapt", "true", "dispensers that are metered: others give one flow")
    return file.read_text(encoding="utf-8-sig"), outlets


def _dispenser_notes(settings: LiveSettings, dispensers: str) -> list[str]:
    if settings.dry_run:
        return []
    if not dispensers:
        adapted = ", and no flow is adapted" if settings.adapt else ""
        note = f"no dispenser is given: nothing is extruded{adapted}"
        return [] if settings.simulated is not None and not adapted else [note]
    warning = "has no watchdog: if this computer dies while it is on, it stays on until you switch it off"
    given = (each for each in dispensers_from_text(dispensers, "") if each.extruder is None)
    return [f"dispenser {each.profile.name} {warning}" for each in given if each.profile.watchdog is None]


def rig_from_session(session: File) -> Rig:
    """The cameras of a session folder, a recording or a rig file, without a look at its pictures."""
    if session.is_dir():
        return read_rig(session / RIG_FILE).rig
    if session.suffix == ".toml":
        return read_rig(session).rig
    from hardware.recording.mcap_file import ChunkMessages, parse, walk

    for part in walk(session):
        if isinstance(part, ChunkMessages):
            for stored in part.messages:
                if stored.topic == "/rig":
                    return rig_from_message(f"{session} /rig", parse(session, stored))
    raise InputError(session, "/rig", "no message", "a recording of stillbed's")


def _rendered(scenario: File, check_rig: Callable[[Rig], None]) -> File:
    """The folder of the scenario's pre-rendered session; rendering is done by a process that ends before the run.

    check_rig: is shown its cameras before it is rendered. StillbedError for a scenario that makes no sense.
    """
    with suppress(OSError):  # of a file that is not there; the process says it in words
        if (there := cached(scenario, cache_folder())).ready:
            return there.folder
    print(f"{scenario.name}: its pictures are rendered once, and found again by the next run", file=sys.stderr)
    answer, theirs = SPAWN.Pipe(duplex=False)
    process = SPAWN.Process(target=_render, args=(scenario, check_rig, theirs))
    with blocked_sigint():  # it is ended from here, and says nothing of its own
        process.start()
    theirs.close()
    try:
        folder, error = answer.recv()
    except EOFError:
        raise StillbedError(f"{scenario}: rendering ended before it was done") from None
    finally:  # Ctrl-C and SIGTERM come here as well, and wait for nothing
        process.kill()
        process.join()
        for half in cache_folder().glob(f"*{UNFINISHED}{process.pid}"):
            shutil.rmtree(half, ignore_errors=True)
    if error:
        raise StillbedError(error)
    return File(folder)


def _render(scenario: File, check_rig: Callable[[Rig], None], answer: Connection) -> None:
    from hardware.live.prerender import prerender  # loads all of the simulator
    from hardware.simulator.scenario import read_scenario

    cache = cache_folder()
    try:
        check_rig(read_scenario(scenario).known_rig)
        answer.send((str(prerender(scenario, cache).folder), ""))
    except StillbedError as error:
        answer.send(("", str(error)))
    except OSError as error:  # the disk is full
        answer.send(("", str(cache_error(cache, error))))


def _check_live_faults(settings: LiveSettings, faults: tuple[Fault, ...]) -> None:
    """InputError for faults of anything that is not simulated, or that cannot be."""
    check_faults(faults, FaultRunner.LIVE, "command line", "--fault")
    live = settings.simulated is None and settings.rig is not None and settings.rig.suffix == ".toml"
    if faults and (live or settings.arm != VIRTUAL_ARM):
        raise InputError("command line", "--fault", str(faults[0]), "with --simulated and a virtual arm alone")
    for fault in faults:
        if fault.part is FaultPart.PAGE and not settings.page:
            raise InputError("command line", "--fault", str(fault), "a run with the operator's page, without --no-page")
        if fault.part is FaultPart.ARM and math.isfinite(fault.duration):
            allowed = "no duration: a virtual arm is not plugged in again"
            raise InputError("command line", "--fault", str(fault), allowed)
