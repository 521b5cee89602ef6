"""The port to an arm: frames out, answers in, without ever waiting, over anything that pyserial opens by its URL.

Two programs can never write to one arm, and a crash leaves nothing to clean up. The lock file is where terminal
programs look for theirs (LCK..NAME in the folder for locks, the owner's process number in its first line), so minicom
and others respect it. Between two of ours the kernel's lock on the open file decides, which ends with its process. A
process number left by a crash, or reused since, stops nobody.

HTTP as a line: a message is a request, `GET /on?ul_s=2.5` or `POST /switch on=1`, and its answer is the body. A thread
of its own makes the requests one after the other, so that nobody else waits. While one is under way the port takes
nothing, so what waits stays with the driver, where an off overtakes it.
"""

from __future__ import annotations

import errno
import fcntl
import io
import os
import stat
import struct
import tempfile
import termios
import threading
from collections.abc import Callable
from contextlib import closing, suppress
from importlib import import_module
from pathlib import Path
from typing import Protocol
from urllib.parse import urlsplit

import serial
from serial.tools import list_ports

from estimation.errors import InputError
from hardware.arm.driver import UnpluggedError
from hardware.process.clock import WallClock

LOCK_FOLDERS = ("/run/lock", "/var/lock")  # of the Filesystem Hierarchy Standard, new and old
LOCK_OWNER = "stillbed"


class PortLock:
    """Holds `url` from construction until `release`, or until the process ends. InputError where somebody has it."""

    def __init__(self, url: str, folder: Path | None = None) -> None:
        self.url = url
        path = (folder or lock_folder()) / f"LCK..{_name(url)}"
        try:
            self._file: int | None = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise InputError("arm", "port", url, f"a port whose lock {path} this user may write ({error})") from error
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            owner = _owner(self._file)
            os.close(self._file)
            raise InputError("arm", "port", url, f"a port that is free; process {owner[0]} has it") from error
        process, program = _owner(self._file)
        if process and program != LOCK_OWNER and process != os.getpid() and _process_exists(process):
            os.close(self._file)
            raise InputError("arm", "port", url, f"a port that is free; process {process} has it by {path}")
        os.ftruncate(self._file, 0)
        os.pwrite(self._file, f"{os.getpid():10d}\n{LOCK_OWNER}\n".encode(), 0)

    def release(self) -> None:
        """Let the port go; the file stays and says nothing, as removing it would race with the next owner."""
        if self._file is not None:
            os.ftruncate(self._file, 0)
            os.close(self._file)
        self._file = None


def lock_folder() -> Path:
    """Where locks are kept: the first usual place that can be written to."""
    usable = (Path(name) for name in LOCK_FOLDERS if os.access(name, os.W_OK))
    return next(usable, Path(tempfile.gettempdir()))


def _name(url: str) -> str:
    """A file name for a port: of a device what it is called below /dev, whichever link it was reached by."""
    path = url if "://" in url else os.path.realpath(url).removeprefix("/dev/")
    return path.replace("/", "_").replace(":", "_")


def _owner(file: int) -> tuple[int, str]:
    """Process number, 0 if there is none, and the program that a lock file names."""
    fields = os.pread(file, 100, 0).decode("ascii", "replace").split()
    number = int(fields[0]) if fields and fields[0].isdigit() else 0
    return number, fields[1] if len(fields) > 1 else ""


