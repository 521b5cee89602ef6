"""Colours tell where the tissue is, whatever lies on it; light, hands and ink do not look like a displacement."""

from __future__ import annotations

from functools import cache
from itertools import islice

import numpy as np
import pytest

from estimation import se3
from estimation.observations import DisplacedPlaces
from estimation.pose import TrackState
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap
from perception.frames import Image
from perception.lens import Lenses
from perception.mapping.masks import BELL_MM, MASK_SCALE, MIN_SHIFT_MM, Colours, TrackingMasks
from tests.campaigns.deceit.judge import Judge, frame_sets, tracker
from tests.campaigns.deceit.kinds import NAMES, make_session
from tests.campaigns.deceit.scenes import TRICK, Session
from tests.campaigns.deceit.world import Renderer, on_tissue
from tests.slow_cases import slowly

SIZE, SEED = (480, 360), 11


@cache
def made(kind: str, variant: int = 0) -> Session:
    return make_session(SEED, NAMES.index(kind) + len(NAMES) * variant, SIZE)


def grid_map(session: Session, reach: float) -> SurfaceMap:
    """Landmarks over the tissue, as a tracker would have them."""
    side = np.arange(-reach, reach + 0.1, 5.0)
    points = on_tissue(session.world.relief, np.stack(np.meshgrid(side, side), -1).reshape(-1, 2))
    return SurfaceMap(points, np.tile([0.0, 0, 1], (len(points), 1)), 1e-4 * np.eye(3 * len(points)))


class Looked:
    """The colours of a session's tissue at its true poses, from the start on."""

    def __init__(self, session: Session, reach: float = 25.0) -> None:
        self.session, self.renderer = session, Renderer(session.world)
        lenses = Lenses(session.world.rig)
        self.colours = Colours(lenses, TrackingMasks(lenses))
        images, poses = self.seen(0)
        self.colours.begin(images, poses, grid_map(session, reach))

    def seen(self, number: int) -> tuple[dict[int, Image], dict[int, Array]]:
        frames = self.renderer.frame_set(number, float(self.session.stamps[number])).frames
        return {f.camera: f.image for f in frames}, {
            f.camera: self.session.world.base_from_surface(f.stamp) for f in frames
        }

    def __call__(self, number: int, shift: Array | tuple[float, ...] = (0.0, 0.0, 0.0)) -> DisplacedPlaces:
        images, poses = self.seen(number)
        moved = se3.make(np.eye(3), np.asarray(shift, float))
        return self.colours(images, {c: pose @ moved for c, pose in poses.items()})


@pytest.mark.parametrize("shift", [(1.2, 0.0, 0.0), *slowly((0.0, -1.2, 0.0), (0.8, 0.8, 0.0), (-2.0, 1.0, 0.0))])
def test_a_pose_that_is_off_along_the_surface_is_told_by_how_much(shift: tuple[float, ...]) -> None:
    look = Looked(made("plain"))
    for number in range(10):
        assert not len(look(number).distances)
    told = look(12, shift)
    size = float(np.linalg.norm(shift))
    assert told.ambiguous and 0.5 * size < told.distances.max() < 1.3 * size
    assert f"{told.distances.max():.1f} mm off the texture" in told.message
    assert not len(look(13).distances) and not look(13).message


@pytest.mark.parametrize(("shares", "told"), [((1.0, 0.0, 0.0), 0), ((0.6, 0.4, 0.0), 4), ((1.0,), 4)])
def test_a_displacement_is_what_a_second_camera_sees_as_well(shares: tuple[float, ...], told: int) -> None:
    """A print head that stood in one camera's first picture looks like one; where there is one camera, it must do."""
    colours = Looked(made("plain")).colours
    colours._centres, colours._sizes = np.zeros((4, 3)), np.zeros(4)
    shift = np.tile([1.5, 0.5, 0.0], (4, 1))
    normal = np.tile(1e3 * np.eye(3), (4, 1, 1))
    pulls = np.stack([share * 1e3 * shift for share in shares])
    explained = 1e3 * (shift**2).sum(1)
    found = colours._judge(normal, pulls, 1.1 * explained + 50, np.full(4, 50.0))
    assert len(found.distances) == told


def test_a_place_beside_the_print_head_of_the_first_picture_is_not_known() -> None:
    """Its average, or the slope of its colours, would hold some of the head."""
    look, camera = Looked(made("plain")), 1
    images, poses = look.seen(0)
    columns = int(np.median(look.colours._pixels(camera, poses[camera], look.colours._points)[:, 0]) * MASK_SCALE)
    mask = np.zeros(tuple(int(np.ceil(side * MASK_SCALE)) for side in images[camera].shape[:2]), np.uint8)
    mask[:, :columns] = 255
    look.colours._masks.print_head[camera] = mask
    look.colours.begin(images, poses, grid_map(look.session, 25.0))
    first = look.colours._first[camera]
    beside = look.colours._pixels(camera, poses[camera], look.colours._points)[first.free, 0] - columns / MASK_SCALE
    assert len(beside) > 50 and beside.min() > 1.5 * first.scale


