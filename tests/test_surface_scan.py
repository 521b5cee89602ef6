"""`stillbed scan`: the cameras' own scan beside the true surface, its file, its page, and what it refuses."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from estimation import se3
from estimation.errors import InputError, StillbedError
from estimation.pose import TrackState, identity_pose
from estimation.scans.registration import register
from estimation.scans.scan import ScanIndex, face_normals, scan_from_triangles, triangulate_lattice
from estimation.se3 import Array
from estimation.synthetic.world import BASE_FROM_REST, arc_rig
from hardware.cli.plan import scanned_settings
from hardware.files.mesh_file import read_mesh, read_raw_mesh, write_scan
from hardware.live.settings import FROM_CAMERAS, LiveSettings, read_settings
from hardware.live.surface_scan import (
    ScanOrder,
    ScanSource,
    SurfaceScan,
    TrackedFrames,
    _FrameSelection,
    camera_advice,
    check_scan,
    fuse,
    scan_page,
    scan_surface,
)
from hardware.simulator.scene.appearance import Appearance, Sensor
from hardware.simulator.scene.render import render
from hardware.simulator.scene.scene import Scene, WorldState, rois
from perception.frames import Frame, FrameSet, Image
from planning.layers.repair import repair_mesh
from tests.campaigns.mapping import shape_of
from tests.campaigns.scan import scan_figures
from tests.outside_cameras import outside, wound_scene
from tests.test_first_print import PROGRAM, region

RIG = arc_rig(size=(640, 360), focal=550.0)  # a node of 0.8 mm: errors are about twice those of the bench
SHAPE = shape_of("forearm", 1)
POSES = [BASE_FROM_REST @ se3.exp([0.02 * k, 0.01 * k, 0.0, 0.4 * k, 0.5 * k, 2.0 * k]) for k in range(2)]


@pytest.fixture(scope="module")
def images() -> list[list[Image]]:
    """Pictures of a wet forearm at each pose."""
    scene, rng = Scene(SHAPE, Appearance(wetness=1.0), seed=1), np.random.default_rng(3)
    return [
        render(scene, RIG.cameras, [WorldState(0.0, 0.0, pose, np.zeros(6))] * 3, Sensor(), rng.spawn(3))
        for pose in POSES
    ]


def fused(images: list[list[Image]]) -> SurfaceScan:
    """The scan at true poses, begun on the skin as if there was no wound."""
    assert SHAPE.inside is not None
    flat = SHAPE.grid(3.0)
    x, y = np.rint(SHAPE.nodes(flat)).astype(int).T
    skin = (SHAPE.inside[y, x] < -2) & (np.abs(flat) < [30.0, 22.0]).all(1)
    chosen = []
    for pose, pictures in zip(POSES, images, strict=True):
        frames = FrameSet(0.0, tuple(Frame(c, 0.0, image) for c, image in enumerate(pictures)))
        found = replace(identity_pose(0.0, ""), base_from_surface=pose)
        chosen.append(TrackedFrames(frames, found, dict.fromkeys(range(3), pose)))
    scene = Scene(SHAPE, Appearance(), seed=1)
    return fuse(RIG, rois(scene, RIG, POSES[0], 0.0), SHAPE.points(flat[skin]), chosen)


@pytest.fixture(scope="module")
def scanned(images: list[list[Image]]) -> SurfaceScan:
    return fused(images)


def errors(scanned: SurfaceScan) -> tuple[Array, Array]:
    """Error (V,) mm across the true surface, and how far inside the wound (V,) mm each vertex lies."""
    assert SHAPE.inside is not None
    place = SHAPE.material(scanned.scan.vertices)
    x, y = np.rint(SHAPE.nodes(place)).astype(int).T
    off = scanned.scan.vertices - SHAPE.points(place)
    return np.abs(np.einsum("ni,ni->n", off, SHAPE.normals(place))), SHAPE.inside[y, x]


def test_the_scan_lies_on_the_true_surface_and_states_how_well(scanned: SurfaceScan) -> None:
    error, inside = errors(scanned)
    for mine, middle, high in ((inside < 0, 0.12, 0.45), (inside > 0, 0.18, 1.0)):
        assert np.median(error[mine]) < middle
        assert np.percentile(error[mine], 95) < high
        assert 0.4 < np.median(error[mine] / scanned.sigma[mine]) / 0.6745 < 1.6
    assert scanned.coverage > 0.95


def test_what_one_camera_alone_sees_stays_open(images: list[list[Image]]) -> None:
    covered = [[image.copy() for image in pictures] for pictures in images]
    for pictures, pose in zip(covered, POSES, strict=True):
        for c in (0, 1):
            inner = se3.transform_points(se3.inverse(RIG.cameras[c].base_from_camera), pose[:3, 3][None])[0]
            x, y = (RIG.cameras[c].matrix @ inner / inner[2])[:2].astype(int)
            pictures[c][y - 12 : y + 12, x - 12 : x + 12] = 255  # a mirror's glare
    scanned = fused(covered)
    near = np.linalg.norm(scanned.scan.vertices[:, :2], axis=1).min()
    assert near > 4.0  # mm: the middle is a hole
    assert scanned.coverage < 0.97
    assert "A camera at" in camera_advice(scanned)


def test_its_file_is_read_again_and_needs_no_repair(scanned: SurfaceScan, tmp_path: Path) -> None:
    file, scan = tmp_path / "wound.ply", scanned.scan
    write_scan(file, scan.vertices, scan.triangles, scanned.colours, scanned.sigma)
    raw = read_raw_mesh(file)
    assert len(raw.vertices) == len(scan.vertices)
    assert np.abs(raw.vertices - scan.vertices).max() < 1e-4
    assert raw.colours is not None
    assert np.array_equal(raw.colours, scanned.colours)
    assert b"property float sigma" in file.read_bytes()[:400]
    repaired, repairs = repair_mesh(raw.vertices, raw.triangles, file)
    assert len(repaired.triangles) > 0.95 * len(scan.triangles)
    assert not (repairs.broken or repairs.empty or repairs.turned or repairs.islands or repairs.inside_out)


def test_its_page_shows_it(scanned: SurfaceScan) -> None:
    page = scan_page(scanned, "a scan")
    assert page.count("data:image/png;base64,") == 5
    for words in ("from above", "Who saw it", "cam_2", "Where to put a camera", "standard deviation, 95 %"):
        assert words in page


def test_a_lattices_triangles_face_the_eye_and_leave_holes_open() -> None:
    sure = np.ones((5, 6), bool)
    sure[2, 3] = False
    used, triangles = triangulate_lattice(sure)
    points = np.column_stack([used % 6, used // 6, np.zeros(len(used))]).astype(float)
    assert len(triangles) == 2 * 20 - 6
    assert 2 * 6 + 3 not in used
    assert (face_normals(scan_from_triangles(points, triangles))[:, 2] == 1).all()


@pytest.mark.slow
def test_a_breathing_body_is_scanned_as_the_tracker_follows_it() -> None:
    for figure in scan_figures("forearm", "wet", 4):
        assert figure.target is not None
        assert figure.unit == "s" or figure.target.met(figure.value), figure


def test_pictures_without_a_surface_are_said_to_have_none() -> None:
    rng = np.random.default_rng(1)

    def noise(stamp: float) -> FrameSet:
        shots = (rng.integers(0, 255, (360, 640, 3)).astype(np.uint8) for _ in range(3))
        return FrameSet(stamp, tuple(Frame(c, stamp, shot) for c, shot in enumerate(shots)))

    scene = Scene(SHAPE, Appearance(), seed=1)
    source = ScanSource(RIG, rois(scene, RIG, POSES[0], 0.0), (noise(0.1 * k) for k in range(3)))
    with pytest.raises(StillbedError, match="the surface was not found"):
        scan_surface(source, 2, 1.0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"out": Path("x.stl")}, "ends in .ply"),
        ({"sets": 1}, "--sets = 1, allowed 2 to 40"),
        ({"seconds": 0.0}, "--seconds"),
        ({"out": Path("nowhere/x.ply")}, "no such folder"),
    ],
)
def test_wrong_orders_are_refused(change: dict[str, object], words: str, tmp_path: Path) -> None:
    order = ScanOrder(tmp_path, tmp_path / "x.ply")
    with pytest.raises(InputError, match=words.replace(".", r"\.")):
        check_scan(replace(order, **change))  # type: ignore[arg-type]


def test_a_scan_that_is_there_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "x.html").write_text("")
    with pytest.raises(InputError, match="--force"):
        check_scan(ScanOrder(tmp_path, tmp_path / "x.ply"))
    assert check_scan(ScanOrder(tmp_path, tmp_path / "x.ply", force=True)).force


def test_where_the_first_sets_take_longer_than_the_scan_it_goes_on_until_two_are_followed() -> None:
    taken, picture = _FrameSelection(6, 4.0), np.zeros((4, 4, 3), np.uint8)
    seen = []
    for stamp in (0.0, 9.0, 12.0, 13.5, 14.0):
        frames = FrameSet(stamp, tuple(Frame(c, stamp, picture) for c in range(2)))
        pose = replace(identity_pose(stamp, ""), state=TrackState.TRACKING)
        seen.append(taken.add(frames, pose, dict))
    assert seen == [True, True, True, False, False]
    assert [each.frames.stamp for each in taken.selected()] == [0.0, 9.0, 12.0]


def test_a_run_may_scan_for_itself(tmp_path: Path) -> None:
    file = tmp_path / "session.toml"
    file.write_text(f'[print]\nscan = "{FROM_CAMERAS}"\n', encoding="utf-8")
    settings = replace(read_settings(file), rig=tmp_path, arm="virtual", record=tmp_path / "run.mcap")
    assert settings.scan is not None
    assert settings.scan.name == FROM_CAMERAS
    (tmp_path / "run.mcap").write_bytes(b"")
    with pytest.raises(InputError, match="a file that exists"):
        scanned_settings(settings, file, force=False)
    plain = LiveSettings(scan=tmp_path / "scan.ply")
    assert scanned_settings(plain, file, force=False) is plain


@pytest.mark.slow
def test_cameras_of_another_program_scan_the_wound_that_they_show(tmp_path: Path) -> None:
    with outside(tmp_path, "wound") as rig:
        corners = "\n".join(f"{name} = {polygon}" for name, polygon in region().items())
        (tmp_path / "region.toml").write_text(f"[region]\n{corners}\n")
        order = "scan", rig, "-o", tmp_path / "scan.ply", "--region", tmp_path / "region.toml", "--seconds", "6"
        done = subprocess.run([*PROGRAM, *map(str, order)], capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 0 and "cm² scanned from" in done.stdout, done.stdout + done.stderr
    assert "Traceback" not in done.stderr and (tmp_path / "scan.html").stat().st_size > 10_000
    found, true = read_mesh(tmp_path / "scan.ply"), scan_from_triangles(*wound_scene().shape.mesh(0.5))
    place = register(found.vertices[:: len(found.vertices) // 800], 0.1, true, np.array([0.0, 0.0, 1.0]))
    points = se3.transform_points(se3.inverse(place.base_from_surface), found.vertices)
    off = np.linalg.norm(points - ScanIndex(true).closest(points).points, axis=1)
    print("scanned", np.percentile(off, [50, 95]))
    assert np.percentile(off, 50) < 0.1 and np.percentile(off, 95) < 0.4
