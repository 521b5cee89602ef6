"""The page's process: seen from the run, and its body."""

from __future__ import annotations

import asyncio
import logging
import multiprocessing
import os
import signal
import socket
from multiprocessing.process import BaseProcess

from hardware.operator.gate import hosts
from hardware.operator.link import OperatorLink
from hardware.operator.settings import Limits, OperatorSettings, check_settings

NICENESS = 5  # below the loops, above what may wait for minutes
AGAIN = 1.0  # s between two starts of a page that died


class OperatorPage:
    """The page as the run sees it: started, looked after, ended. address: holds from the beginning, however often the
    process is started again, as the port stays with the run.
    """

    def __init__(self, link: OperatorLink, settings: OperatorSettings, limits: Limits | None = None) -> None:
        """Binds the port; OSError where it is taken, InputError where the settings would let others in."""
        self._link, self._settings, self._limits = link, check_settings(settings), limits or Limits()
        family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
        self._listener = socket.create_server((settings.host, settings.port), family=family, backlog=32)
        self._process: BaseProcess | None = None
        self._started = float("-inf")
        self.restarts = 0

    @property
    def address(self) -> str:
        """What is to be opened in a browser; whoever has it can operate the run."""
        port = self._listener.getsockname()[1]
        names = [*self._settings.names, self._settings.host]
        own = f"[{names[0]}]" if ":" in names[0] else names[0]
        assert f"{own}:{port}" in hosts(self._settings, port)
        return f"{self._settings.scheme}://{own}:{port}/{self._settings.token}/"

    @property
    def process(self) -> BaseProcess | None:
        """The process that serves, None before it is started."""
        return self._process

    def tend(self, now: float) -> bool:
        """Start the process if it does not run, at most once a second; whether it was started. now: s."""
        if (self._process is not None and self._process.is_alive()) or now - self._started < AGAIN:
            return False
        self.restarts += self._process is not None
        self._started = now
        arguments = (self._link, self._settings, self._listener, self._limits)
        spawn = multiprocessing.get_context("spawn")
        self._process = spawn.Process(target=operator_process, args=arguments, name="operator's page", daemon=True)
        self._process.start()
        return True

    def close(self) -> None:
        """End the process and give the port back."""
        if self._process is not None:
            self._process.terminate()
            self._process.join(2.0)
            self._process.kill()
            self._process.join()
            self._process = None
        self._listener.close()


def operator_process(
    link: OperatorLink, settings: OperatorSettings, listener: socket.socket, limits: Limits | None = None
) -> None:
    """Serve the page until told to end (SIGTERM) or until the run is gone; Ctrl-C is the run's business."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(NICENESS)
    for name in ("aiohttp", "asyncio"):  # what strangers send is theirs: it is counted, and not written on the terminal
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    asyncio.run(_until_the_end(link, settings, listener, limits or Limits()))


async def _until_the_end(
    link: OperatorLink, settings: OperatorSettings, listener: socket.socket, limits: Limits
) -> None:
    from hardware.operator.server import serve  # aiohttp is for this process alone

    loop, ended = asyncio.get_running_loop(), asyncio.Event()
    loop.add_signal_handler(signal.SIGTERM, ended.set)
    parent = multiprocessing.parent_process()
    if parent is not None:
        loop.add_reader(parent.sentinel, _parent_gone, loop, parent.sentinel, ended)
    await serve(link, settings, listener, ended, limits)


def _parent_gone(loop: asyncio.AbstractEventLoop, sentinel: int, ended: asyncio.Event) -> None:
    loop.remove_reader(sentinel)
    ended.set()
