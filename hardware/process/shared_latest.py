"""The newest of what one process tells another: neither waits for the other, and what came before is gone.

Two slots in shared memory take turns: one can be read while the other is written. A reader that is overtaken in the
middle sees it by the count and the check sum, and reads the newer one.
"""

from __future__ import annotations

import pickle
import struct
from multiprocessing.sharedctypes import RawArray
from typing import Any, Generic, TypeVar
from zlib import crc32

from estimation.errors import InputError

Value = TypeVar("Value")

CAPACITY = 1 << 20  # bytes: fifty times a pose with its forecast and its warp
TRIES = 8  # by then the writer would have come twice within each reading, some of them microseconds
_COUNT = struct.Struct("=Q")
_HEAD = struct.Struct("=QII")  # count, size, check sum


class Newest(Generic[Value]):
    """Handed to another process when that is started; one puts, the other gets."""

    def __init__(self, capacity: int = CAPACITY) -> None:
        self._capacity = capacity
        self._memory: Any = RawArray("B", _COUNT.size + 2 * (_HEAD.size + capacity))
        self._seen, self._value = 0, None

    def put(self, value: Value) -> None:
        """Make `value` the newest; InputError where it is too large."""
        data = pickle.dumps(value, pickle.HIGHEST_PROTOCOL)
        if len(data) > self._capacity:
            raise InputError("shared memory", "size", len(data), f"at most {self._capacity} bytes")
        memory = memoryview(self._memory).cast("B")
        count = _COUNT.unpack_from(memory)[0] + 1
        start = self._start(count)
        memory[start + _HEAD.size : start + _HEAD.size + len(data)] = data
        _HEAD.pack_into(memory, start, count, len(data), crc32(data))
        _COUNT.pack_into(memory, 0, count)

    def get(self) -> Value | None:
        """The newest value, the very object of the last call if there is no newer one; None before the first."""
        memory = memoryview(self._memory).cast("B")
        for _ in range(TRIES):
            count = _COUNT.unpack_from(memory)[0]
            if count == self._seen:
                break
            start = self._start(count)
            written, size, check = _HEAD.unpack_from(memory, start)
            data = bytes(memory[start + _HEAD.size : start + _HEAD.size + min(size, self._capacity)])
            if written == count and crc32(data) == check:
                self._seen, self._value = count, pickle.loads(data)
                break
        return self._value

    def _start(self, count: int) -> int:
        return _COUNT.size + (count % 2) * (_HEAD.size + self._capacity)