def _process_exists(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True


LOOP_WRITE_TIMEOUT = 0.1  # s of a write, where it can wait at all: loop:// is gone after that
READ_BYTES = 4096  # at once: two seconds of answers


class PortTakenError(UnpluggedError):
    """Another program has the device to itself."""


class Port(Protocol):
    """What the arm's link needs of a line. Each may raise UnpluggedError."""

    def write(self, data: bytes) -> int:
        """Give out bytes without waiting; how many of them, from the first on."""
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


LINE_TAKEOVER_TIME = 0.5  # s in which the kernel takes the line from a process that was killed
TAKEOVER_RETRY_PERIOD = 0.002  # s between tries
CLOSE_TIME = 0.1  # s in which a line takes what was given to it: a stop's two frames at 9600 bits/s


class SerialPort:
    """A pyserial port, 8N1: a device's path, socket://, loop:// or another URL of pyserial's."""

    def __init__(self, url: str, baud: int) -> None:
        try:
            self._serial = serial.serial_for_url(url, baudrate=baud, timeout=0, write_timeout=0, exclusive=True)
        except ValueError as error:
            raise InputError("arm", "port", url, f"a device's path or a URL of pyserial's ({error})") from error
        except (serial.SerialException, OSError) as error:
            missing, locked = error.errno == errno.ENOENT, error.errno == errno.EAGAIN  # of pyserial's lock
            fault = PortTakenError if locked else UnpluggedError
            raise fault(f"{url}: {os.strerror(errno.ENOENT).lower() if missing else error}") from error
        try:
            self._file: int | None = self._serial.fileno()
        except io.UnsupportedOperation:  # loop:// and others that are no file of the system's
            self._file, self._serial.write_timeout = None, LOOP_WRITE_TIMEOUT
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
            if self._device and not self._queried_count(termios.FIONREAD):
                return b""  # reading would say the same of a device that is gone
            data = os.read(self._file, READ_BYTES)
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
            return self._queried_count(termios.TIOCOUTQ)
        except OSError:
            return 0

    def close(self) -> None:
        """Close the device; what the line has not taken after CLOSE_TIME is discarded.

        The system would wait for it, 30 s by default, and nobody could stop the arm meanwhile.
        """
        clock = WallClock()
        deadline = clock.now() + CLOSE_TIME
        while self.waiting() and clock.now() < deadline:
            clock.wait_until(clock.now() + CLOSE_TIME / 50)
        if self._device and self._file is not None and self.waiting():
            with suppress(OSError, termios.error):  # of a device that is gone
                termios.tcflush(self._file, termios.TCOFLUSH)
        self._serial.close()

    def _queried_count(self, request: int) -> int:
        assert self._file is not None
        answer: int = struct.unpack("i", fcntl.ioctl(self._file, request, b"\0\0\0\0"))[0]
        return answer


class PortOpener:
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
        except PortTakenError as error:
            raise InputError("arm", "port", url, "a port that no other program has open") from error

    def release(self) -> None:
        """Let others have it."""
        if self._lock is not None:
            self._lock.release()
        self._lock = None


def write_last(url: str, baud: int, data: bytes, wire: float) -> tuple[float, str]:
    """Write `data` to the line of a process that was killed, as soon as the kernel has taken it from there.

    wire: s that it takes to the arm. When it was there, s, and why it was not, "" if it was.
    """
    clock, device = WallClock(), PortOpener(url, baud)
    deadline, reason = clock.now() + LINE_TAKEOVER_TIME, ""
    try:
        while clock.now() < deadline:
            try:
                with closing(device()) as port:
                    unsent = data
                    while (unsent := unsent[port.write(unsent) :]) and clock.now() < deadline:
                        clock.wait_until(clock.now() + TAKEOVER_RETRY_PERIOD)
                    if not unsent:
                        sent = clock.now() + wire
                        clock.wait_until(sent + wire)
                        return sent, ""
                    written = len(data) - len(unsent)
                    reason = f"its line is full and took {written} of the stop's {len(data)} bytes"
            except (InputError, UnpluggedError) as error:
                reason = str(error)
                clock.wait_until(clock.now() + TAKEOVER_RETRY_PERIOD)
    finally:
        device.release()
    return clock.now(), reason


def serial_ports() -> list[tuple[str, str]]:
    """The serial ports that the system shows now, as (device, what it calls itself); none that leads nowhere."""
    return [(port.device, port.description or "unnamed") for port in list_ports.comports() if port.hwid != "n/a"]


Identity = tuple[int, int, str]  # vendor, product, serial number or place on the bus


def _identity(url: str) -> Identity | None:
    """What a USB adapter is known by; None for anything else."""
    if "://" in url or "/by-" in url:
        return None
    return next((identity for path, identity in _adapters() if path == os.path.realpath(url)), None)


def _place(identity: Identity) -> str:
    """The path under which an adapter is there now; UnpluggedError where it is not."""
    path = next((path for path, candidate in _adapters() if candidate == identity), None)
    if path is None:
        raise UnpluggedError(f"no adapter {identity[0]:04x}:{identity[1]:04x} {identity[2]} is plugged in")
    return path


def _adapters() -> list[tuple[str, Identity]]:
    return [
        (port.device, (port.vid, port.pid, port.serial_number or f"at {port.location}"))
        for port in list_ports.comports()
        if port.vid is not None
    ]


HTTP_PORT = 80
MAX_BODY = 4096  # bytes of an answer that are read


def is_http(url: str) -> bool:
    """Whether a port is reached by HTTP."""
    return url.startswith("http://")


class HttpOpener:
    """Opens the way to one device; there is nothing to lock, and nothing is sent. InputError for no such URL."""

    def __init__(self, url: str, timeout: float) -> None:
        try:
            parts = urlsplit(url)
            self._host, self._number = parts.hostname or "", parts.port or HTTP_PORT
        except ValueError:
            self._host, parts = "", urlsplit("")
        if not self._host or parts.path not in ("", "/") or parts.query:
            raise InputError("dispenser", "port", url, "http://HOST or http://HOST:PORT; the path is in the messages")
        self._timeout = timeout

    def __call__(self) -> HttpPort:
        """A port; whether the device is there shows with the first request."""
        return HttpPort(self._host, self._number, self._timeout)

    def release(self) -> None:
        """Nothing is held."""


class HttpPort:
    """One request at a time, by a thread that ends with `close`."""

    def __init__(self, host: str, number: int, timeout: float) -> None:
        import_module("http.client")  # here and not with the first request; ports of other kinds need none of it
        self._host, self._number, self._timeout = host, number, timeout
        self._change = threading.Condition()
        self._request, self._answers, self._error, self._open = b"", b"", "", True
        threading.Thread(target=self._work, name=f"http {host}", daemon=True).start()

    def write(self, data: bytes) -> int:
        """Take a whole message, or nothing while one is under way. UnpluggedError after one that failed."""
        with self._change:
            self._check()
            if self._request:
                return 0
            self._request = bytes(data)
            self._change.notify()
        return len(data)

    def read(self) -> bytes:
        """The answers that have come, a line end after each. UnpluggedError after a request that failed."""
        with self._change:
            self._check()
            answers, self._answers = self._answers, b""
        return answers

    def waiting(self) -> int:
        """Bytes of the request that is under way."""
        with self._change:
            return len(self._request)

    def close(self) -> None:
        """Make no further request; one under way ends by itself."""
        with self._change:
            self._open = False
            self._change.notify()

    def _check(self) -> None:
        if self._error:
            raise UnpluggedError(self._error)

    def _work(self) -> None:
        while True:
            with self._change:
                self._change.wait_for(lambda: self._request or not self._open)
                if not self._open:
                    return
                request = self._request
            answer, error = self._ask(request.decode("ascii").strip())
            with self._change:
                self._answers += answer + b"\n"
                self._request, self._error = b"", error

    def _ask(self, text: str) -> tuple[bytes, str]:
        """The body of the answer, and why there is none."""
        import http.client

        method, _, rest = text.partition(" ")
        path, _, body = rest.partition(" ")
        line = http.client.HTTPConnection(self._host, self._number, timeout=self._timeout)
        try:
            line.request(method, path, body or None)
            response = line.getresponse()
            answer = response.read(MAX_BODY)
        except (OSError, http.client.HTTPException, ValueError) as error:
            return b"", f"{text}: {error or type(error).__name__}"
        finally:
            line.close()
        return (answer, "") if response.status // 100 == 2 else (b"", f"{text}: HTTP {response.status}")