@pytest.mark.parametrize(("displaced", "told"), [(2, 0), (3, 3)])
def test_a_displacement_is_what_several_places_see(displaced: int, told: int) -> None:
    """The edge of a hand can look like one here or there."""
    colours = Looked(made("plain")).colours
    colours._centres, colours._sizes = np.zeros((8, 3)), np.zeros(8)
    shift = np.where(np.arange(8)[:, None] < displaced, [1.5, 0.5, 0.0], 0.0)
    pull = 1e3 * shift
    found = colours._judge(
        np.tile(1e3 * np.eye(3), (8, 1, 1)),
        np.stack([pull, pull]) / 2,
        1.1 * (shift * pull).sum(1) + 50,
        np.full(8, 50.0),
    )
    assert len(found.distances) == told


def test_a_shadow_over_dark_tissue_is_no_displacement() -> None:
    """What is added to dark channels makes their ratios depend on the light; the more they do, the less they tell."""
    look = Looked(made("plain"))
    images, poses = look.seen(0)

    def darkened(image: Image, light: Array | float = 1.0) -> Image:
        return (image * (0.35 * light)).astype(np.uint8)

    look.colours.begin({c: darkened(image) for c, image in images.items()}, poses, grid_map(look.session, 25.0))
    for number in range(1, 12):
        images, poses = look.seen(number)
        shaded = {}
        for c, image in images.items():
            edge = look.colours._pixels(c, poses[c], np.array([[4.0, 0.0, 0.0]]))[0, 0]
            light = np.where((np.arange(image.shape[1]) > edge) & (number > 6), 0.4, 1.0)
            shaded[c] = darkened(image, light[None, :, None])
        assert not len(look.colours(shaded, poses).distances)


def test_what_is_told_is_remembered_until_the_colours_are_back() -> None:
    look = Looked(made("plain"))
    for number in range(8):
        look(number)
    sizes = [look(8 + k, (k * 0.5, 0.0, 0.0)).distances.max(initial=0.0) for k in range(40)]
    assert (np.diff(sizes) >= 0).all() and sizes[0] == 0 and sizes[-1] > 2.0
    assert not len(look(50).distances)


def test_grey_cameras_tell_nothing() -> None:
    look = Looked(made("plain"))
    images, poses = look.seen(0)
    look.colours.begin({c: image[..., 1].copy() for c, image in images.items()}, poses, grid_map(look.session, 25.0))
    moved = {c: pose @ se3.make(np.eye(3), [3.0, 0, 0]) for c, pose in poses.items()}
    assert not len(look.colours({c: image[..., 1].copy() for c, image in images.items()}, moved).distances)


@pytest.mark.parametrize("away", [-900.0, 900.0, 1e5])
def test_a_surface_out_of_view_or_behind_a_camera_tells_nothing(away: float) -> None:
    look = Looked(made("plain"))
    for axis in np.eye(3):
        assert not len(look(3, away * axis).distances)
    camera, rig = 0, look.session.world.rig
    behind = se3.inverse(rig.camera_from_base[camera]) @ se3.make(np.eye(3), [0.0, 0.0, -abs(away)])
    assert (look.colours._pixels(camera, behind, look.colours._points) < 0).all()  # the lens model says: the middle


def test_ink_has_its_own_colours() -> None:
    look = Looked(made("plain"))
    everywhere = look.colours._points
    look.colours.cover(everywhere)
    assert not len(look(8, (2.0, 0.0, 0.0)).distances)


@pytest.mark.parametrize(
    "kind",
    [
        "glove",
        *slowly(
            "shadow_drift",
            "wet_film",
            "exposure_steps",
            "lamp_at_rest",
            "flicker",
            "blur",
            "defocus",
            "focal_off",
            "camera_dark",
        ),
    ],
)
def test_light_hands_and_blur_are_no_displacement(kind: str) -> None:
    look = Looked(made(kind))
    numbers = range(0, len(look.session.stamps) - 1, 2)
    assert not [n for n in numbers if look(n).distances.max(initial=0.0) > 0]


@pytest.mark.slow  # a fast one is among the deceits
@pytest.mark.parametrize("variant", range(4))
def test_hairs_that_are_combed_aside_are_not_taken_for_the_skin(variant: int) -> None:
    session = made("hair", variant)
    step, judge = tracker(session), Judge(session)
    poses, verdicts = [], []
    for frames in frame_sets(session):
        poses.append(step(frames))
        verdicts.append(judge(poses[-1]))
        step.idle()
    assert not any(v.wrong for v in verdicts)
    assert all(p.state is TrackState.TRACKING for p in poses[5:TRICK])
    assert any("off the texture" in p.reason for p in poses) or max(v.error for v in verdicts[5:]) < 1.0


def test_the_first_colours_are_those_of_the_pose_they_are_learned_at() -> None:
    """A busy machine leaves no time between frame sets: the surface is then learned some of them later."""
    session, pause = made("plain"), 8
    step, poses = tracker(session), []
    for number, frames in enumerate(islice(frame_sets(session), 40)):
        poses.append(step(frames))
        if number % pause == pause - 1:
            step.idle()
    places = np.array([p.base_from_surface[:3, 3] for p in poses])
    assert np.linalg.norm(places[pause:] - places[:-pause], axis=1).max() > MIN_SHIFT_MM
    assert [p.reason for p in poses if "off the texture" in p.reason] == []
    assert sum(p.state is TrackState.TRACKING for p in poses) > 20


def test_the_claim_of_displaced_places_reaches_as_far_as_they_are() -> None:
    places = DisplacedPlaces(np.zeros((1, 3)), np.array([2.0]), BELL_MM, True)
    assert np.sqrt(places.covariance[3, 3]) == 2.0 > MIN_SHIFT_MM and not places.covariance[:3].any()
