"""The port to an arm: bytes out and in without ever waiting, over anything that pyserial opens by its URL."""

from __future__ import annotations

import errno
import fcntl
import io
import os
import stat
import struct
import termios
from collections.abc import Callable
from typing import Protocol

import serial
from serial.tools import list_ports

from estimation.errors import InputError, StillbedError
from hardware.port_lock import PortLock

PATIENCE = 0.1  # s of a write, where it can wait at all: loop:// is gone after that
_CHUNK = 4096  # bytes: two seconds of answers


class UnpluggedError(StillbedError):
    """The device is not there, or not any more."""


class Port(Protocol):
    """What the arm's link needs of a line. Each may raise UnpluggedError."""

    def write(self, data: bytes) -> int:
        """Give out bytes without waiting; how many were taken, from the first on."""
        ...

    def read(self) -> bytes:
        """The bytes that have come."""
        ...

    def waiting(self) -> int:
        """Bytes taken that are not on the wire yet, as far as the system knows."""
        ...

    def close(self) -> None:
        """Let the device go."""
        ...


Opener = Callable[[], Port]  # UnpluggedError where the device is not there


class SerialPort:
    """A pyserial port, 8N1: a device's path, socket://, loop:// or another URL of pyserial's."""

    def __init__(self, url: str, baud: int) -> None:
        try:
            self._serial = serial.serial_for_url(url, baudrate=baud, timeout=0, write_timeout=0, exclusive=True)
        except ValueError as error:
            raise InputError("arm", "port", url, f"a device's path or a URL of pyserial's ({error})") from error
        except (serial.SerialException, OSError) as error:
            missing = error.errno == errno.ENOENT
            raise UnpluggedError(f"{url}: {os.strerror(errno.ENOENT).lower() if missing else error}") from error
        try:
            self._file: int | None = self._serial.fileno()
        except io.UnsupportedOperation:  # loop:// and others that are no file of the system's
            self._file, self._serial.write_timeout = None, PATIENCE
        self._device = self._file is not None and not stat.S_ISSOCK(os.fstat(self._file).st_mode)

    def write(self, data: bytes) -> int:
        """Give out bytes; a full buffer takes some of them, or none."""
        try:
            return int(self._serial.write(data)) if self._file is None else os.write(self._file, data)
        except BlockingIOError:
            return 0
        except (serial.SerialException, OSError) as error:
            raise UnpluggedError(str(error)) from error

    def read(self) -> bytes:
        """The bytes that have come."""
        try:
            if self._file is None:
                return bytes(self._serial.read(self._serial.in_waiting))
            if self._device and not self._asked(termios.FIONREAD):
                return b""  # reading would say the same of a device that is gone
            data = os.read(self._file, _CHUNK)
        except BlockingIOError:
            return b""
        except (serial.SerialException, OSError) as error:
            raise UnpluggedError(str(error)) from error
        if not data:
            raise UnpluggedError("the other end has closed the line")
        return data

    def waiting(self) -> int:
        """Bytes in the system's output buffer; 0 of a pseudo-terminal, whose buffer does not tell."""
        if self._file is None:
            return 0
        try:
            return self._asked(termios.TIOCOUTQ)
        except OSError:
            return 0

    def close(self) -> None:
        """Close the device."""
        self._serial.close()

    def _asked(self, question: int) -> int:
        assert self._file is not None
        answer: int = struct.unpack("i", fcntl.ioctl(self._file, question, b"\0\0\0\0"))[0]
        return answer


class Device:
    """Opens one device, and that very one again when it has been away; nobody else may meanwhile.

    A USB adapter is known by its ids and serial number, or by its socket where it has no number: it may come back under
    another name. Anything else, a link of /dev/serial/by-id too, is known by its name.
    """

    def __init__(self, url: str, baud: int) -> None:
        self._url, self._baud = url, baud
        self._identity = _identity(url)
        self._lock: PortLock | None = None

    def __call__(self) -> SerialPort:
        """Open it; UnpluggedError where it is not there, InputError where another program has it."""
        url = self._url if self._identity is None else _place(self._identity)
        if self._lock is None or self._lock.url != url:
            self.release()
            self._lock = PortLock(url)
        try:
            return SerialPort(url, self._baud)
        except UnpluggedError as error:
            if "exclusively lock" in str(error):
                raise InputError("arm", "port", url, "a port that no other program has open") from error
            raise

    def release(self) -> None:
        """Let others have it."""
        if self._lock is not None:
            self._lock.release()
        self._lock = None


def serial_ports() -> list[tuple[str, str]]:
    """The serial ports that the system shows now, as (device, what it calls itself); none that leads nowhere."""
    return [(port.device, port.description or "unnamed") for port in list_ports.comports() if port.hwid != "n/a"]


Identity = tuple[int, int, str]  # vendor, product, serial number or place on the bus


def _identity(url: str) -> Identity | None:
    """What a USB adapter is known by; None for anything else."""
    if "://" in url or "/by-" in url:
        return None
    return next((known for path, known in _adapters() if path == os.path.realpath(url)), None)


def _place(identity: Identity) -> str:
    """The path under which an adapter is there now; UnpluggedError where it is not."""
    path = next((path for path, known in _adapters() if known == identity), None)
    if path is None:
        raise UnpluggedError(f"no adapter {identity[0]:04x}:{identity[1]:04x} {identity[2]} is plugged in")
    return path


def _adapters() -> list[tuple[str, Identity]]:
    return [
        (port.device, (port.vid, port.pid, port.serial_number or f"at {port.location}"))
        for port in list_ports.comports()
        if port.vid is not None
    ]
