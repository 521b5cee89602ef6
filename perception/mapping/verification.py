"""Checks of a pose that its own tracks cannot make: periodic texture (aliases), and tracks that follow light.

A surface with periodic texture is compared as a whole in every frame set: probes, spread over and around it, correlate
it with its first pictures at the pose and at the pose's aliases. An alias is possible if the tissue could have reached
it since the last sure pose and the probes do not contradict it; while one is, the pose is not sure.

A patch can consist of a lamp's pattern or a shadow's edge, which moves independently of the skin. The skin's grain is
finer: where the high-pass part of a track's picture is as strong as usual but another one, the track follows light.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import QhullError

from estimation import se3
from estimation.observations import Observations
from estimation.se3 import Array, Index
from estimation.surface_map import SurfaceMap
from perception.frames import parallel_map
from perception.lens import Lenses
from perception.mapping.aliases import NO_ALIASES, Aliases, SurfaceGrid, TangentPlane, find_aliases, surface_picture
from perception.mapping.alignment_kernels import PATCH_SAMPLES, Float32
from perception.mapping.masks import TrackingMasks
from perception.mapping.patches import (
    MIN_PATCH_CONTRAST,
    Pyramid,
    Templates,
    coarse_score,
    cut_templates,
    grain_of,
    project_squares,
    project_tracks_into,
    sample_each,
)

NEAR_ALIASES = 4  # the nearest, compared in every frame set: all of them when the likeness is low,
NEAR_MM = 15.0  # and those within reach when that is farther, as after a gap
BORDER_MM = 15.0  # around the landmarks, where a probe may show the edge of the periodic texture
PROBE_SIDE = 18  # cells of the grid of candidate probes
USUAL_PROBES = 20  # of each camera: those that discriminate aliases best,
PROBE_SPACING_MM = 10.0  # apart, if possible: one hand or nozzle must not hide them all
USUAL_MEMORY_SETS = 30.0  # frame sets over which a probe's likeness is learned
MAX_TISSUE_SPEED = 300.0  # mm/s: a cough moves skin at 175, a hand waves a board as fast as this
MAX_TISSUE_TURN = 2.0  # rad/s: a board in a hand turns by a quarter in 0.8 s
MIN_LIKENESS = 0.5  # correlation of a probe with its first picture: below, it is covered or elsewhere
MIN_PROBE_VOTE = 0.06  # loss of correlation by a shift error of a quarter pixel: smaller votes count 0
MAX_PROBE_VOTE = 0.3  # limit of one probe's vote: some are covered, some repeat by chance
MIN_EVIDENCE = 1.2  # sum of votes that rules an alias out: four probes
ODD_LIKENESS = 0.95  # of the probes' usual likeness, which is constant to 0.01: below it all aliases are compared,
ODD_EVIDENCE = 5.0  # and this sum of votes rules one out: a shift alone need not fit a curved surface
MESSAGE_TIME_S = 1.0  # for which the message of a periodic surface with marks is shown
MAX_RIVALS = 3  # aliases at which the pose is fitted, 6 ms each
BETTER_LIKENESS = 0.02  # relative to the usual: gain in likeness for a rival to be accepted,
WORSE_LIKENESS = 0.1  # and loss for it to be ruled out


@dataclass(frozen=True, slots=True, eq=False)
class Verdict:
    """Aliases of a pose that the pictures do not rule out."""

    motions: Array  # (K, 4, 4) mm, motions of the surface in its frame, the likeliest first
    sizes: Array  # (K,) mm, of these
    rivals: int  # how many to fit: on a curved surface tracks agree near an alias, not at it
    likeness: float  # of the surface with its first pictures, relative to the usual


SURE = Verdict(NO_ALIASES.motions, NO_ALIASES.sizes, 0, 1.0)


class Verification:
    """Compares poses with their aliases; holds the surface's first pictures and the last sure pose."""

    def __init__(self, lenses: Lenses, masks: TrackingMasks) -> None:
        """masks: where the print head hides the surface."""
        self._lenses, self._masks = lenses, masks
        self.aliases = NO_ALIASES
        self._probes: list[_Probes] = []
        self._centre = np.zeros(3)
        self._has_marks = False  # whether marks on the surface rule out the nearest aliases
        self._start_stamp = float("nan")  # s, when the surface was learned
        self._sure_stamp, self._sure_centre = float("nan"), np.zeros(3)  # s, mm, of the last sure pose

    def begin(
        self, stamp: float, pyramids: Mapping[int, Pyramid], poses: Mapping[int, Array], surface_map: SurfaceMap
    ) -> None:
        """Learn a surface by pictures (by camera) in which it stands at `poses` (4, 4), each camera's own."""
        self._probes, self.aliases, self._start_stamp = [], NO_ALIASES, stamp
        try:
            plane = TangentPlane(surface_map)
        except QhullError:  # landmarks on one line: no surface
            return
        self._centre = surface_map.points.mean(0)
        grid = SurfaceGrid(plane)
        pictures = (surface_picture(self._lenses, c, pyramids[c], poses[c], grid) for c in pyramids)
        self.aliases = max((find_aliases(*each, grid) for each in pictures), key=len, default=NO_ALIASES)
        if not len(self.aliases):
            return
        for c in pyramids:
            self._probes.append(_Probes(self._lenses, c, pyramids[c], poses[c], plane, self.aliases))
        evidence, _ = self._evidence(pyramids, poses, self._probes, self.aliases.motions[:NEAR_ALIASES])
        self._has_marks = bool(evidence.min() >= 2 * MIN_EVIDENCE)
        self.confirm(stamp, poses)

    @property
    def message(self) -> str:
        """For the operator: that a surface repeats, for MESSAGE_TIME_S if its marks resolve the aliases; or ''."""
        if not len(self.aliases) or (self._has_marks and self._sure_stamp - self._start_stamp > MESSAGE_TIME_S):
            return ""
        text = f"the surface repeats every {self.aliases.sizes[0]:.1f} mm"
        if self._has_marks:
            return f"{text}; its own marks tell where it is"
        return f"{text} and has hardly a mark of its own: a jump by that cannot be seen; put a sticker on it"

    def __call__(self, stamp: float, pyramids: Mapping[int, Pyramid], poses: Mapping[int, Array]) -> Verdict:
        """The verdict on `poses` (4, 4) at each camera's exposure; `confirm` then marks them as sure."""
        probes = [p for p in self._probes if p.camera in pyramids and p.camera in poses]
        if not probes:
            return SURE
        reach = MAX_TISSUE_SPEED * (stamp - self._sure_stamp)
        within = int(np.count_nonzero(self.aliases.sizes < reach))
        selection = slice(NEAR_ALIASES if reach < NEAR_MM else max(NEAR_ALIASES, within))
        evidence, likeness = self._evidence(pyramids, poses, probes, self.aliases.motions[selection])
        odd = likeness < ODD_LIKENESS
        if odd or evidence.min() < MIN_EVIDENCE:
            selection = slice(None)
            evidence, likeness = self._evidence(pyramids, poses, probes, self.aliases.motions)
        motions, sizes = self.aliases.motions[selection], self.aliases.sizes[selection]
        possible = evidence < (ODD_EVIDENCE if odd else MIN_EVIDENCE)
        if evidence.min() >= -MIN_EVIDENCE:
            centres = motions[:, :3, :3] @ self._centre + motions[:, :3, 3]
            centres_base = se3.transform_points(next(iter(poses.values())), centres)
            possible &= (np.linalg.norm(centres_base - self._sure_centre, axis=1) < reach) | odd
        turns = np.arccos(np.clip((np.trace(motions, axis1=1, axis2=2) - 2) / 2, -1.0, 1.0))  # of 4 x 4
        possible &= (turns < 1e-6) | (turns < MAX_TISSUE_TURN * (stamp - self._sure_stamp))
        rows = np.flatnonzero(possible)[np.argsort(evidence[possible], kind="stable")]
        return Verdict(motions[rows], sizes[rows], MAX_RIVALS if odd or evidence.min() < -MIN_EVIDENCE else 0, likeness)

    def confirm(self, stamp: float, poses: Mapping[int, Array]) -> None:
        """Mark the last compared poses, of `stamp`, s, as sure, and learn from them."""
        self._sure_stamp = stamp
        if poses:
            self._sure_centre = se3.transform_points(next(iter(poses.values())), self._centre)
        for probes in self._probes:
            probes.learn()

    def _evidence(
        self, pyramids: Mapping[int, Pyramid], poses: Mapping[int, Array], probes: Sequence[_Probes], motions: Array
    ) -> tuple[Array, float]:
        """Votes (K,) for the poses against motions (K, 4, 4) of them; the probes' likeness, relative to the usual."""
        scores = parallel_map(lambda p: p.compare(pyramids[p.camera], poses[p.camera], motions, self._masks), probes)
        likeness = np.concatenate([usual for _, usual in scores], axis=1)
        votes = np.concatenate([vote for vote, _ in scores], axis=1).sum(1)
        return votes, float(likeness[0].sum() / max(likeness[1].sum(), 1e-9))


