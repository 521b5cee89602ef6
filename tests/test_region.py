"""Regions: what is accepted as one, and that a printed picture on a table is followed rather than the table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation.errors import InputError
from estimation.pose import SurfacePose, identity_pose
from estimation.rig import Rig
from hardware.files.region_table import (
    ANY_REGION,
    MAX_CORNERS,
    PATCH_COLOUR,
    Corners,
    RegionBy,
    RegionSettings,
    check_region,
    corners_from,
    read_region,
    region_from_table,
)
from hardware.live.settings import LiveSettings, check_settings, read_settings, settings_text
from hardware.offline.track import DRAW_TEXT, region_search, tracker
from hardware.operator.shared_state import Polygons
from hardware.process.system import SharedLatest
from perception.frames import FrameSet, Roi, region_polygons, region_since
from perception.tracking.step import TrackingStep
from perception.tracking.wound_step import EDGE_SHARE, PATCH_SEARCH_TEXT, RegionSearch, RegionTrackingStep
from perception.wound.segmentation import ColourSegmenter
from tests.printed_sheet import FPS, FRAME_RGB, SIZE, corners_at, displacement_errors, pictures, region, rig
from tests.uptime import DAY

SQUARE = [[10, 10], [90, 10], [90, 60], [10, 60]]
MAX_ERROR = 0.05  # mm, of a sheet that is moved by several mm

stars = st.builds(  # corners in turn round a place, none at the same angle
    lambda turns, reach: [
        [200 + r * np.cos(2 * np.pi * t), 130 + r * np.sin(2 * np.pi * t)] for t, r in zip(turns, reach, strict=False)
    ],
    st.lists(st.integers(0, 99), min_size=5, max_size=20, unique=True).map(lambda turns: np.sort(turns) / 100),
    st.lists(st.floats(40, 120), min_size=20, max_size=20),
)


def around(corners: Sequence[Sequence[float]]) -> bool:
    """Whether they go all round their middle."""
    angles = np.arctan2(*(np.array(corners) - [200, 130]).T[::-1])
    steps = np.diff(np.append(angles, angles[0])) % (2 * np.pi)
    return bool(steps.max() < np.pi - 0.1)


@given(stars.filter(around), st.integers(0, 19))
def test_a_star_is_a_region_from_whichever_corner_and_in_either_sense(star: list[list[float]], first: int) -> None:
    for corners in (star, star[::-1], np.roll(star, first, axis=0).tolist()):
        assert corners_from("here", "left", corners) == tuple(map(tuple, corners))


@given(stars.filter(around), st.data())
def test_two_corners_exchanged_cross_and_are_refused(star: list[list[float]], data: st.DataObject) -> None:
    convex = [
        [200 + 90 * (x - 200) / np.hypot(x - 200, y - 130), 130 + 90 * (y - 130) / np.hypot(x - 200, y - 130)]
        for x, y in star
    ]
    i = data.draw(st.integers(0, len(convex) - 2))
    convex[i], convex[i + 1] = convex[i + 1], convex[i]
    with pytest.raises(InputError, match=r"left = .*meet|px\^2"):
        corners_from("here", "left", convex)


@pytest.mark.parametrize(
    ("corners", "words"),
    [
        ("all", "N x 2 finite numbers"),
        ([[1, 2, 3]] * 3, "N x 2"),
        ([[0, 0], [50, float("nan")], [50, 50]], "finite"),
        (SQUARE[:2], "3 to 64 corners"),
        ([[100 + k, 50 + 40 * (k % 2)] for k in range(MAX_CORNERS + 1)], "3 to 64 corners"),
        ([[0, 0], [5, 0], [5, 5]], "400 px"),
        ([*SQUARE, SQUARE[-1]], "meet"),  # a corner twice
        ([*SQUARE[:2], [90, 200], [90, 60], [10, 60]], "meet"),  # an edge that folds back
        ([[0, 0], [90, 0], [90, 90], [45, 0], [0, 90]], "meet"),  # a corner on another edge
    ],
)
def test_what_is_no_polygon_is_refused(corners: object, words: str) -> None:
    with pytest.raises(InputError, match=words):
        corners_from("session.toml", "region.left", corners)


CORNERS = st.just(tuple((float(x), float(y)) for x, y in SQUARE))
NAMES = st.text(
    st.characters(codec="utf-8", exclude_characters='/\\,".', categories=("L", "N")), min_size=1, max_size=9
)
REGIONS = st.one_of(
    st.just(ANY_REGION),
    st.sampled_from(
        [RegionSettings(RegionBy.POLYGON), RegionSettings(RegionBy.NETWORK), RegionSettings(RegionBy.PICTURE)]
    ),
    st.sampled_from(["#ff0000", PATCH_COLOUR, "#0033CC"]).map(
        lambda colour: RegionSettings(RegionBy.COLOUR, (), colour)
    ),
    st.dictionaries(NAMES.filter(lambda name: name not in ("by", "colour")), CORNERS, min_size=1).map(
        lambda polygons: RegionSettings(RegionBy.POLYGON, tuple(polygons.items()))
    ),
)


@given(REGIONS)
def test_a_region_is_read_as_it_was_written(tmp_path_factory: pytest.TempPathFactory, asked: RegionSettings) -> None:
    file = tmp_path_factory.mktemp("region") / "session.toml"
    file.write_text(settings_text(LiveSettings(region=asked)), encoding="utf-8")
    assert read_settings(file).region == asked == read_region(file)


@pytest.mark.parametrize(
    ("table", "key", "words"),
    [
        (3, "region = 3", "a table"),
        ({"by": "hand"}, "region.by = 'hand'", "polygon, network, colour, picture"),
        ({"by": [SQUARE]}, "region.by", "one of polygon"),
        ({"by": "network", "left": SQUARE}, "region.left = 'corners'", 'by = "network"'),
        ({"by": "picture", "colour": PATCH_COLOUR}, "region.colour", 'by = "picture"'),
        ({"colour": "green"}, "region.colour = 'green'", "#rrggbb"),
        ({"colour": "#808590"}, "region.colour", "far from grey"),
        ({"left": [[0, 0]]}, "region.left = '1 corners'", "3 to 64"),
    ],
)
def test_a_table_that_makes_no_sense_is_refused_by_its_key(table: object, key: str, words: str) -> None:
    with pytest.raises(InputError, match=words) as refused:
        region_from_table("session.toml", table)
    assert key in str(refused.value)


def test_a_region_is_of_the_rigs_cameras_two_at_least_and_in_their_pictures() -> None:
    good = {"camera0": SQUARE, "camera2": SQUARE}
    check_region("here", region_from_table("here", good), rig())
    beyond = [[10, 10], [SIZE[0] - 0.5, 10], [90, 60]]
    for wrong, words in (
        ({**good, "camera7": SQUARE}, "did you mean"),
        ({"camera0": SQUARE}, "two|2 cameras or more"),
        ({**good, "camera1": beyond}, r"0\.\.479 x 0\.\.269 px"),
    ):
        with pytest.raises(InputError, match=words):
            check_region("here", region_from_table("here", wrong), rig())
    undrawn = LiveSettings(rig=Path(__file__), path=Path(__file__), record=Path("x.mcap"), arm="virtual", page=False)
    with pytest.raises(InputError, match="page"):
        check_settings(LiveSettings(**{**_fields(undrawn), "region": RegionSettings(RegionBy.POLYGON)}), "here")


def _fields(settings: LiveSettings) -> dict[str, object]:
    return {name: getattr(settings, name) for name in ("rig", "path", "record", "arm", "page")}


@given(st.sampled_from([10.0, DAY, 100 * DAY]), st.floats(0, 1), st.sampled_from([5.0, 30.0, 120.0]))
def test_a_recorded_region_counts_from_its_set_on_at_any_uptime(uptime: float, part: float, rate: float) -> None:
    sizes, stamps = [camera.size for camera in rig().cameras], uptime + part + np.arange(9) / rate
    rois = [region_since(roi, float(stamps[4])) for roi in region()]
    known = [not isinstance(region_polygons(rois, FrameSet(float(stamp), ()), sizes), str) for stamp in stamps]
    assert known == [False] * 4 + [True] * 5


# -- a printed picture of skin on a table


@cache
def sets() -> tuple[FrameSet, ...]:
    return tuple(pictures(np.arange(22) / FPS))


def followed(step: Callable[[FrameSet], SurfacePose], idle: Callable[[], None]) -> list[SurfacePose]:
    poses = []
    for frames in sets():
        poses.append(step(frames))
        idle()
    return poses


def errors_of(poses: Sequence[SurfacePose]) -> np.ndarray:
    """(N,) mm of the measured ones."""
    measured = [pose for pose in poses if pose.state.measured]
    return displacement_errors(np.array([p.stamp for p in measured]), np.stack([p.base_from_surface for p in measured]))


@pytest.mark.slow
def test_a_sheet_on_a_table_is_followed_by_its_polygon() -> None:
    settings = RegionSettings(RegionBy.POLYGON, tuple((c.name, drawn(k)) for k, c in enumerate(rig().cameras)))
    step = TrackingStep(rig(), settings.rois(rig(), -np.inf))
    poses = followed(step, step.idle)
    off = errors_of(poses)
    assert len(off) > 15 and off.max() < MAX_ERROR


def drawn(camera: int) -> Corners:
    """The sheet as somebody clicks round it, 2 mm inside its edge."""
    return corners_from("the page", "camera", corners_at(0.0, rig().cameras[camera], 2.0).round(1).tolist())


@pytest.mark.slow  # by its polygon it is followed above
def test_a_sheet_on_a_table_is_followed_inside_its_coloured_frame() -> None:
    asked: list[tuple[Roi, ...]] = []

    def made(rois: Sequence[Roi]) -> TrackingStep:
        asked.append(tuple(rois))
        return TrackingStep(rig(), rois)

    step = RegionTrackingStep(rig(), made, RegionSearch(rig(), ColourSegmenter(FRAME_RGB), patch=True))
    poses = followed(step, step.idle)
    off = errors_of(poses)
    assert poses[0].reason == PATCH_SEARCH_TEXT and len(off) > 12 and off.max() < MAX_ERROR
    (rois,) = asked
    for roi, camera in zip(rois, rig().cameras, strict=True):
        outline = corners_at(roi.stamp, camera)
        drawn_in = (1 - EDGE_SHARE) * outline + EDGE_SHARE * outline.mean(0)
        assert all(np.linalg.norm(roi.polygon - corner, axis=1).min() < 3.0 for corner in drawn_in)  # px
        assert len(roi.polygon) <= 8


class Shown:
    """A tracking step that notes which frame sets it is given."""

    def __init__(self, stamps: list[float]) -> None:
        self.stamps, self.last = stamps, None

    def __call__(self, frames: FrameSet) -> SurfacePose:
        self.stamps.append(frames.stamp)
        return identity_pose(frames.stamp, "shown")


def test_tracking_begins_with_the_pictures_in_which_the_frame_was_found() -> None:
    """What is framed may have moved on since, and a frame set later its region would hold some of the table."""
    shown, found = list[float](), list[Roi]()

    def made(rois: Sequence[Roi]) -> TrackingStep:
        found.extend(rois)
        return Shown(shown)  # type: ignore[return-value]

    step = RegionTrackingStep(rig(), made, RegionSearch(rig(), ColourSegmenter(FRAME_RGB), patch=True))
    for frames in sets()[:9]:
        step(frames)
    stamps = [frames.stamp for frames in sets()[:9]]
    assert shown[0] == found[0].stamp == stamps[0] and shown[1] > stamps[1] and shown[-1] == stamps[-1]
    for roi, camera in zip(found, rig().cameras, strict=True):
        edge = np.float32(corners_at(shown[0], camera))[:, None]
        assert all(cv2.pointPolygonTest(edge, [float(x) for x in corner], True) > 1.0 for corner in roi.polygon)  # px
        assert cv2.contourArea(np.float32(roi.polygon)) > 0.7 * cv2.contourArea(edge)


@pytest.mark.slow
def test_without_a_region_the_table_is_followed_instead() -> None:
    step = TrackingStep(rig(), region_from_table("here", {"by": "picture"}).rois(rig(), -np.inf))
    assert errors_of(followed(step, step.idle)).max() > 1.0


def test_a_frame_is_looked_for_until_all_cameras_have_shown_it() -> None:
    search = RegionSearch(rig(), ColourSegmenter(FRAME_RGB), patch=True)
    two = replace(sets()[0], frames=sets()[0].frames[:2])
    known = [each for frames in (two, *sets()[1:9]) if not isinstance(each := search(frames), str)]
    assert known and [roi.camera for roi in known[0]] == [0, 1, 2]


def test_a_frame_of_another_colour_is_waited_for() -> None:
    search = RegionSearch(rig(), ColourSegmenter((0, 60, 220)), patch=True)
    assert {str(search(frames)) for frames in sets()} == {PATCH_SEARCH_TEXT}


def test_a_drawn_region_is_waited_for_and_taken_once_it_is_there() -> None:
    line = SharedLatest[Polygons]()
    search = region_search(rig(), RegionSettings(RegionBy.POLYGON), line)
    assert search is not None
    find, frames = search(None), sets()[3]  # type: ignore[arg-type]  # nothing is looked for in a thread
    assert find(frames) == DRAW_TEXT
    line.put((("camera0", drawn(0)), ("camera2", drawn(2))))
    rois = find(frames)
    assert [roi.camera for roi in rois if isinstance(roi, Roi)] == [0, 2]
    assert all(roi.stamp == frames.stamp for roi in rois if isinstance(roi, Roi))
    assert np.array_equal(list(rois)[1].polygon, drawn(2))  # type: ignore[union-attr]
    line.put((("camera9", drawn(0)), ("camera2", drawn(2))))
    with pytest.raises(InputError, match="camera9"):
        find(frames)


def test_nothing_is_looked_for_where_nobody_asks() -> None:
    assert region_search(rig(), ANY_REGION, SharedLatest()) is None


def test_a_rig_of_one_camera_is_refused_before_its_pictures_are_read() -> None:
    alone = Rig(rig().cameras[:1])
    with (
        pytest.raises(InputError, match="cameras = 1, allowed 2 or more: one camera sees no depth"),
        tracker(alone, ()),
    ):
        pass
