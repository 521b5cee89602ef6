"""`stillbed bench tracks`: how far tracks scatter and creep before a camera and a surface that stand still."""

from __future__ import annotations

import argparse

import numpy as np

from estimation.se3 import Array
from estimation.synthetic.arc_rig import REST, arc_rig
from hardware.bench.figures import Figure, at_least, at_most
from hardware.bench.registration import shape_of
from hardware.simulator.instant import Instant
from hardware.simulator.look import Look
from hardware.simulator.render import render
from hardware.simulator.scene.scene import Scene
from hardware.simulator.sensor import Sensor
from perception.alignment import align
from perception.features import grey
from perception.frames import Image
from perception.lens import Lenses
from perception.matching.patches import project_squares, pyramid, take_templates

MINUTE, DRIFT = 60.0, 0.15  # s; of the light, from the first picture to the last


def run(options: argparse.Namespace) -> list[Figure]:
    """Tracks on a forearm and a chest, one camera, every picture with its own noise and a light that drifts."""
    stamps = np.linspace(0.0, options.minutes * MINUTE, max(4, options.pictures))
    return [figure for name in ("forearm", "chest") for figure in _figures(name, stamps, *tracked(name, stamps))]


def tracked(name: str, stamps: Array) -> tuple[Array, Array]:
    """Pixels (T, N, 2) of a body's tracks, nan where not found, and their sigmas (T, N) px."""
    rig = arc_rig(size=(1280, 720), focal=1100.0)
    lenses, shape = Lenses(rig), shape_of(name, 1)
    scene, rng = Scene(shape, Look(), seed=1), np.random.default_rng(5)
    place = shape.grid(4.0, 0.8)
    points, normals = shape.points(place), shape.normals(place)

    def picture(stamp: float) -> Image:
        gain = 1 + DRIFT * stamp / stamps[-1]
        (image,) = render(scene, rig.cameras[1:2], [Instant(stamp, 0.0, REST, np.zeros(6), gain=gain)], Sensor(), [rng])
        return grey(image)

    templates = take_templates(lenses, pyramid(picture(0.0)), 1, REST, points, normals)
    where = project_squares(lenses, 1, REST, points, normals, templates.axes)
    pixels, sigmas = np.full((len(stamps), len(points), 2), np.nan), np.full((len(stamps), len(points)), np.nan)
    for i, stamp in enumerate(stamps.tolist()):
        found = align(templates, pyramid(picture(stamp)), where, where.centre, coarse=False)
        pixels[i, found.found], sigmas[i, found.found] = found.pixels[found.found], found.sigma[found.found]
    return pixels, sigmas


def _figures(name: str, stamps: Array, pixels: Array, sigmas: Array) -> list[Figure]:
    steady = np.isfinite(pixels).all((0, 2))
    kept, claimed = pixels[:, steady], sigmas[:, steady]
    away = kept - kept.mean(0)
    scatter = np.sqrt((away**2).mean((0, 2)))  # of each track, an axis
    early, late = (kept[part].mean(0) for part in (stamps <= MINUTE, stamps >= stamps[-1] - MINUTE))
    crept = float(np.sqrt(((late - early) ** 2).mean()))
    chance = float(
        np.sqrt((scatter**2).mean() * (1 / (stamps <= MINUTE).sum() + 1 / (stamps >= stamps[-1] - MINUTE).sum()))
    )
    share = 100 * float(steady.sum()) / max(1, int(np.isfinite(pixels[0, :, 0]).sum()))
    note = f"{int(steady.sum())} tracks, {len(stamps)} pictures over {stamps[-1] / MINUTE:g} min, light +{DRIFT:.0%}"
    return [
        Figure(f"{name}: scatter of a track", float(np.sqrt((scatter**2).mean())), "px RMS", at_most(0.1), "", note),
        Figure(
            f"{name}: scatter of what is claimed",
            float(np.median(scatter / claimed.mean(0))),
            "",
            None,
            "",
            "the claim holds what all pictures share, too",
        ),
        Figure(
            f"{name}: creep, last minute against first", crept, "px RMS", at_most(0.05), "", f"chance: {chance:.4f}"
        ),
        Figure(f"{name}: tracks kept to the end", share, "%", at_least(95)),
    ]
