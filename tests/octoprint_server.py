"""OctoPrint's virtual printer, an imitation of Marlin, on a pseudo-terminal; run by the Python that has OctoPrint.

.octoprint/bin/python tests/octoprint_server.py LINK LOG X Y Z [ERROR ...]

It stands at X Y Z, mm, and runs until SIGTERM; LOG then has rows: s of the clock, X Y Z, and how far E has gone. An
ERROR is one of the printer's own, such as 100:resend for the line of that number, or checksum_mismatch, or
resend_with_timeout.

Its own moves take a tenth of their time; a tenth of the feed rate, which M220 S10 would set, makes that up. It moves at
the beginning of each move, and counts way back as no time.
"""

import contextlib
import logging
import os
import pty
import signal
import sys
import tempfile
import threading
import time
import tty
from pathlib import Path

from octoprint import plugin
from octoprint.plugins.virtual_printer import VirtualPrinterPlugin
from octoprint.plugins.virtual_printer.virtual import VirtualPrinter

FEED_PERCENT = 10
ERRORS = sys.argv[
    3:
]  # such as 100:resend, for the line of that number, likewise checksum_mismatch, resend_with_timeout


class Settings:
    """The plugin's own defaults."""

    def __init__(self):
        self.values = VirtualPrinterPlugin().get_settings_defaults()
        self.values["sendWait"] = False
        self.values["simulated_errors"] = ERRORS

    def get(self, path, merged=False):
        return self.values[path[0]]

    get_int = get_float = get_boolean = get

    def global_get_basefolder(self, name):
        return tempfile.mkdtemp()


class Profiles:
    def get_current_or_default(self):
        return {"volume": {"width": 220, "depth": 220, "height": 250, "origin": "lowerleft", "custom_box": False}}


def main(link, log, *place):
    logging.disable(logging.CRITICAL)
    with contextlib.suppress(OSError):  # a machine's board shares no core with us; needs a privilege
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    plugin.plugin_manager(init=True, plugin_folders=[], plugin_entry_points=[])
    printer = VirtualPrinter(Settings(), Profiles(), tempfile.mkdtemp(), read_timeout=0.005)
    printer._lastX, printer._lastY, printer._lastZ = map(float, place)
    printer._gcode_G21 = lambda data: None  # its own scales the place as if it had counted in inches before
    printer._feedrate_multiplier = printer._flowrate_multiplier = FEED_PERCENT
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    Path(link).unlink(missing_ok=True)
    Path(link).symlink_to(os.ttyname(theirs))
    rows, pushed, relative, moved, absolute = [], [0.0], [False], printer._performMove, printer._gcode_G90

    def move(line):
        if relative[0]:
            printer._lastE = [0.0] * len(printer._lastE)
        before = printer._lastE[0]
        moved(line)
        pushed[0] += printer._lastE[0] - before

    def switch(to):  # it knows no M83: E is relative from there until a G90, as in Marlin
        relative[0] = to

    printer._performMove = move
    printer._gcode_M83 = lambda data: switch(True)
    printer._gcode_G90 = lambda data: switch(False) or absolute(data)

    def watch():
        while True:
            rows.append((time.monotonic(), printer._lastX, printer._lastY, printer._lastZ, pushed[0]))
            time.sleep(0.001)

    def answer():
        while True:
            if line := printer.readline():
                os.write(ours, line.rstrip(b"\n") + b"\n")

    def end(number, frame):
        Path(link).unlink(missing_ok=True)
        Path(log).write_text("\n".join(" ".join(map(str, row)) for row in list(rows)))
        os._exit(0)

    signal.signal(signal.SIGTERM, end)
    for work in (watch, answer):
        threading.Thread(target=work, daemon=True).start()
    print("ready", flush=True)
    rest = b""
    while True:
        *lines, rest = (rest + os.read(ours, 4096)).split(b"\n")
        for line in lines:  # it looks at one line of what it is given at a time
            left = line + b"\n"
            while left:
                # a write that waits for room holds a lock that the printer needs to ask for a line again: for good
                while printer.incoming.qsize() and printer.incoming.qsize() + len(left) > printer.incoming.maxsize:
                    time.sleep(0.001)
                left = left[printer.write(left) :]


if __name__ == "__main__":
    main(*sys.argv[1:6])
