"""The trained wound network, run by onnxruntime, and how it is shown a picture: first whole, then the wound enlarged.

Half the wounds of the training pictures are smaller than 43 px of 512, so half a pixel at their edge costs several
points of Dice. The second pass sees each wound at a size that does not depend on the camera's distance. The network is
loaded once, checked against its settings file, and runs on few threads.
"""

from __future__ import annotations

import hashlib
import sys
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime
from numpy.typing import NDArray

from estimation.errors import InputError
from perception import shipped_file

Network = Callable[[NDArray[np.float32]], NDArray[np.float32]]  # (1, 3, H, W) RGB in 0..1 -> (1, 1, H, W) logits

SIZE_STEP_PX = 32  # the network halves its input five times


@dataclass(frozen=True, slots=True)
class Looks:
    """How the two looks are taken."""

    long_side: int = 320  # px of the first look
    window: int = 224  # px, side of the second look; 0: there is none
    share: float = 0.9  # of the window's side that the found place takes
    largest_zoom: float = 2.5  # beyond this the picture holds nothing more
    found: float = 0.3  # probability from which a place of the first look is looked at again
    second_weight: float = 0.75  # of the second look's logits where both looked


def wound_logits(picture: NDArray[np.uint8], network: Network, looks: Looks) -> NDArray[np.float32]:
    """(H, W) logits of "wound" for a picture (H, W, 3) RGB."""
    scale = min(1.0, looks.long_side / max(picture.shape[:2]))  # a small piece, enlarged, is no whole picture
    height, width = (max(SIZE_STEP_PX, SIZE_STEP_PX * round(side * scale / SIZE_STEP_PX)) for side in picture.shape[:2])
    first = _look(picture, network, (height, width))
    box = box_round(first > np.log(looks.found / (1 - looks.found))) if looks.window else None
    if box is None:
        return first
    rows, columns = window(box, picture.shape[:2], looks)
    second = _look(picture[rows, columns], network, (looks.window, looks.window))
    first[rows, columns] += looks.second_weight * (second - first[rows, columns])
    return first


def window(box: NDArray[np.float64], size: tuple[int, int], looks: Looks) -> tuple[slice, slice]:
    """Rows and columns of the second look at a box [top, left, bottom, right], moved and cut so that it lies inside
    the picture of `size` (H, W)."""
    middle = (box[:2] + box[2:]) / 2
    side = max(np.max(box[2:] - box[:2]) / looks.share, looks.window / looks.largest_zoom)
    spans = []
    for centre, full in zip(middle, size, strict=True):
        length = int(min(round(side), full))
        start = int(np.clip(round(centre - length / 2), 0, full - length))
        spans.append(slice(start, start + length))
    return spans[0], spans[1]


