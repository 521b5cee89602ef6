"""All that joins a run and its operator's page: three things of which the newest is shown, and the line of requests."""

from __future__ import annotations

from dataclasses import dataclass, field

from hardware.operator import pictures, scene
from hardware.operator.pictures import Pictures
from hardware.operator.scene import Scene
from hardware.operator.shared_state import RequestLine
from hardware.operator.view import OperatorView
from hardware.operator.waving import WavingView
from hardware.process.shared_latest import Newest


def _pictures() -> Newest[Pictures]:
    return Newest(pictures.CAPACITY)


def _scene() -> Newest[Scene]:
    return Newest(scene.CAPACITY)


@dataclass(frozen=True, slots=True, eq=False)
class OperatorLink:
    """Shared memory, handed to each process that takes part when it is started.

    Of `views`, `pictures` and `scene` each has one process that puts, and the page that gets; `requests` are asked by
    the page and taken by one process.
    """

    views: Newest[OperatorView | WavingView] = field(default_factory=Newest)
    pictures: Newest[Pictures] = field(default_factory=_pictures)
    scene: Newest[Scene] = field(default_factory=_scene)
    requests: RequestLine = field(default_factory=RequestLine)
