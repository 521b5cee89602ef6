"""The recorder's end of a sender's pipe: all that has come, read at once into memory that is kept."""

from __future__ import annotations

import fcntl
import os
import pickle
import struct
from collections.abc import Iterator
from contextlib import suppress
from multiprocessing.connection import Connection

from hardware.live.records import Entry

HEAD = struct.Struct("=Q")  # bytes of the pickled entry that follows
HELD = 2**20  # bytes that a pipe holds: 0.1 s of three cameras' pictures, and as much as anyone may ask for
CROWDED = 0.9  # of that, from which whoever sends may be waiting


class Inbox:
    """One sender's entries. ended: it has closed its end, and all that it sent was given out or was cut short.

    crowded: the pipe was full, as far as can be seen, when it was last read.
    """

    def __init__(self, connection: Connection) -> None:
        self.ended, self.crowded = False, False
        self._connection = connection
        self._memory, self._filled = bytearray(2 * HELD), 0
        with suppress(OSError):  # a smaller pipe takes more turns
            fcntl.fcntl(connection.fileno(), fcntl.F_SETPIPE_SZ, HELD)
        self._room = fcntl.fcntl(connection.fileno(), fcntl.F_GETPIPE_SZ)

    def fileno(self) -> int:
        """The pipe, for whoever waits for it."""
        return self._connection.fileno()

    def take(self) -> Iterator[Entry]:
        """What has come since the last call; waits where nothing has."""
        with memoryview(self._memory) as memory:
            count = os.readv(self._connection.fileno(), [memory[self._filled :]])
        self.ended, self.crowded = count == 0, count > CROWDED * self._room
        self._filled += count
        yield from self._whole()

    def close(self) -> None:
        """Let the sender know that nobody takes anything any more."""
        self._connection.close()

    def _whole(self) -> Iterator[Entry]:
        """The entries that are there to their end; what is there of the next one goes to the front."""
        begin, needed = 0, HEAD.size
        with memoryview(self._memory) as memory:
            while begin + HEAD.size <= self._filled:
                needed = HEAD.size + HEAD.unpack_from(memory, begin)[0]
                if begin + needed > self._filled:
                    break
                yield pickle.loads(memory[begin + HEAD.size : begin + needed])
                begin += needed
                needed = HEAD.size
            memory[: self._filled - begin] = memory[begin : self._filled]
        self._filled -= begin
        if needed > len(self._memory):
            self._memory += bytes(needed)
