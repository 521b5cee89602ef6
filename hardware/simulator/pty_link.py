"""Pseudo-terminals: a device file that any serial client can open, and a link that sends bytes through one at once."""

from __future__ import annotations

import os
import pty
import select
import tty
from types import TracebackType

import serial

_CHUNK = 1024  # bytes; a pty buffers about 4000
_PATIENCE = 5.0  # s; bytes that are not back by then never come


def open_pty() -> tuple[int, int, str]:
    """A pty that changes no byte: descriptors of the arm's side and of the host's, and the host's device name.

    As long as the host's descriptor stays open here, clients may come and go.
    """
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    return ours, theirs, os.ttyname(theirs)


class PtyLink:
    """A pty with a serial client at one end, all in one process. name: of its device."""

    def __init__(self, baud: int = 115_200) -> None:
        self._ours, self._theirs, self.name = open_pty()
        self._client = serial.Serial(self.name, baudrate=baud)

    def transfer(self, data: bytes) -> bytes:
        """Write `data` to the device as a client does, and give back what comes out at the arm's side."""
        arrived = bytearray()
        for start in range(0, len(data), _CHUNK):
            self._client.write(data[start : start + _CHUNK])
            due = min(start + _CHUNK, len(data))
            while len(arrived) < due:
                if not select.select([self._ours], [], [], _PATIENCE)[0]:
                    raise TimeoutError(f"{self.name} gave {len(arrived)} of {len(data)} bytes back")
                arrived += os.read(self._ours, due - len(arrived))
        return bytes(arrived)

    def close(self) -> None:
        """Close both ends; the device goes."""
        self._client.close()
        for descriptor in (self._theirs, self._ours):
            os.close(descriptor)

    def __enter__(self) -> PtyLink:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()
