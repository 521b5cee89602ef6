"""The latest value of a stream, in memory that two processes share.

Neither side waits. Two slots take turns: one can be read while the other is written. A reader that is overtaken sees it
by the count and the checksum, and reads the newer one.
"""

from __future__ import annotations

import pickle
import struct
from multiprocessing.sharedctypes import RawArray
from typing import Any, Generic, TypeVar
from zlib import crc32

from estimation.errors import InputError

Value = TypeVar("Value")

DEFAULT_CAPACITY = 1 << 20  # bytes: fifty times a pose with its forecast and its warp
MAX_READ_TRIES = 8  # by then the writer would have come twice within each reading, some of them microseconds
_COUNT = struct.Struct("=Q")
_SLOT_HEAD = struct.Struct("=QII")  # count, size, check sum


class SharedLatest(Generic[Value]):
    """Handed to another process when that is started; one puts, the other gets."""

    def __init__(self, capacity: int = DEFAULT_CAPACITY) -> None:
        self._capacity = capacity
        self._memory: Any = RawArray("B", _COUNT.size + 2 * (_SLOT_HEAD.size + capacity))
        self._seen, self._value = 0, None

    def put(self, value: Value) -> None:
        """Make `value` the newest; InputError where it is too large."""
        data = pickle.dumps(value, pickle.HIGHEST_PROTOCOL)
        if len(data) > self._capacity:
            raise InputError("shared memory", "size", len(data), f"at most {self._capacity} bytes")
        memory = memoryview(self._memory).cast("B")
        count = _COUNT.unpack_from(memory)[0] + 1
        start = self._start(count)
        memory[start + _SLOT_HEAD.size : start + _SLOT_HEAD.size + len(data)] = data
        _SLOT_HEAD.pack_into(memory, start, count, len(data), crc32(data))
        _COUNT.pack_into(memory, 0, count)

    def get(self) -> Value | None:
        """The newest value, the very object of the last call if there is no newer one; None before the first."""
        memory = memoryview(self._memory).cast("B")
        for _ in range(MAX_READ_TRIES):
            count = _COUNT.unpack_from(memory)[0]
            if count == self._seen:
                break
            start = self._start(count)
            written, size, check = _SLOT_HEAD.unpack_from(memory, start)
            data = bytes(memory[start + _SLOT_HEAD.size : start + _SLOT_HEAD.size + min(size, self._capacity)])
            if written == count and crc32(data) == check:
                self._seen, self._value = count, pickle.loads(data)
                break
        return self._value

    def _start(self, count: int) -> int:
        return _COUNT.size + (count % 2) * (_SLOT_HEAD.size + self._capacity)