def _look(picture: NDArray[np.uint8], network: Network, size: tuple[int, int]) -> NDArray[np.float32]:
    """Logits at the picture's own size, seen at `size` (H, W)."""
    shrinks = picture.shape[0] > size[0]
    seen = cv2.resize(picture, size[::-1], interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    logits = network(np.ascontiguousarray(seen.transpose(2, 0, 1)[None], np.float32) / np.float32(255))[0, 0]
    return np.asarray(cv2.resize(logits, picture.shape[1::-1], interpolation=cv2.INTER_LINEAR), np.float32)


def box_round(mask: NDArray[np.bool_]) -> NDArray[np.float64] | None:
    """Box [top, left, bottom, right] round a mask (H, W); None where it is empty."""
    rows, columns = (np.flatnonzero(mask.any(axis)) for axis in (1, 0))
    if len(rows) == 0:
        return None
    return np.array([rows[0], columns[0], rows[-1] + 1, columns[-1] + 1], np.float64)


SHIPPED_MODEL = "wound"
THESIS_MODEL = "thesis_unet"
NETWORK_THREADS = 2
MAX_SETTING = sys.float_info.max
NOT_STATED = "not stated"
OWN_NETWORK = "an ONNX file written by stillbed train"


@dataclass(frozen=True, slots=True)
class Settings:
    """What was chosen with the network, by networks of its kind that never saw the pictures it was chosen on."""

    looks: Looks = field(default_factory=Looks)  # how it is shown a picture
    edge: float = 0.5  # probability at a wound's edge
    smallest: float = 0.02  # share of the largest part's area below which another part is dropped
    trust: float = 0.5  # confidence below which there is no wound
    slope: float = 1.0  # of the logistic that turns the mean logit of the mask's pixels into a confidence
    offset: float = 0.0  # of the same
    pixel_slope: float = 1.0  # of the logistic by which a logit says how often such a pixel is a wound's
    pixel_offset: float = 0.0  # of the same
    spread: float = 2.0  # half a 95 % interval of the area, in half bands of probability (`WoundBand`): so labels ask


@dataclass(frozen=True, slots=True)
class NetworkTerms:
    """What a network is called, under which licence it may be used, and what it was made of, as its settings say."""

    name: str
    licence: str = NOT_STATED
    source: str = NOT_STATED

    def __str__(self) -> str:
        return f"{self.name}; licence: {self.licence}; source: {self.source}"


class WoundNetwork:
    """A session of onnxruntime; logits of pictures, from one thread at a time."""

    def __init__(self, file: Path, threads: int = NETWORK_THREADS) -> None:
        """file: NAME.onnx, beside it NAME.toml with its hash and settings. InputError: missing, damaged, not ours."""
        self.size = file.stat().st_size if file.is_file() else 0  # bytes
        self.sha256 = hash_of(file)
        self.settings = read_settings(file.with_suffix(".toml"), self.sha256)
        self.terms = read_terms(file.with_suffix(".toml"))
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
        # a pool that spins takes the core that the tracker runs on: two threads were then slower than one
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        # weights are stored in 8 bits and made real numbers once, when they are loaded, not anew for every picture
        options.add_session_config_entry("session.disable_quant_qdq", "1")
        options.log_severity_level = 3
        try:
            self._session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's own classes share no base
            raise InputError(file, "network", str(error).splitlines()[0], OWN_NETWORK) from None
        self._input = self._session.get_inputs()[0].name

    def __call__(self, planes: NDArray[np.float32]) -> NDArray[np.float32]:
        """(1, 3, H, W) RGB in 0..1, H and W multiples of 32 -> (1, 1, H, W) logits."""
        return np.asarray(self._session.run(None, {self._input: planes})[0], np.float32)


def shipped_model(name: str = SHIPPED_MODEL, suffix: str = ".onnx") -> Path:
    """A model that comes with stillbed; InputError where the installation lacks it."""
    return shipped_file("models", f"{name}{suffix}")


def read_settings(file: Path, sha256: str) -> Settings:
    """The settings of the network with this SHA-256; InputError where they are missing or another network's."""
    try:
        table = tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        allowed = "the TOML file that stillbed train writes beside a network"
        raise InputError(file, "settings", str(error), allowed) from None
    if table.get("sha256") != sha256:
        raise InputError(file.with_suffix(".onnx"), "sha256", sha256, f"{table.get('sha256')}, as {file.name} says")
    looks = Looks(**_checked_fields(file, Looks, table.get("looks", {})))
    plain = {key: value for key, value in table.items() if key not in ("sha256", "looks", *TERMS_KEYS)}
    return Settings(looks=looks, **_checked_fields(file, Settings, plain))


TERMS_KEYS = ("licence", "source")  # texts about the network, which may be left out


def read_terms(file: Path) -> NetworkTerms:
    """What a settings file that was read says of the network beside it; InputError where that is no text."""
    table = tomllib.loads(file.read_text(encoding="utf-8"))
    texts = {key: table[key] for key in TERMS_KEYS if key in table}
    for key, value in texts.items():
        if not isinstance(value, str):
            raise InputError(file, key, value, "a text")
    return NetworkTerms(file.stem, **texts)


def _checked_fields(file: Path, kind: type, table: Any) -> dict[str, Any]:
    """A table's values for a dataclass of plain fields, each checked for its type and to be finite."""
    usual = kind()
    for key, value in table.items():
        kind_of = type(getattr(usual, key, None))
        if isinstance(value, bool) or kind_of not in (int, float) or not isinstance(value, (kind_of, int)):
            raise InputError(file, key, value, f"a setting of {kind.__name__}")
        if not abs(value) <= MAX_SETTING:  # nan is not either
            raise InputError(file, key, value, "a finite number")
    return {key: type(getattr(usual, key))(value) for key, value in table.items()}


def hash_of(file: Path) -> str:
    """SHA-256 of a network's file, hexadecimal; InputError where there is none."""
    if not file.is_file():
        raise InputError(file, "network", "no such file", OWN_NETWORK)
    return hashlib.sha256(file.read_bytes()).hexdigest()
