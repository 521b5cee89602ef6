"""What a process gives the recorder: never waits, keeps a bounded heap, counts what found no room."""

from __future__ import annotations

import os
import pickle
import threading
from collections import deque
from multiprocessing.connection import Connection

from hardware.live.inbox import HEAD
from hardware.live.records import Entry, SetEntry

ROOM = 48 * 2**20  # bytes that may wait: 3 s of pictures as three cameras encode them
SMALL = 8 * 2**20  # of them kept free of pictures, so that these never push out what is small


class Outbox:
    """One sender's way to the recorder. dropped: entries that found no room, or nobody who takes them."""

    def __init__(self, connection: Connection) -> None:
        self.dropped = 0
        self._connection = connection
        self._waiting: deque[bytes] = deque()
        self._size, self._closed, self._gone = 0, False, False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._send, daemon=True)
        self._thread.start()

    def put(self, entry: Entry) -> None:
        """Have an entry recorded."""
        data = pickle.dumps(entry, pickle.HIGHEST_PROTOCOL)
        room = ROOM - SMALL if isinstance(entry, SetEntry) else ROOM
        with self._changed:
            if self._gone or self._size + len(data) > room:
                self.dropped += 1
                return
            self._waiting.append(data)
            self._size += len(data)
            self._changed.notify()

    def close(self, patience: float = 5.0) -> None:
        """Send what waits, `patience` s long, and let the recorder know that this was all."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join(patience)

    def _send(self) -> None:
        try:
            while (data := self._next()) is not None:
                _give(self._connection.fileno(), HEAD.pack(len(data)), data)
        except (OSError, ValueError):  # nobody is there any more
            with self._changed:
                self._gone = True
                self.dropped += len(self._waiting)
                self._waiting.clear()
        finally:
            self._connection.close()

    def _next(self) -> bytes | None:
        """The next entry, waited for; None once this is closed and empty."""
        with self._changed:
            while not self._waiting:
                if self._closed:
                    return None
                self._changed.wait()
            data = self._waiting.popleft()
            self._size -= len(data)
            return data


def _give(pipe: int, head: bytes, data: bytes) -> None:
    """Write all of it, waiting where the pipe is full."""
    left = memoryview(data)[max(os.writev(pipe, [head, data]) - len(head), 0) :]
    while left:
        left = left[os.write(pipe, left) :]