class _Probes:
    """Templates of places on the surface from one camera's first picture, and their usual likeness."""

    def __init__(
        self, lenses: Lenses, camera: int, images: Pyramid, pose: Array, plane: TangentPlane, aliases: Aliases
    ) -> None:
        self._lenses, self.camera = lenses, camera
        flat = plane.grid(PROBE_SIDE, BORDER_MM)[0].reshape(-1, 2)
        points, normals = plane.lift(flat[plane.beside(flat) < BORDER_MM])
        templates = cut_templates(lenses, images, camera, pose, points, normals)
        where = project_squares(lenses, camera, pose, points, normals, templates.axes)
        good = where.visible & (templates.contrast > MIN_PATCH_CONTRAST)
        self._points, self._normals, self._templates = points[good], normals[good], templates.take(good)
        # those that discriminate aliases best, spread over the surface
        at_pose, at_aliases = self._likeness(images, pose, aliases.motions[:NEAR_ALIASES], None)
        power = np.maximum(_votes(at_pose, at_aliases), 0.0)
        best = _spread_choice(np.where(np.isfinite(power), power, 0.0).sum(0), self._points)
        self._points, self._normals = self._points[best], self._normals[best]
        self._templates = self._templates.take(best)
        self._usual = np.ones(len(best))
        self._last_likeness = np.full(len(best), np.nan)

    def compare(self, images: Pyramid, pose: Array, motions: Array, masks: TrackingMasks) -> tuple[Array, Array]:
        """Each probe's vote (K, P) for a pose (4, 4) against motions (K, 4, 4); likeness and usual likeness (2, P)."""
        at_pose, at_aliases = self._likeness(images, pose, motions, masks)
        self._last_likeness = at_pose
        vote = _votes(at_pose, at_aliases)
        valid = np.isfinite(vote) & (np.fmax(at_pose, at_aliases) > MIN_LIKENESS)
        visible = np.isfinite(at_pose)
        return np.where(valid, vote, 0.0), np.where(visible, np.stack([at_pose, self._usual]), 0.0)

    def learn(self) -> None:
        """Update the usual likeness by the last comparison."""
        visible = np.isfinite(self._last_likeness)
        self._usual[visible] += (self._last_likeness - self._usual)[visible] / USUAL_MEMORY_SETS

    def _likeness(
        self, images: Pyramid, pose: Array, motions: Array, masks: TrackingMasks | None
    ) -> tuple[Array, Array]:
        """Correlation (P,) of the probes at a pose (4, 4), and (K, P) at motions (K, 4, 4) of it; nan out of view."""
        transforms = np.concatenate([np.eye(4)[None], motions])
        rows = np.tile(np.arange(len(self._points)), len(transforms))
        turns = np.repeat(transforms[:, :3, :3], len(self._points), axis=0)
        templates = self._templates.take(rows)
        points = (transforms[:, None, :3, :3] @ self._points[..., None])[..., 0] + transforms[:, None, :3, 3]
        normals = (turns @ self._normals[rows, :, None])[..., 0]
        axes = turns @ templates.axes
        where = project_squares(self._lenses, self.camera, pose, points.reshape(-1, 3), normals, axes)
        score = coarse_score(templates, images, where, where.centre)
        visible = where.visible if masks is None else where.visible & ~masks.hides(self.camera, where.centre)
        likeness = np.where(visible, score, np.nan).reshape(len(transforms), -1)
        return likeness[0], likeness[1:]


