"""From checkpoints on a moving surface to one command a tick: re-timing, following, the guard."""

__all__ = ["curve", "guard", "planner", "retime"]
