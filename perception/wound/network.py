"""The trained wound network, run by onnxruntime: loaded once, checked against its settings file, on few threads."""

from __future__ import annotations

import hashlib
import sys
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from estimation.errors import InputError
from perception.coarse_to_fine import Looks
from perception.package_data import shipped_file

MODEL = "wound"
REFERENCE = "thesis_unet"
THREADS = 2
LARGEST = sys.float_info.max
OURS = "an ONNX file written by stillbed train"


@dataclass(frozen=True, slots=True)
class Settings:
    """What was chosen with the network, on pictures it was not trained on and not judged by.

    looks: how it is shown a picture. edge: probability at a wound's edge. smallest: share of
    the largest part's area below which another part is dropped. trust: confidence below which there is no wound.
    slope, offset: of the logistic that turns the mean logit of the mask's pixels into a confidence.
    """

    looks: Looks = field(default_factory=Looks)
    edge: float = 0.5
    smallest: float = 0.02
    trust: float = 0.5
    slope: float = 1.0
    offset: float = 0.0


class WoundNetwork:
    """A session of onnxruntime; logits of pictures, from one thread at a time."""

    def __init__(self, file: Path, threads: int = THREADS) -> None:
        """file: NAME.onnx, beside it NAME.toml with its hash and settings. InputError: missing, damaged, not ours."""
        self.size = file.stat().st_size if file.is_file() else 0  # bytes
        self.settings = read_settings(file.with_suffix(".toml"), hash_of(file))
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
        # a pool that spins takes the core that the tracker runs on: two threads were then slower than one
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.log_severity_level = 3
        try:
            self._session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's own classes share no base
            raise InputError(
                file, "network", str(error).splitlines()[0], "an ONNX file written by stillbed train"
            ) from None
        self._input = self._session.get_inputs()[0].name

    def __call__(self, planes: NDArray[np.float32]) -> NDArray[np.float32]:
        """(1, 3, H, W) RGB in 0..1, H and W multiples of 32 -> (1, 1, H, W) logits."""
        return np.asarray(self._session.run(None, {self._input: planes})[0], np.float32)


def shipped(name: str = MODEL, suffix: str = ".onnx") -> Path:
    """A model that comes with stillbed; InputError where the installation lacks it."""
    return shipped_file("models", f"{name}{suffix}")


def read_settings(file: Path, found: str) -> Settings:
    """The settings of the network whose SHA-256 is `found`; InputError where they are missing or another network's."""
    try:
        table = tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(
            file, "settings", str(error), "the TOML file that stillbed train writes beside a network"
        ) from None
    if table.get("sha256") != found:
        raise InputError(file.with_suffix(".onnx"), "sha256", found, f"{table.get('sha256')}, as {file.name} says")
    looks = Looks(**_of(file, Looks, table.get("looks", {})))
    plain = {key: value for key, value in table.items() if key not in ("sha256", "looks")}
    return Settings(looks=looks, **_of(file, Settings, plain))


def _of(file: Path, kind: type, table: Any) -> dict[str, Any]:
    """A table's values for a dataclass of plain fields, each checked for its type and to be finite."""
    usual = kind()
    for key, value in table.items():
        kind_of = type(getattr(usual, key, None))
        if isinstance(value, bool) or kind_of not in (int, float) or not isinstance(value, (kind_of, int)):
            raise InputError(file, key, value, f"a setting of {kind.__name__}")
        if not abs(value) <= LARGEST:  # nan is not either
            raise InputError(file, key, value, "a finite number")
    return {key: type(getattr(usual, key))(value) for key, value in table.items()}


def hash_of(file: Path) -> str:
    """SHA-256 of a network's file, hexadecimal; InputError where there is none."""
    if not file.is_file():
        raise InputError(file, "network", "no such file", OURS)
    return hashlib.sha256(file.read_bytes()).hexdigest()
