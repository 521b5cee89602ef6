"""The operator's page: what the run shows, what the operator asks, and the process that serves both to browsers.

The run puts views, a scene and pictures into shared memory and takes requests out of it; it never waits for the page,
and the page cannot reach it in any other way. Whatever happens to the page and its windows, the run goes on.
"""

__all__ = ["broadcast", "demo", "overlays", "process", "server", "settings", "shared_state", "view"]
