"""The tip in the pictures of a recorded calibration: which pictures are looked at, and what is seen in them."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.arm_calibration.set_point import SetPoint
from estimation.calibration.arm_model import Sightings
from estimation.errors import InputError
from estimation.rig import Rig
from estimation.se3 import Array
from hardware.files.session import FrameRef, Session
from hardware.process.progress import Report
from perception.boards.needle_tip import Tip, TipFinder, background
from perception.frames import Image

SETTLE = 0.25  # s after which an arm that was sent nowhere else is at rest: ten times a servo's lag
PER_PLACE = 3  # pictures of a place that are looked at: more show the same
ON_WAY = 300  # frame sets in which the arm moves, at most, spread over all of them
BEHIND = 11  # pictures of which the background is the median
FEWEST = 5  # pictures without which there is no background
FLOOR = 0.1  # px, one sigma: what pixels and shading do to a needle two or three pixels wide
CROP = 40  # px about a tip, of the pictures for the report
SHOWN = 6  # of them per camera


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """What was seen. sightings: of resting places one per camera, the mean. looked, found: (C,) pictures. crops: by
    camera, pictures (K, CROP, CROP, 3) about tips, and pixels (K, 2) of the tips in them; width: (C,) px of needle.
    missed: stamps (M,), s, and cameras (M,) of pictures without a tip."""

    sightings: Sightings
    looked: NDArray[np.int64]
    found: NDArray[np.int64]
    crops: tuple[tuple[Array, Array], ...]
    width: Array
    missed: tuple[Array, NDArray[np.int64]]


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    ref: FrameRef
    place: int
    tip: Tip | None
    crop: tuple[Image, Array] | None


def needle_radius(rig: Rig, tool: Array) -> float:
    """px that the needle of a tool (K, 2), [height, radius] mm, is thinner than where the cameras' axes meet."""
    poses = np.stack([c.base_from_camera for c in rig.cameras])
    across = np.eye(3) - poses[:, :3, 2, None] * poses[:, None, :3, 2]
    middle = np.linalg.lstsq(across.sum(0), (across @ poses[:, :3, 3, None]).sum(0)[:, 0], rcond=None)[0]
    focal = rig.matrices[:, 0, 0] / np.linalg.norm(poses[:, :3, 3] - middle, axis=1)
    return float(1.6 * focal.max() * tool[0, 1] + 1.5)


def look(session: Session, set_point: SetPoint, tool: Array, report: Report) -> Look:
    """Find the tip in a session's pictures. InputError where there is too little to look at."""
    rig = session.rig
    chosen = _chosen(session, set_point)
    finders = _finders(session, set_point, needle_radius(rig, tool))
    seen: list[_Seen] = []
    reader = session.store.open()
    try:
        with ThreadPoolExecutor(2) as pool:
            for done, (refs, places) in enumerate(chosen):
                images = [reader.read(ref) for ref in refs]
                jobs = zip(refs, places, images, strict=True)
                seen += pool.map(lambda job: _find(finders, *job), jobs)
                report(done + 1, len(chosen))
    finally:
        reader.close()
    return _gathered(seen, len(rig))


def _chosen(session: Session, set_point: SetPoint) -> list[tuple[tuple[FrameRef, ...], list[int]]]:
    """The frame sets that are looked at, with each frame's place."""
    first, last = set_point.instants[0], set_point.instants[-1]
    rows = [refs for refs in session.sets if refs and first <= refs[0].stamp <= last + SETTLE * 4]
    if not rows:
        raise InputError(session.path, "stamps", "none while the arm was moved", "pictures by the same clock")
    places = [set_point.places(np.array([ref.stamp for ref in refs]), SETTLE).tolist() for refs in rows]
    counts: dict[int, int] = {}
    resting, moving = [], []
    for refs, numbers in zip(rows, places, strict=True):
        number = min(numbers)
        if number < 0:
            moving.append((refs, numbers))
        elif counts.setdefault(number, 0) < PER_PLACE:
            counts[number] += 1
            resting.append((refs, numbers))
    keep = np.unique(np.linspace(0, len(moving) - 1, min(ON_WAY, len(moving))).round().astype(int))
    return sorted(resting + [moving[i] for i in keep], key=lambda one: one[0][0].stamp)


