"""What a run needs before its processes start: files read and checked, a scenario rendered, an earlier run taken up."""

from __future__ import annotations

import math
import shutil
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path as File
from typing import Any

from estimation.errors import InputError, StillbedError
from estimation.rig import Rig
from hardware.arm.profile import ArmProfile
from hardware.bookmark_file import read_start
from hardware.cache_folder import cache_folder, not_written
from hardware.files.arm_file import read_arm
from hardware.files.path_file import read_path
from hardware.files.rig_file import read_rig
from hardware.live.beside import Beside, Found, read_found
from hardware.live.ipc import CONTEXT
from hardware.live.page_address import page_settings
from hardware.live.settings import VIRTUAL, LiveSettings, check_settings, overridden, read_settings
from hardware.live.state_machine import Task
from hardware.process.faults import Fault, Part, Runner, check_faults
from hardware.recording.mcap_file import ChunkOf, parse, walk
from hardware.recording.messages import rig_from_message

RIG_FILE = "rig.toml"


@dataclass(frozen=True, slots=True, eq=False)
class Prepared:
    """settings: as used. session: whose pictures are shown (to and fro for ever where `again`), or live cameras.

    virtual: what a virtual arm is like, None for one that answers. found: where an earlier run's path lies, None of a
    new run. notes: what one should know all the time. faults: what is to go wrong, before a simulated world alone.
    """

    settings: LiveSettings
    session: File
    rig: Rig
    again: bool
    virtual: File | None
    task: Task
    found: Found | None
    beside: Beside
    notes: tuple[str, ...]
    faults: tuple[Fault, ...] = ()

    @property
    def live(self) -> bool:
        """Whether cameras are looked through, rather than a recorded session shown."""
        return self.session.suffix == ".toml"


def prepare(settings: LiveSettings, where: object, force: bool) -> Prepared:
    """A new run. InputError where a file makes no sense or the recording exists and `force` is not set."""
    settings = check_settings(settings, where)
    if settings.page:
        page_settings(settings, where)
    assert settings.record is not None
    beside = Beside(settings.record)
    if settings.record.exists() and not force:
        raise InputError(settings.record, "--record", "a file that exists", "a new file, or --force")
    if not settings.record.parent.is_dir():
        raise InputError(settings.record, "--record", "no such folder", "a file in a folder that exists")
    for file in (beside.progress, beside.surface):
        file.unlink(missing_ok=True)
    return _prepared(settings, beside, None)


def prepare_again(record: File, flags: dict[str, Any]) -> Prepared:
    """The run that goes on where the one recorded in `record` stopped, with its settings and what `flags` overrides.

    That somebody confirms is asked anew: nobody has looked at this run yet, whoever did without at the one before.
    """
    beside = Beside(record)
    if not record.exists():
        raise InputError(record, "--resume", "no such file", "the recording of a run")
    if not beside.session.exists():
        raise InputError(record, "--resume", f"no {beside.session.name} beside it", "the recording of a run")
    settings = overridden(replace(read_settings(beside.session), unattended=False), flags)
    found = read_found(beside.surface) if beside.surface.exists() else None
    again = beside.next()
    settings = check_settings(replace(settings, record=again.record), beside.session)
    if settings.page:
        page_settings(settings, beside.session)
    prepared = _prepared(settings, again, found)
    path = prepared.task.path
    start = read_start(beside.progress, path) if beside.progress.exists() else 0.0
    if start >= len(path) - 1:
        raise InputError(beside.progress, "fraction", start, f"below {len(path) - 1}: the path is printed")
    for earlier, later in ((beside.progress, again.progress), (beside.surface, again.surface)):
        if earlier.exists():  # before it comes as far itself, this run is where that one was
            shutil.copyfile(earlier, later)
    profile = prepared.task.profile
    if found is not None:
        profile = replace(profile, arm=replace(profile.arm, arm_from_base=found.arm_from_base))
    task = replace(prepared.task, start=start, profile=profile, place=prepared.task.place and found is None)
    return replace(prepared, task=task)


def _prepared(settings: LiveSettings, beside: Beside, found: Found | None) -> Prepared:
    notes = [f"dry run, {settings.lift:g} mm above the path"] if settings.dry_run else []
    scenario, session, profile, path = settings.simulated, settings.rig, settings.profile, settings.path
    virtual: File | None = None
    if scenario is not None:
        rendered = _rendered(scenario)
        session, virtual = rendered / "session.mcap", rendered / "virtual_arm.toml"
        profile, path = profile or rendered / "arm.toml", path or rendered / "path.csv"
        notes.append("simulated: pictures rendered before, shown in real time; the arm is not in them")
    assert session is not None and path is not None
    task = Task(
        path=read_path(path),
        profile=ArmProfile() if profile is None else read_arm(profile),
        place=profile is None,
        stands_home=settings.stands_home or settings.arm == VIRTUAL,
        lift=settings.lift if settings.dry_run else None,
        unattended=settings.unattended,
        patience=settings.patience,
    )
    rig = rig_of(session)
    again = scenario is not None
    return Prepared(settings, session, rig, again, virtual, task, found, beside, tuple(notes))


def rig_of(session: File) -> Rig:
    """The cameras of a session folder, a recording or a rig file, without a look at its pictures."""
    if session.is_dir():
        return read_rig(session / RIG_FILE).rig
    if session.suffix == ".toml":
        return read_rig(session).rig
    for part in walk(session):
        if isinstance(part, ChunkOf):
            for stored in part.messages:
                if stored.topic == "/rig":
                    return rig_from_message(f"{session} /rig", parse(session, stored))
    raise InputError(session, "/rig", "no message", "a recording of stillbed's")


def _rendered(scenario: File) -> File:
    """The folder of the scenario's pre-rendered session; rendering is done by a process that ends before the run."""
    answer, theirs = CONTEXT.Pipe(duplex=False)
    process = CONTEXT.Process(target=_render, args=(scenario, theirs))
    process.start()
    theirs.close()
    try:
        folder, wrong = answer.recv()
    except EOFError:
        raise StillbedError(f"{scenario}: rendering ended before it was done") from None
    finally:
        process.join()
    if wrong:
        raise StillbedError(wrong)
    return File(folder)


def _render(scenario: File, answer: Connection) -> None:
    from hardware.live.prerender import prerender  # loads all of the simulator

    cache = cache_folder()
    try:
        answer.send((str(prerender(scenario, cache).folder), ""))
    except StillbedError as error:
        answer.send(("", str(error)))
    except OSError as error:  # the disk is full
        answer.send(("", str(not_written(cache, error))))


def with_faults(prepared: Prepared, faults: tuple[Fault, ...]) -> Prepared:
    """The run with what is to go wrong in it; InputError unless cameras and arm are simulated."""
    check_faults(faults, Runner.LIVE, "command line", "--fault", len(prepared.rig))
    if faults and (prepared.live or prepared.settings.arm != VIRTUAL):
        raise InputError("command line", "--fault", str(faults[0]), "with --simulated and a virtual arm alone")
    for fault in faults:
        if fault.part is Part.PAGE and not prepared.settings.page:
            raise InputError("command line", "--fault", str(fault), "a run with the operator's page, without --no-page")
        if fault.part is Part.ARM and math.isfinite(fault.duration):
            raise InputError(
                "command line", "--fault", str(fault), "no duration: a virtual arm is not plugged in again"
            )
    return replace(prepared, faults=faults, notes=(*prepared.notes, *(f"will happen: {fault}" for fault in faults)))
