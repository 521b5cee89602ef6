"""A process of a run from which nothing more comes: told within a tenth of a second, long before it counts as hung.

What comes regularly is missed after two intervals. Nothing is done about it: the arm rests anyhow, its queue being
empty or the pose too old, and what was only late goes on. But whoever looks on is to know at once why nothing moves.
"""

from __future__ import annotations

MISSED = 2  # intervals without a word
LATE = 0.01  # s that a word may come late


def silence(name: str, last: float, interval: float, now: float) -> str:
    """Why a process is missed at `now`, s, "" if it is not. last: s, its last word. interval: s from word to word.

    Of one whose interval is not known, NaN, or that has said nothing yet, nothing can be told.
    """
    since = now - last
    return f"the {name} process has said nothing for {since:.2f} s" if since > MISSED * interval + LATE else ""