def _votes(at_pose: Array, at_aliases: Array) -> Array:
    """Gain in correlation of probes at the pose (P,) over its aliases (K, P), less that of a shift error."""
    difference = at_pose - at_aliases
    return np.asarray(np.sign(difference) * np.clip(np.abs(difference) - MIN_PROBE_VOTE, 0.0, MAX_PROBE_VOTE))


def _spread_choice(power: Array, points: Array) -> Index:
    """Rows of up to USUAL_PROBES points (N, 3) with the most power (N,), PROBE_SPACING_MM apart if possible."""
    rows, order = list[int](), np.argsort(-power, kind="stable")
    for spacing in (PROBE_SPACING_MM, 0.0):
        for row in order:
            if len(rows) == USUAL_PROBES:
                break
            if row not in rows and (np.linalg.norm(points[rows] - points[row], axis=1) >= spacing).all():
                rows.append(int(row))
    return np.array(rows, np.int64)


GRAIN_STRIDE = 3  # every third landmark is compared, 40 of a camera: light affects all of them at once
GRAIN_MEMORY_SETS = 40.0  # over which a landmark's usual grain is averaged: it changes with the viewing angle
MIN_GRAIN_SETS = 5  # frame sets with it, from which it counts,
MIN_GRAIN_SHARE = 0.05  # and how much of its grain repeats from picture to picture: the rest is noise
MIN_GRAINS = 12  # tracks that must count for a verdict
# Least share of the usual grain, and the share of other grain above which its loss is not blur. With blur, defocus,
# shimmer or moving hairs 0.85 or more is left, and 0.14 or less is other grain. Limits are stricter while no camera
# shows the surface as usual, and after a rejection.
MIN_GRAIN, OTHER_GRAIN = 0.85, 0.2
MIN_GRAIN_UNUSUAL, OTHER_GRAIN_UNUSUAL = 0.92, 0.1


