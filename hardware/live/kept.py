"""What a run used, as texts in its recording: what is read of them is what was used, so a replay has the same."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path as File

from estimation.errors import InputError
from hardware.arm.profile import ArmProfile
from hardware.files.arm_file import read_arm, write_arm
from hardware.files.path_file import read_path, write_path
from hardware.live.records import Begin
from hardware.recording.mcap_file import Attached, walk
from planning.path import Path

PATH, ARM = "path.csv", "arm.toml"


def kept_begin(order: Begin) -> tuple[dict[str, str], Begin]:
    """Path and arm of an order as texts, and the order with what is read of those texts."""
    with tempfile.TemporaryDirectory() as folder:
        write_path(File(folder) / PATH, order.path)
        write_arm(File(folder) / ARM, order.profile, "as a live run used it")
        texts = {name: (File(folder) / name).read_text(encoding="utf-8") for name in (PATH, ARM)}
    path, profile = used(texts, File("kept"))
    return texts, replace(order, path=path, profile=profile)


def used_in(record: File) -> tuple[Path, ArmProfile]:
    """Path and arm that a recorded run used; InputError where it did not begin to print."""
    attached = (part for part in walk(record) if isinstance(part, Attached))
    return used({part.name: part.data.decode("utf-8", "replace") for part in attached}, record)


def used(texts: Mapping[str, str], record: File) -> tuple[Path, ArmProfile]:
    """Path and arm of the texts of a recording; InputError where they are not there."""
    if PATH not in texts or ARM not in texts:
        raise InputError(record, "recording", "no path", "the recording of a run that began to print")
    with tempfile.TemporaryDirectory() as folder:
        for name in (PATH, ARM):
            (File(folder) / name).write_text(texts[name], encoding="utf-8")
        return read_path(File(folder) / PATH), read_arm(File(folder) / ARM)
