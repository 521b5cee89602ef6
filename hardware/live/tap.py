"""A port that tells what passes it, and when."""

from __future__ import annotations

from collections.abc import Callable

from hardware.arm.port import Opener, Port

Heard = Callable[[bytes, bool], None]  # (bytes, whether they were sent rather than received)


class Tap:
    """An Opener whose ports tell `heard` of all bytes taken and given."""

    def __init__(self, opener: Opener, heard: Heard) -> None:
        self._opener, self._heard = opener, heard

    def __call__(self) -> Port:
        """Open the device."""
        return _Tapped(self._opener(), self._heard)


class _Tapped:
    def __init__(self, port: Port, heard: Heard) -> None:
        self._port, self._heard = port, heard

    def write(self, data: bytes) -> int:
        """Give out bytes without waiting; how many were taken."""
        taken = self._port.write(data)
        if taken:
            self._heard(data[:taken], True)
        return taken

    def read(self) -> bytes:
        """The bytes that have come."""
        data = self._port.read()
        if data:
            self._heard(data, False)
        return data

    def waiting(self) -> int:
        """Bytes taken that are not on the wire yet."""
        return self._port.waiting()

    def close(self) -> None:
        """Let the device go."""
        self._port.close()