class Grain:
    """Compares the fine texture of one map's landmarks with the usual one in each camera."""

    def __init__(self, lenses: Lenses) -> None:
        self._lenses = lenses
        count = len(lenses.rig)
        # per camera and landmark: grain along its first picture, energy of all grain, contrast of the patch; looks
        self._usual, self._counts = np.zeros((count, 0, 3)), np.zeros((count, 0))
        self._first_grain: Float32 = np.zeros((0, PATCH_SAMPLES), np.float32)  # (L, S) of the landmarks' first pictures
        self._last_look: tuple[Index, Index, Array] | None = None  # cameras (N,), landmarks (N,), `_measure`
        self._rejected = False  # by the last verdict

    def __call__(
        self,
        pyramids: Mapping[int, Pyramid],
        tracks: Observations,
        pose: Array,
        surface_map: SurfaceMap,
        templates: Templates,
        unusual: bool = False,
    ) -> str:
        """Why tracks that carry a pose (4, 4) do not show the surface, or ''.

        unusual: whether no camera shows the surface as usual.
        """
        self._extend(templates.picture)
        self._last_look = None
        sample = tracks.select(tracks.track % GRAIN_STRIDE == 0)
        current = self._measure(pyramids, sample, pose, surface_map, templates.axes)
        camera, landmark = sample.camera, sample.track
        self._last_look = camera, landmark, current
        usual = self._usual[camera, landmark]
        repeats = usual[:, 0] ** 2 / np.maximum(usual[:, 1], 1e-9)
        ready = (self._counts[camera, landmark] >= MIN_GRAIN_SETS) & (repeats > MIN_GRAIN_SHARE)
        if np.count_nonzero(ready) < MIN_GRAINS:
            return ""
        share_left, other = _grain_left(usual[ready], current[ready], repeats[ready])
        strict = unusual or self._rejected
        min_left, max_other = (MIN_GRAIN_UNUSUAL, OTHER_GRAIN_UNUSUAL) if strict else (MIN_GRAIN, OTHER_GRAIN)
        self._rejected = share_left < min_left and other > max_other
        share = f"{100 * max(share_left, 0.0):.0f} % of it is left"
        return f"the skin's grain does not follow the tracks ({share}): they may follow light" if self._rejected else ""

    @property
    def message(self) -> str:
        """For the operator, where the surface has so little grain that it could not contradict light; or ''."""
        repeats = self._usual[..., 0] ** 2 > MIN_GRAIN_SHARE * self._usual[..., 1]
        ready = self._counts >= MIN_GRAIN_SETS
        if ready.sum() < 2 * MIN_GRAINS or (repeats & ready).sum() >= MIN_GRAINS:
            return ""
        return "the surface has hardly any fine texture: light that moves could be taken for it; light it evenly"

    def learn(self) -> None:
        """Update the usual grain by the last measurement."""
        if self._last_look is None:
            return
        camera, landmark, current = self._last_look
        counts = self._counts[camera, landmark] + 1
        self._counts[camera, landmark] = counts
        share = 1 / np.minimum(counts, GRAIN_MEMORY_SETS)
        self._usual[camera, landmark] += share[:, None] * (current - self._usual[camera, landmark])

    def _extend(self, pictures: Float32) -> None:
        """Add the first pictures (L, S) of new landmarks of the map."""
        count, extra = len(self._first_grain), len(pictures) - len(self._first_grain)
        if extra > 0:
            self._usual = np.pad(self._usual, ((0, 0), (0, extra), (0, 0)))
            self._counts = np.pad(self._counts, ((0, 0), (0, extra)))
            new = grain_of(pictures[count:])
            new /= np.maximum(np.linalg.norm(new, axis=1, keepdims=True), 1e-9)
            self._first_grain = np.concatenate([self._first_grain, new])

    def _measure(
        self,
        pyramids: Mapping[int, Pyramid],
        tracks: Observations,
        pose: Array,
        surface_map: SurfaceMap,
        axes: Array,
    ) -> Array:
        """(N, 3) of tracks: grain along the first picture, energy of all grain, contrast; grey levels."""
        rows, camera = tracks.track, tracks.camera
        poses = np.broadcast_to(pose, (len(self._lenses.rig), 4, 4))
        points, normals = surface_map.points[rows], surface_map.normals[rows]
        where = project_tracks_into(self._lenses, camera, poses, points, normals, axes[rows])
        pixels = self._lenses.image(camera, tracks.pixels, np.full(len(rows), np.inf))[0]
        levels = sample_each(pyramids, camera, pixels, where.per_sample)
        grain = grain_of(levels)
        along = np.einsum("ns,ns->n", grain, self._first_grain[rows])
        return np.stack([along, np.einsum("ns,ns->n", grain, grain), levels.std(1)], -1)


def _grain_left(usual: Array, current: Array, repeats: Array) -> tuple[float, float]:
    """Share of the usual grain that tracks show, and share of other grain, both relative to its energy.

    usual, current: (N, 3) as in `Grain`. repeats: (N,), share of each one's grain that is not noise.
    """
    gain = float(np.median(current[:, 2] / np.maximum(usual[:, 2], 1e-9)))  # of the light
    ratio = current[:, 0] / usual[:, 0] / gain
    energy = (current[:, 1] / gain**2 - usual[:, 1]) / usual[:, 0] ** 2 + 1  # without the usual noise
    share_left = float((repeats * np.clip(ratio, -0.5, 1.5)).sum() / repeats.sum())
    other = float((repeats * np.clip(energy - ratio**2, -1.0, 2.0)).sum() / repeats.sum())
    return share_left, other
