"""What the drivers of arms on a serial line share: the port, its lock, and a listener of all bytes that pass."""

from __future__ import annotations

from hardware.arm.driver import ArmDriver, ByteListener
from hardware.arm.port import Opener, Port, PortOpener


class SerialDriver(ArmDriver):
    """An arm on a serial line. port: that is open; None before `connect` and after `close`."""

    def __init__(self, opener: Opener, listener: ByteListener | None = None) -> None:
        """opener: opens the device, and opens it again after it was away. listener: is told all bytes that pass."""
        self.opener, self._listener = opener, listener
        self.port: Port | None = None
        self._reset()

    def _reset(self) -> None:
        """Forget what was given and what has come."""
        raise NotImplementedError

    def connect(self, now: float) -> None:
        """Open the port."""
        port = self.opener()
        self.port = port if self._listener is None else _LoggedPort(port, self._listener)

    def close(self) -> None:
        """Close the port; what waits is dropped."""
        if self.port is not None:
            self.port.close()
        self.port = None
        self._reset()

    def release(self) -> None:
        """Let the device's lock go, where its opener holds one."""
        if isinstance(self.opener, PortOpener):
            self.opener.release()

    def waiting(self) -> float:
        """Bytes in the system's output buffer."""
        return 0.0 if self.port is None else self.port.waiting()


class _LoggedPort:
    """A port whose listener is called with all bytes that pass."""

    def __init__(self, port: Port, listener: ByteListener) -> None:
        self._port, self._listener = port, listener
        self.waiting, self.close = port.waiting, port.close

    def write(self, data: bytes) -> int:
        count = self._port.write(data)
        if count:
            self._listener(data[:count], True)
        return count

    def read(self) -> bytes:
        data = self._port.read()
        if data:
            self._listener(data, False)
        return data