def _finders(session: Session, set_point: SetPoint, radius: float) -> list[TipFinder]:
    """A finder for each camera, before a background of pictures that are far apart."""
    finders, reader = [], session.store.open()
    own: list[list[FrameRef]] = [[] for _ in session.rig.cameras]  # a set may lack a camera
    for ref in (ref for refs in session.sets for ref in refs):
        own[ref.camera].append(ref)
    picked = [ref for refs in own for ref in _far_apart(refs, set_point)]
    try:
        stacks: list[list[Image]] = [[] for _ in session.rig.cameras]
        for ref in sorted(picked, key=lambda one: one.stamp):
            stacks[ref.camera].append(reader.read(ref))
    finally:
        reader.close()
    for camera, stack in zip(session.rig.cameras, stacks, strict=True):
        if len(stack) < FEWEST:
            raise InputError(
                session.path, f"pictures of {camera.name}", len(stack), f"{FEWEST} or more, while it moves"
            )
        finders.append(TipFinder(background(stack), radius))
    return finders


def _far_apart(refs: Sequence[FrameRef], set_point: SetPoint) -> Sequence[FrameRef]:
    """Pictures in which the arm stands as far from the other ones as it can: farthest point sampling."""
    if not refs:
        return ()
    points = set_point.lagged(np.array([ref.stamp for ref in refs]), 0.0, 0.0)[:, :3]
    picked = [0]
    away = np.linalg.norm(points - points[0], axis=1)
    while len(picked) < min(BEHIND, len(points)):
        picked.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(points - points[picked[-1]], axis=1))
    return [refs[i] for i in sorted(set(picked))]


def _find(finders: list[TipFinder], ref: FrameRef, place: int, image: Image) -> _Seen:
    tip = finders[ref.camera](image)
    return _Seen(ref, place, tip, None if tip is None else _crop(image, np.array(tip.pixel)))


def _crop(image: Image, pixel: Array) -> tuple[Image, Array]:
    x, y = (int(v) - CROP // 2 for v in pixel)
    x, y = min(max(x, 0), image.shape[1] - CROP), min(max(y, 0), image.shape[0] - CROP)
    part = image[y : y + CROP, x : x + CROP]
    return np.repeat(part[..., None], 3, -1) if part.ndim == 2 else part.copy(), pixel - [x, y]


def _gathered(seen: Sequence[_Seen], cameras: int) -> Look:
    looked, found = np.zeros(cameras, np.int64), np.zeros(cameras, np.int64)
    rows: dict[tuple[int, int], list[_Seen]] = {}
    for number, one in enumerate(seen):
        looked[one.ref.camera] += 1
        found[one.ref.camera] += one.tip is not None
        if one.tip is not None:
            key = (one.place, one.ref.camera) if one.place >= 0 else (-1 - number, one.ref.camera)
            rows.setdefault(key, []).append(one)
    tips = [[o.tip for o in ones if o.tip is not None] for ones in rows.values()]
    sightings = Sightings(
        stamp=np.array([np.mean([o.ref.stamp for o in ones]) for ones in rows.values()]),
        camera=np.array([key[1] for key in rows], np.int64),
        pixels=np.array([np.median([t.pixel for t in mine], axis=0) for mine in tips]).reshape(-1, 2),
        sigma=np.array([np.hypot(FLOOR, np.mean([t.sigma for t in mine])) for mine in tips]),
        place=np.array([max(key[0], -1) for key in rows], np.int64),
    )
    width = np.array([_median([o.tip.width for o in seen if o.tip and o.ref.camera == c]) for c in range(cameras)])
    without = [one.ref for one in seen if one.tip is None]
    missed = np.array([ref.stamp for ref in without], float), np.array([ref.camera for ref in without], np.int64)
    return Look(sightings, looked, found, tuple(_crops(seen, c) for c in range(cameras)), width, missed)


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if values else float("nan")


def _crops(seen: Sequence[_Seen], camera: int) -> tuple[Array, Array]:
    mine = [one.crop for one in seen if one.crop is not None and one.ref.camera == camera]
    chosen = mine[:: max(1, len(mine) // SHOWN)][:SHOWN]
    if not chosen:
        return np.zeros((0, CROP, CROP, 3), np.uint8), np.zeros((0, 2))
    return np.stack([image for image, _ in chosen]), np.stack([at for _, at in chosen])
