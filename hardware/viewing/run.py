"""`stillbed view` from the words of the command line to the page."""

from __future__ import annotations

import asyncio
import socket
from pathlib import Path

from hardware.offline.viewer import open_playback
from hardware.operator.settings import OperatorSettings, check_settings
from hardware.viewing.server import serve


def run_view(session: Path, poses: str | None, toolpath: Path | None, port: int) -> None:
    """Say where the page is, and serve it until interrupted; InputError where the session cannot be opened."""
    settings = check_settings(OperatorSettings(port=port))
    playback = open_playback(session, poses, toolpath)
    with socket.create_server((settings.host, settings.port)) as listener:
        port = listener.getsockname()[1]
        seconds = playback.stamps[-1] - playback.stamps[0]
        print(f"{len(playback)} frame sets over {seconds:.1f} s, poses: {playback.source or 'none'}")
        print(f"open http://{settings.host}:{port}/{settings.token}/ in a browser; Ctrl-C ends", flush=True)
        asyncio.run(serve(playback, settings, listener))
