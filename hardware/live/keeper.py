"""Keeps the bookmark up to date beside a loop that must not wait for the disk."""

from __future__ import annotations

import math
import threading
from pathlib import Path

from hardware.bookmark_file import keep_bookmark
from hardware.live.place import Place

PERIOD = 0.05  # s between looks at the place: a tenth of a checkpoint's time, or less


class Keeper:
    """Writes progress.toml whenever the place has changed. failed: what the disk said, "" if nothing."""

    def __init__(self, file: Path, fingerprint: str, place: Place) -> None:
        """fingerprint: of the path; "" for a dry run, of which no place is kept."""
        self.failed = ""
        self._file, self._fingerprint, self._place = file, fingerprint, place
        self._written = math.nan
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._keep, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Write the last place, and end."""
        self._closed.set()
        self._thread.join()

    def _keep(self) -> None:
        while not self._closed.wait(PERIOD):
            self._write()
        self._write()

    def _write(self) -> None:
        fraction = self._place.fraction
        if not self._fingerprint or math.isnan(fraction) or fraction == self._written:
            return
        try:
            keep_bookmark(self._file, self._fingerprint, fraction)
            self._written, self.failed = fraction, ""
        except OSError as error:
            self.failed = f"{self._file}: {error.strerror or error}"
