"""A camera's controls, locked and read back: what the driver did not take is named."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2

from hardware.cameras.sources import CameraSource

EXPOSURE_UNIT = 1e-4  # s: V4L2 counts an absolute exposure in 100 us
MANUAL_EXPOSURE, OFF = 1.0, 0.0  # V4L2_EXPOSURE_MANUAL; the other automatics are switches
TOLERANCE = 0.01  # a share: frame rates are told as fractions, white balance moves in steps of 10 K
UNSUPPORTED = -1.0  # what OpenCV's V4L2 backend answers for a control that the camera does not have


class ControlPort(Protocol):
    """What OpenCV's VideoCapture has: controls by number."""

    def set(self, control: int, value: float) -> bool:
        """Ask for a value; True promises nothing."""
        ...

    def get(self, control: int) -> float:
        """The value now."""
        ...


@dataclass(frozen=True, slots=True)
class Control:
    """One control. asked: None where nothing was. got: None where the camera does not have it. In rig.toml's units."""

    name: str
    asked: float | str | None
    got: float | str | None
    automatic: bool = False

    @property
    def taken(self) -> bool:
        """Whether the camera does what it was asked; also where it was asked nothing."""
        if self.asked is None:
            return True
        if isinstance(self.asked, str) or isinstance(self.got, str) or self.got is None:
            return self.asked == self.got
        near = abs(self.got - self.asked) <= max(TOLERANCE * abs(self.asked), self._step / 2)
        return near and not self.automatic

    @property
    def _step(self) -> float:
        return EXPOSURE_UNIT if self.name == "exposure_s" else 0.0

    def __str__(self) -> str:
        """In words, such as `gain 40, asked for 32`."""
        got = "not there" if self.got is None else f"{self.got:g}" if isinstance(self.got, float) else self.got
        asked = f"{self.asked:g}" if isinstance(self.asked, float) else self.asked
        words = f"{self.name} {got}" + " (automatic)" * self.automatic
        return words if self.taken else f"{words}, asked for {asked}"


@dataclass(frozen=True, slots=True)
class _Lockable:
    """A control of the camera's own. number, automatic: OpenCV's. off: value that ends the automatic. unit: of V4L2."""

    name: str
    number: int
    automatic: int | None = None
    off: float = OFF
    unit: float = 1.0


LOCKABLE = (
    _Lockable("exposure_s", cv2.CAP_PROP_EXPOSURE, cv2.CAP_PROP_AUTO_EXPOSURE, MANUAL_EXPOSURE, EXPOSURE_UNIT),
    _Lockable("gain", cv2.CAP_PROP_GAIN),
    _Lockable("focus_abs", cv2.CAP_PROP_FOCUS, cv2.CAP_PROP_AUTOFOCUS),
    _Lockable("white_balance_k", cv2.CAP_PROP_WB_TEMPERATURE, cv2.CAP_PROP_AUTO_WB),
)


def ask_picture(port: ControlPort, source: CameraSource, size: tuple[int, int] | None) -> None:
    """Ask a device for its format, size (W, H) px and rate: before the first frame, in this order."""
    if source.format is not None:
        port.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*source.format))
    if size is not None:
        port.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
        port.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
    if source.fps is not None:
        port.set(cv2.CAP_PROP_FPS, source.fps)


def lock(port: ControlPort, source: CameraSource) -> None:
    """End the automatics of what is asked for, and ask for it: an automatic that goes on would undo it."""
    for one, asked in zip(LOCKABLE, _asked(source), strict=True):
        if asked is not None:
            if one.automatic is not None:
                port.set(one.automatic, one.off)
            port.set(one.number, asked / one.unit)


def read_back(port: ControlPort, source: CameraSource) -> tuple[Control, ...]:
    """What a device has taken."""
    code = int(port.get(cv2.CAP_PROP_FOURCC))
    picture_format = "".join(chr(code >> 8 * i & 0xFF) for i in range(4)) if code > 0 else None
    rate = port.get(cv2.CAP_PROP_FPS)
    own = [_read_one(port, one, asked) for one, asked in zip(LOCKABLE, _asked(source), strict=True)]
    fps = Control("fps", source.fps, rate if rate > 0 else None)
    return (Control("format", source.format, picture_format), fps, *own)


def untaken(source: CameraSource) -> tuple[Control, ...]:
    """What was asked of a stream or a file, which takes nothing."""
    wanted = zip(LOCKABLE, _asked(source), strict=True)
    return tuple(Control(one.name, asked, None) for one, asked in wanted if asked is not None)


def locked_exposure(controls: Sequence[Control]) -> float:
    """The exposure that was read back, s; 0 where it is not locked, as an automatic one may be any."""
    for control in controls:
        if control.name == "exposure_s" and control.taken and not control.automatic and isinstance(control.got, float):
            return control.got
    return 0.0


def _read_one(port: ControlPort, one: _Lockable, asked: float | None) -> Control:
    value = port.get(one.number)
    if value == UNSUPPORTED:
        return Control(one.name, asked, None)
    return Control(one.name, asked, value * one.unit, _is_automatic(port, one))


def _is_automatic(port: ControlPort, one: _Lockable) -> bool:
    return one.automatic is not None and port.get(one.automatic) not in (one.off, UNSUPPORTED)


def _asked(source: CameraSource) -> tuple[float | None, ...]:
    """In the order of LOCKABLE."""
    return source.exposure, source.gain, source.focus, source.white_balance
