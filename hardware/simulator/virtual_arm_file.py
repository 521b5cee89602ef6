"""A virtual arm as a file: its table [arm], as a scenario has it, and its faults."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from estimation.errors import InputError
from hardware.process import checks
from hardware.process.faults import Fault, Part, Runner, check_faults, faults_from_texts
from hardware.simulator.arm.settings import ArmSettings, arm_settings_from_table, table_from_arm_settings


def write_virtual_arm(file: Path, settings: ArmSettings, faults: tuple[Fault, ...]) -> None:
    """Write what `read_virtual_arm` reads back as the same."""
    lines = [f"faults = {json.dumps([str(fault) for fault in faults])}", "[arm]"]
    for key, value in table_from_arm_settings(settings).items():
        lines.append(f"{key} = {checks.toml_numbers(value) if isinstance(value, np.ndarray) else json.dumps(value)}")
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_virtual_arm(file: Path) -> tuple[ArmSettings, tuple[Fault, ...]]:
    """Settings and faults of a virtual arm; InputError names the key that is wrong."""
    table = checks.read_toml(file)
    checks.check_keys(file, "", table, ("faults", "arm"))
    if not isinstance(table["arm"], dict):
        raise InputError(file, "arm", table["arm"], "a table [arm]")
    faults = faults_from_texts(file, "faults", table["faults"], Part.ARM)
    check_faults(faults, Runner.ARM, file, "faults")
    return arm_settings_from_table(file, table["arm"]), faults
