"""The wound's area in mm^2: laws of scale and motion, truth on rendered wounds, what is not measured, the command."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from estimation import se3
from estimation.rig import Camera, Rig, pixels_from_points
from estimation.synthetic.world import BASE_FROM_REST, arc_rig
from hardware.bench.pictures import spread_figures
from hardware.cli.main import main
from hardware.files.images import encode
from hardware.files.rig_file import ImageSource, write_rig
from hardware.offline.segment import AREA_TABLE, NO_BAND, UNCALIBRATED, area_text, input_files
from hardware.simulator.scene.render import WoundSet, wound_set
from perception.tracking.wound_area import (
    ELSEWHERE,
    FEW_POINTS,
    NO_VIEW,
    NORMAL_95,
    OFF_SURFACE,
    ONE_VIEW,
    RIG_SCALE_SIGMA,
    SkinSurface,
    WoundArea,
    area_on_surface,
    pixel_patches,
    quadric,
    wound_area,
)
from perception.training.dataset import Labelled
from perception.wound.network import WoundNetwork, shipped_model
from perception.wound.segmentation import NetworkSegmenter, Segmentation, WoundBand, WoundMask
from tests.slow_cases import slowly
from tests.test_segmentation import SETTINGS, disc, picture, red_is_wound

RIG = arc_rig(distortion=(0.0,) * 5)
FLAT = SkinSurface(BASE_FROM_REST, np.zeros(6), np.zeros((6, 6)))
NARROW = NORMAL_95 * 2 * RIG_SCALE_SIGMA  # half an interval of the logarithm where nothing but the rig's scale is open
rendered = cache(wound_set)  # seeds 0, 8, 14: a large, a small and a middling wound, of three bodies and picture sizes


def exact(outline: WoundMask, inner: WoundMask | None = None, outer: WoundMask | None = None) -> WoundBand:
    found = Segmentation(outline, 1.0, 0.5)
    return WoundBand(found, outline, outline if inner is None else inner, outline if outer is None else outer)


def true_bands(taken: WoundSet) -> dict[int, WoundBand]:
    return {c: exact(mask) for c, mask in enumerate(taken.wounds)}


@cache
def measured(taken: WoundSet, rig: Rig | None = None) -> WoundArea:
    area = wound_area(rig or taken.rig, dict(enumerate(taken.images)), true_bands(taken), 1.0)
    assert isinstance(area, WoundArea)
    return area


def circle(camera: Camera, radius: float, skin: SkinSurface = FLAT, at: tuple[float, float] = (0.0, 0.0)) -> WoundMask:
    """(H, W) what a camera sees of a circle of `radius` mm about a place of the skin frame."""
    about = np.array(np.meshgrid(*2 * [[-1.5 * radius, 1.5 * radius]])).reshape(2, 4).T + at
    corners = se3.transform_points(skin.base_from_skin, np.column_stack([about, quadric(about) @ skin.coefficients]))
    about = np.clip(np.rint(pixels_from_points(camera, corners)[0]).astype(int), 0, camera.size)
    low, high = about.min(0), about.max(0)
    x, y = np.meshgrid(np.arange(low[0], high[0], dtype=float), np.arange(low[1], high[1], dtype=float))
    points = skin.points(camera, np.column_stack([x.ravel(), y.ravel()]))
    mask = np.zeros(camera.size[::-1], bool)
    mask[low[1] : high[1], low[0] : high[0]] = (np.linalg.norm(points[:, :2] - at, axis=1) < radius).reshape(x.shape)
    return mask


def circles(radii: tuple[float, ...], skin: SkinSurface = FLAT) -> dict[int, WoundBand]:
    return {c: exact(circle(RIG.cameras[c], radius, skin)) for c, radius in enumerate(radii)}


def on_surface(bands: dict[int, WoundBand], skin: SkinSurface = FLAT, spread: float = 1.0) -> WoundArea:
    area = area_on_surface(RIG, skin, bands, spread)
    assert isinstance(area, WoundArea)
    return area


def test_a_circle_on_a_plane_has_its_area_from_every_side() -> None:
    area = on_surface(circles((12.0, 12.0, 12.0)))
    assert area.each == pytest.approx(np.pi * 12**2, rel=4e-3)  # of 2000 pixels
    assert np.log(area.high / area.low) / 2 == pytest.approx(NARROW, rel=0.05)
    assert area.cameras == (0, 1, 2)


def test_a_pixel_shows_the_point_of_a_curved_surface_that_projects_to_it() -> None:
    skin = replace(FLAT, coefficients=np.array([0.4, 0.05, -0.03, -0.004, 0.001, -0.003]))
    pixels = np.array([[620.0, 340.0], [700.0, 420.0], [560.0, 330.0]])
    for camera in arc_rig().cameras:
        points = skin.points(camera, pixels)
        assert points[:, 2] == pytest.approx(quadric(points[:, :2]) @ skin.coefficients, abs=1e-9)
        seen, depth = pixels_from_points(camera, se3.transform_points(BASE_FROM_REST, points))
        assert seen == pytest.approx(pixels, abs=1e-5) and (depth > 0).all()


def test_what_bends_away_has_more_area_than_its_outline_on_a_plane() -> None:
    radius = 50.0  # of curvature, about as a forearm's
    skin = replace(FLAT, coefficients=np.array([0, 0, 0, -0.5 / radius, 0, -0.5 / radius]))
    r = 12.0
    true = 2 * np.pi / 3 * radius**2 * ((1 + (r / radius) ** 2) ** 1.5 - 1)  # of the paraboloid
    assert on_surface(circles((r, r, r), skin), skin).each == pytest.approx(true, rel=5e-3)
    assert true > 1.01 * np.pi * r**2


def test_the_interval_holds_the_band_the_disagreement_and_the_surfaces_own_doubt() -> None:
    same = circles((12.0, 12.0, 12.0))
    narrow = on_surface(same)
    banded = {c: exact(b.outline, circle(RIG.cameras[c], 11.0), circle(RIG.cameras[c], 13.5)) for c, b in same.items()}
    for spread in (1.0, 2.0):
        area = on_surface(banded, spread=spread)
        assert area.outline == pytest.approx((spread * 2 * np.log(12 / 11), spread * 2 * np.log(13.5 / 12)), rel=0.03)
        assert np.log(area.area / area.low) == pytest.approx(np.hypot(area.outline[0], NARROW), rel=0.05)
        assert np.log(area.high / area.area) == pytest.approx(np.hypot(area.outline[1], NARROW), rel=0.05)
    apart = on_surface(circles((11.0, 12.0, 13.0)))
    logs = np.log(apart.each)
    assert apart.disagreement == pytest.approx(
        4.3027 * logs.std(ddof=1) / np.sqrt(3), rel=1e-3
    )  # Student, 2 of freedom
    assert apart.high - apart.low > 2 * (narrow.high - narrow.low)
    two = on_surface({c: b for c, b in circles((11.0, 12.0, 13.0)).items() if c < 2})
    assert two.disagreement == pytest.approx(12.706 * np.abs(np.diff(np.log(two.each)))[0] / 2, rel=1e-3)
    doubtful = replace(FLAT, covariance=np.diag([0, 0.05, 0.05, 0, 0, 0]) ** 2)
    assert on_surface(same, doubtful).geometry > 2 * narrow.geometry


def test_an_unsure_network_has_no_lower_limit_but_zero() -> None:
    bands = {c: exact(b.outline, np.zeros_like(b.outline), b.outline) for c, b in circles((12.0, 12.0, 12.0)).items()}
    area = on_surface(bands)
    assert area.low == 0.0 < area.area < area.high < 1.1 * area.area


@pytest.mark.parametrize("factor", [0.5, 3.0])
def test_area_on_a_surface_goes_with_the_square_of_the_scale(factor: float) -> None:
    bands = circles((11.0, 12.0, 13.0))
    before, after = (area_on_surface(scaled(RIG, f), scaled_skin(f), bands, 1.0) for f in (1.0, factor))
    assert isinstance(before, WoundArea) and isinstance(after, WoundArea)
    for name in ("area", "low", "high"):
        assert getattr(after, name) == pytest.approx(factor**2 * getattr(before, name), rel=1e-9)


def scaled(rig: Rig, factor: float) -> Rig:
    moved = []
    for camera in rig.cameras:
        pose = camera.base_from_camera.copy()
        pose[:3, 3] *= factor
        moved.append(replace(camera, base_from_camera=pose))
    return Rig(tuple(moved))


def scaled_skin(factor: float) -> SkinSurface:
    pose = BASE_FROM_REST.copy()
    pose[:3, 3] *= factor
    return replace(FLAT, base_from_skin=pose)


def moved(rig: Rig, new_from_old: np.ndarray) -> Rig:
    return Rig(tuple(replace(c, base_from_camera=new_from_old @ c.base_from_camera) for c in rig.cameras))


@pytest.mark.slow
def test_the_area_of_the_same_pictures_goes_with_the_square_of_the_rigs_scale() -> None:
    taken = rendered(14)
    before, after = measured(taken), measured(taken, scaled(taken.rig, 1.2))
    for name in ("area", "low", "high"):
        assert getattr(after, name) == pytest.approx(1.44 * getattr(before, name), rel=0.01)


@pytest.mark.slow
def test_a_rig_that_is_moved_as_a_whole_with_what_it_sees_measures_the_same_area() -> None:
    taken = rendered(14)
    somewhere = se3.make(se3.exp_rotation([0.4, -1.1, 2.0]), [300.0, -120.0, 45.0])
    before, after = measured(taken), measured(taken, moved(taken.rig, somewhere))
    # the surface is matched on another lattice, to a few um
    assert after.area == pytest.approx(before.area, rel=3e-3)
    for name in ("low", "high"):
        assert getattr(after, name) == pytest.approx(getattr(before, name), rel=2e-2)


def test_an_area_on_a_surface_moves_with_rig_and_surface() -> None:
    somewhere, bands = se3.make(se3.exp_rotation([0.4, -1.1, 2.0]), [300.0, -120.0, 45.0]), circles((11.0, 12.0, 13.0))
    skin = replace(FLAT, coefficients=np.array([0.1, 0.02, -0.01, -0.004, 0.001, -0.003]))
    before = area_on_surface(RIG, skin, bands, 1.0)
    after = area_on_surface(moved(RIG, somewhere), replace(skin, base_from_skin=somewhere @ BASE_FROM_REST), bands, 1.0)
    assert isinstance(before, WoundArea) and isinstance(after, WoundArea)
    assert (after.area, after.low, after.high) == pytest.approx((before.area, before.low, before.high), rel=1e-8)


@pytest.mark.parametrize("seed", [14, *slowly(0, 8)])
def test_the_area_inside_true_outlines_is_the_true_one(seed: int) -> None:
    taken = rendered(seed)
    area = measured(taken)
    assert area.low <= taken.area <= area.high
    assert area.area == pytest.approx(taken.area, rel=0.025)
    assert area.high < 1.2 * area.low  # and the interval is no excuse


@pytest.mark.parametrize("seed", [14, *slowly(0, 8)])
def test_the_networks_interval_holds_the_true_area(segmenter: NetworkSegmenter, seed: int) -> None:
    taken = rendered(seed)
    images = dict(enumerate(taken.images))
    bands = {c: segmenter.band(image) for c, image in images.items()}
    assert all((band.inner <= band.outline).all() and (band.outline <= band.outer).all() for band in bands.values())
    assert all(np.array_equal(bands[c].found.mask, segmenter(image).mask) for c, image in images.items())
    area = wound_area(taken.rig, images, bands, segmenter.settings.spread)
    assert isinstance(area, WoundArea)
    assert area.low <= taken.area <= area.high and area.low < area.area < area.high


@pytest.fixture(scope="module")
def segmenter() -> NetworkSegmenter:
    network = WoundNetwork(shipped_model(), 1)
    return NetworkSegmenter(network, network.settings)


def nowhere(bands: dict[int, WoundBand], camera: int) -> dict[int, WoundBand]:
    return {**bands, camera: exact(np.zeros_like(bands[camera].outline))}


def at_the_border(bands: dict[int, WoundBand], camera: int) -> dict[int, WoundBand]:
    cut = np.roll(bands[camera].outline, -int(np.flatnonzero(bands[camera].outline.any(1))[0]) - 3, 0)
    return {**bands, camera: exact(cut)}


@pytest.mark.slow
def test_what_cannot_be_measured_is_said_and_no_number_is_given() -> None:
    taken = rendered(14)
    images, bands = dict(enumerate(taken.images)), true_bands(taken)
    for spoil in (nowhere, at_the_border):
        two = spoil(bands, 0)
        area = wound_area(taken.rig, images, two, 1.0)
        assert isinstance(area, WoundArea) and area.cameras == (1, 2)
    assert wound_area(taken.rig, images, nowhere(two, 1), 1.0) == ONE_VIEW
    assert wound_area(taken.rig, images, nowhere(nowhere(two, 1), 2), 1.0) == NO_VIEW
    assert wound_area(taken.rig, {0: images[0]}, {0: bands[0]}, 1.0) == ONE_VIEW
    blank = {c: np.full_like(image, 120) for c, image in images.items()}
    reason = wound_area(taken.rig, blank, bands, 1.0)
    assert isinstance(reason, str) and reason.startswith(FEW_POINTS)


def test_outlines_of_different_places_or_beyond_the_surface_are_no_wound() -> None:
    aside = circle(RIG.cameras[1], 12.0, at=(14.0, 0.0))
    assert area_on_surface(RIG, FLAT, {**circles((12.0, 12.0)), 1: exact(aside)}, 1.0) == ELSEWHERE
    behind = replace(FLAT, base_from_skin=BASE_FROM_REST @ se3.make(np.eye(3), [0.0, 0.0, 3000.0]))
    assert area_on_surface(RIG, behind, circles((12.0, 12.0)), 1.0) == OFF_SURFACE
    # a camera that the surface is turned away from, where a part of its outline lies: the others measure
    sharp = replace(FLAT, coefficients=np.array([0, 0, 0, 0, 0, -0.03]))
    beyond = np.zeros_like(aside)
    beyond[300:420, 200:1000] = True
    assert not np.isfinite(pixel_patches(RIG.cameras[2], sharp, (200, 300, 1000, 420))[0]).all()
    area = on_surface({**circles((9.0, 9.0), sharp), 2: exact(beyond)}, sharp)
    assert area.cameras == (0, 1)


def test_an_outline_has_no_holes_and_is_the_largest_part() -> None:
    image, _ = picture((60, 60), 25, (120, 160))
    other, _ = picture((130, 30), 8, (120, 160))
    image[disc((120, 160), (130, 30), 8)] = other[disc((120, 160), (130, 30), 8)]
    image[disc((120, 160), (60, 60), 6)] = 150
    band = NetworkSegmenter(red_is_wound, SETTINGS).band(image)
    assert not band.found.mask[60, 60] and band.outline[60, 60] and not band.outline[30, 130]
    assert band.whole and not exact(disc((120, 160), (3, 60), 8)).whole


def write_session(folder: Path, taken: WoundSet, instants: int = 1) -> Path:
    sources, rows = [], ["camera,frame,stamp_s"]
    for camera, image in zip(taken.rig.cameras, taken.images, strict=True):
        (folder / camera.name).mkdir(parents=True)
        for number in range(instants):
            (folder / camera.name / f"{number}.png").write_bytes(encode(image)[1])
            rows.append(f"{camera.name},{number},{number / 30!r}")
        sources.append(ImageSource("images", f"{camera.name}/*.png"))
    write_rig(folder / "rig.toml", taken.rig, sources)
    (folder / "frames.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    return folder


def table(file: Path) -> list[dict[str, str]]:
    with file.open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


Printed = Callable[[], str]


@pytest.fixture
def printed(capsys: pytest.CaptureFixture[str]) -> Printed:
    return lambda: capsys.readouterr().out


def test_segment_prints_the_area_of_a_sessions_wound_with_its_interval(tmp_path: Path, printed: Printed) -> None:
    taken = rendered(14)
    session = write_session(tmp_path / "ward", taken)
    assert main(["segment", str(session), "-o", str(tmp_path / "masks")]) == 0
    said = printed()
    (row,) = table(tmp_path / "masks" / AREA_TABLE)
    area, low, high = (float(row[name]) for name in ("area_mm2", "low_mm2", "high_mm2"))
    assert low <= taken.area <= high and area == pytest.approx(taken.area, rel=0.3)
    words = re.search(r"^ward: wound of (\S+) mm\^2, 95 % interval (\S+) to (\S+) mm\^2, by 3 cameras$", said, re.M)
    assert words is not None, said
    assert [float(word) for word in words.groups()] == pytest.approx([area, low, high], rel=5e-4)  # four digits
    assert row["cameras"] == "cam_0 cam_1 cam_2" and row["reason"] == "" and row["session"] == "ward"
    masks = {file.name for file in (tmp_path / "masks").glob("*.png")}
    assert masks == {f"ward_cam_{c}_000000.png" for c in range(3)}
    assert main(["import", str(session), "-o", str(tmp_path / "ward.mcap")]) == 0
    assert main(["segment", str(tmp_path / "ward.mcap"), "-o", str(tmp_path / "again")]) == 0
    assert (tmp_path / "again" / AREA_TABLE).read_text() == (tmp_path / "masks" / AREA_TABLE).read_text()


def test_segment_says_why_there_is_no_area(tmp_path: Path, printed: Printed) -> None:
    taken = rendered(14)
    session = write_session(tmp_path / "ward", taken)
    one = write_session(tmp_path / "one", replace(taken, images=taken.images[:1], rig=Rig(taken.rig.cameras[:1])))
    picture_file = session / "cam_0" / "0.png"
    for words, reason in (
        ([str(session), "--method", "shape"], NO_BAND),
        ([str(picture_file)], UNCALIBRATED),
        ([str(picture_file), "--mm-per-px", "0.5"], UNCALIBRATED),
        ([str(one)], "no two cameras have a picture of one instant"),
    ):
        assert main(["segment", *words, "-o", str(tmp_path / "out"), "--force"]) == 0
        said = printed()
        assert f"no area in mm^2: {reason}\n" in said and "interval" not in said.replace(NO_BAND, "")
    skin = replace(taken, images=tuple(np.full_like(image, 150) for image in taken.images))
    bare = write_session(tmp_path / "bare", skin)
    assert main(["segment", str(bare), "-o", str(tmp_path / "bare_out")]) == 0
    assert f"bare: no area in mm^2: {NO_VIEW}\n" in printed()
    (row,) = table(tmp_path / "bare_out" / AREA_TABLE)
    assert row["reason"] == NO_VIEW and row["area_mm2"] == row["low_mm2"] == row["high_mm2"] == ""


def test_the_areas_of_several_instants_are_told_by_their_medians_and_by_what_failed() -> None:
    one = on_surface(circles((12.0, 12.0, 12.0)))
    areas = [replace(one, area=factor * 100, low=factor * 80, high=factor * 130) for factor in (1.0, 1.1, 5.0)]
    assert area_text(areas[:1]) == "wound of 100 mm^2, 95 % interval 80 to 130 mm^2, by 3 cameras"
    medians = "wound of 110 mm^2, 95 % interval 88 to 143 mm^2, by 2 to 3 cameras at each of 3 instants, of which these"
    told = area_text([*areas[:2], replace(areas[2], cameras=(0, 1)), ONE_VIEW, FEW_POINTS, ONE_VIEW])
    assert told == f"{medians} are the medians; at 3 of 6 instants there is none: {ONE_VIEW}"
    assert area_text([NO_VIEW]) == f"no area in mm^2: {NO_VIEW}"


def test_the_spread_is_judged_by_labels_and_asked_for_by_a_quantile_of_their_residuals() -> None:
    def labelled(radius: int, at: tuple[int, int] = (80, 60)) -> Labelled:
        image, _ = picture((80, 60), 25, (120, 160))
        return Labelled("x", np.ascontiguousarray(image[..., ::-1]), disc((120, 160), at, radius))

    near = [labelled(25) for _ in range(4)]
    segmenter = NetworkSegmenter(soft_red, SETTINGS)
    inside, asked = spread_figures(segmenter, near)
    assert inside.value == 1.0 and 0 < asked.value <= segmenter.settings.spread
    far = [*near, labelled(40)]
    inside, asked = spread_figures(segmenter, far)
    assert inside.value == 0.8 and asked.value > segmenter.settings.spread
    # what is found elsewhere is no error of an outline
    assert spread_figures(segmenter, [*near, labelled(6, (12, 12))])[0].value == 1.0
    assert spread_figures(segmenter, []) == []


def soft_red(planes: np.ndarray) -> np.ndarray:
    """The logits of `red_is_wound`, going over from one side to the other over some pixels."""
    logits = red_is_wound(planes)
    logits[0, 0] = cv2.GaussianBlur(3 * logits[0, 0], (0, 0), 4.0)
    return logits


def test_a_folder_is_a_session_only_with_rig_and_frames_and_a_broken_one_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = write_session(tmp_path / "ward", rendered(8))
    assert input_files([session]) == [session]
    assert input_files([session / "cam_0"]) == [session / "cam_0" / "0.png"]
    (session / "rig.toml").write_text("[[camera]]\n", encoding="utf-8")
    assert main(["segment", str(session), "-o", str(tmp_path / "out")]) == 2
    assert "rig.toml" in capsys.readouterr().err
    assert not list((tmp_path / "out").glob("*.png"))
