"""Pictures of the world as the cameras deliver them: rendered when they are first asked for, several at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from hardware.files.images import encode
from hardware.simulator.cameras import Fate, Shot, garble
from hardware.simulator.cover import laid_over
from hardware.simulator.instant import Instant
from hardware.simulator.lenses import Lenses
from hardware.simulator.render import render
from hardware.simulator.scene.scene import Scene
from hardware.simulator.sensor import Sensor

NOISE, DAMAGE = 5, 6  # streams of random numbers of one picture


@dataclass(frozen=True, slots=True, eq=False)
class Waiting:
    """A picture that is exposed and not yet rendered."""

    shot: Shot
    instant: Instant


class Pictures:
    """Renders and encodes what was exposed.

    Exposed pictures wait until one of them is asked for; then all that wait are rendered, one of each camera at a time,
    with the printed material as it was at the first of them (`lay`): what was laid while pictures travel is missing.
    """

    def __init__(
        self,
        scene: Scene,
        lenses: Lenses,
        sensor: Sensor,
        jpeg_quality: int | None,
        seed: int,
        threads: int = 2,
        lay: Callable[[float], None] = lambda until: None,
    ) -> None:
        """lenses: the true cameras. lay: brings the scene's printed material up to an instant, s."""
        self._scene, self._lenses, self._sensor, self._quality = scene, lenses, sensor, jpeg_quality
        self._seed, self._threads, self._lay = seed, threads, lay
        self._waiting: list[Waiting] = []
        self._done: dict[tuple[int, int], tuple[str, bytes]] = {}

    def expose(self, shot: Shot, instant: Instant) -> None:
        """Remember the world as this shot meets it."""
        self._waiting.append(Waiting(shot, instant))

    def take(self, shot: Shot) -> tuple[str, bytes]:
        """Format and bytes of a picture that was exposed; each once."""
        key = shot.camera, shot.number
        if key not in self._done:
            self._develop()
        return self._done.pop(key)

    def _develop(self) -> None:
        self._lay(min(w.instant.stamp for w in self._waiting))
        while self._waiting:
            batch = {w.shot.camera: w for w in reversed(self._waiting)}  # the first of each camera
            self._waiting = [w for w in self._waiting if w is not batch[w.shot.camera]]
            self._render(list(batch.values()))

    def _render(self, batch: Sequence[Waiting]) -> None:
        cameras, instants = [self._lenses(w.shot) for w in batch], [w.instant for w in batch]
        rngs = [self._rng(NOISE, w.shot.camera, w.shot.picture) for w in batch]
        images = render(self._scene, cameras, instants, self._sensor, rngs, self._threads)
        for i, (w, camera) in enumerate(zip(batch, cameras, strict=True)):
            if w.shot.covered is not None:
                images[i] = laid_over(images[i], camera, w.instant.base_from_surface, w.shot.covered)
        with ThreadPoolExecutor(self._threads) as pool:
            encoded = list(pool.map(lambda image: encode(image, self._quality), images))
        for w, (kind, data) in zip(batch, encoded, strict=True):
            if w.shot.fate is Fate.GARBLED:
                data = garble(data, self._rng(DAMAGE, w.shot.camera, w.shot.number))
            self._done[w.shot.camera, w.shot.number] = kind, data

    def _rng(self, stream: int, camera: int, number: int) -> np.random.Generator:
        """A picture's own random numbers: they depend on nothing but its camera and number."""
        return np.random.default_rng([self._seed, stream, camera, number])
