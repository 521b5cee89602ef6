"""Scenario files: what each key does, one line that names file and key for each that makes no sense."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from estimation import se3
from estimation.errors import InputError
from estimation.synthetic.world import BASE_FROM_REST, arc_rig
from hardware.arm.profile import ArmProfile
from hardware.files.mesh_file import write_ply
from hardware.files.rig_file import ImageSource, write_rig
from hardware.process.faults import FaultKind
from hardware.simulator.scenario import read_scenario
from hardware.simulator.scenario_tables import scene_from_table, sensor_from_table
from hardware.simulator.scene.shape import flat
from tests.simulated_worlds import write_path, write_scenario

LOST = {"cameras": {"off": [["cam_9", 1, 2]]}}


def test_a_scenario_of_title_seconds_and_path_has_a_default_for_everything_else(tmp_path: Path) -> None:
    file = tmp_path / "least.toml"
    file.write_text('title = "Least"\nseconds = 20\npath = "x.csv"\n')
    scenario = read_scenario(file)
    assert (scenario.file, scenario.path, scenario.title, scenario.seconds) == (file, tmp_path / "x.csv", "Least", 20.0)
    assert (scenario.seed, scenario.clearance, scenario.bead, scenario.faults) == (1, None, 1.0, ())
    assert scenario.tracking.pictures and scenario.tracking.processing == 0.02
    assert not scenario.tracking.scan
    assert (scenario.nozzle, scenario.beads, scenario.jpeg_quality, scenario.strain) == (True, True, 90, None)
    assert [camera.name for camera in scenario.rig.cameras] == ["cam_0", "cam_1", "cam_2"]
    assert np.array_equal(scenario.motion(np.array([3.0]))[0], np.eye(4)) and scenario.limits == {}


def test_the_motion_knows_all_of_the_lag_that_there_is_unless_told_otherwise(tmp_path: Path) -> None:
    wire = 48 * 10 / 115200
    assert read_scenario(write_scenario(tmp_path)).profile.lag == pytest.approx(0.02 + wire)
    slow = read_scenario(write_scenario(tmp_path, arm={"dead_time_s": 0.1, "servo_lag_s": 0.05, "wire_baud": math.inf}))
    assert slow.profile.lag == pytest.approx(0.15) and slow.baud == math.inf
    told = read_scenario(write_scenario(tmp_path, arm={"dead_time_s": 0.1, "assumed_lag_s": 0.0}))
    assert told.profile.lag == 0.0 and told.arm.dead_time == 0.1


def test_the_arm_is_placed_so_that_the_resting_surface_lies_level_below_its_home(tmp_path: Path) -> None:
    scenario = read_scenario(write_scenario(tmp_path))
    arm_from_surface = scenario.true_arm.arm_from_base @ scenario.rest
    assert arm_from_surface == pytest.approx(se3.make(np.eye(3), [202.5, 225.0, 50.0]), abs=1e-9)
    assert np.array_equal(scenario.rest, BASE_FROM_REST)


def test_planted_offsets_are_in_what_the_loop_is_told_and_not_in_what_is(tmp_path: Path) -> None:
    plain = read_scenario(write_scenario(tmp_path))
    planted = {"rig_offset_mm": [0.1, -0.2, 0.3], "arm_offset_mm": [1, 2, 3]}
    scenario = read_scenario(write_scenario(tmp_path, planted=planted))
    for camera, told, usual in zip(scenario.rig.cameras, scenario.known_rig.cameras, plain.rig.cameras, strict=True):
        assert np.array_equal(camera.base_from_camera, usual.base_from_camera)
        assert (told.base_from_camera - camera.base_from_camera)[:3, 3] == pytest.approx([0.1, -0.2, 0.3])
    assert np.array_equal(scenario.true_arm.arm_from_base, plain.true_arm.arm_from_base)
    shift = se3.inverse(scenario.true_arm.arm_from_base) @ scenario.profile.arm.arm_from_base
    assert shift == pytest.approx(se3.make(np.eye(3), [1.0, 2, 3]), abs=1e-9)


def test_a_trace_takes_the_place_of_the_scenarios_own_motion(tmp_path: Path) -> None:
    trace = tmp_path / "moved.tum"
    trace.write_text("".join(f"{t / 10} 0 0 {t / 10} 0 0 0 1\n" for t in range(200)))
    file = write_scenario(tmp_path, motion=[{"kind": "ramp", "speed_mm_s": [100, 0, 0]}])
    moved = read_scenario(file, trace).motion(np.array([0.0, 10.0]))[:, :3, 3]
    assert np.linalg.norm(moved[1] - moved[0]) == pytest.approx(10.0, abs=0.1)
    assert abs(moved[1, 0] - moved[0, 0]) < 0.1


def test_a_rig_may_come_from_a_file_or_be_an_arc(tmp_path: Path) -> None:
    rig = arc_rig((0.0, 60.0), size=(640, 480))
    write_rig(tmp_path / "rig.toml", rig, [ImageSource("images", f"{c.name}/*") for c in rig.cameras])
    read = read_scenario(write_scenario(tmp_path, rig={"file": "rig.toml"})).rig
    assert [c.size for c in read.cameras] == [(640, 480)] * 2
    arc = read_scenario(write_scenario(tmp_path, rig={"angles_deg": [0, 60], "size": [640, 480]})).rig
    for one, other in zip(read.cameras, arc.cameras, strict=True):
        assert one.base_from_camera == pytest.approx(other.base_from_camera)


def test_words_become_what_they_say(tmp_path: Path) -> None:
    tables = {
        "tracking": {"by": "truth", "processing_s": "measured", "register": "scan"},
        "sensor": {"jpeg_quality": 0},
        "scene": {"nozzle": False, "beads": False, "body": "chest"},
        "faults": ["arm stall 600ms at 5s", "camera1 stuck at 2s for 1s"],
        "strain": {"kind": "sine", "rate_hz": 0.25},
    }
    scenario = read_scenario(write_scenario(tmp_path, tables))
    tracking = scenario.tracking
    assert (tracking.pictures, tracking.processing, tracking.scan) == (False, None, True)
    assert (scenario.jpeg_quality, scenario.nozzle, scenario.beads) == (None, False, False)
    assert scenario.scene == {"body": "chest"}
    assert [fault.kind for fault in scenario.faults] == [FaultKind.STALL, FaultKind.STUCK]
    assert scenario.strain is not None and scenario.strain(np.array([1.0])) == pytest.approx([1.0])


def test_chance_depends_on_the_seed(tmp_path: Path) -> None:
    tremor = [{"kind": "tremor", "rms_mm": [0.1, 0.1, 0.1]}]
    strain = {"kind": "breathing", "period_spread": 0.3}
    times = np.linspace(0, 20, 30)
    files = (write_scenario(tmp_path, motion=tremor, strain=strain, seed=seed) for seed in (1, 1, 2))
    one, same, other = map(read_scenario, files)
    assert np.array_equal(one.motion(times), same.motion(times))
    assert not np.array_equal(one.motion(times), other.motion(times))
    assert one.strain is not None and same.strain is not None and other.strain is not None
    assert np.array_equal(one.strain(times), same.strain(times))
    assert not np.array_equal(one.strain(times), other.strain(times))


WRONG = [
    ("title", {"title": ""}), ("title", {"title": 3}), ("seconds", {"seconds": 0.05}), ("seconds", {"seconds": 3601}),
    ("seconds", {"seconds": "long"}), ("seconds", {"seconds": math.inf}), ("seed", {"seed": -1}),
    ("seed", {"seed": 1.5}), ("path", {"path": 3}), ("path", {"path": ""}), ("clearance_mm", {"clearance_mm": -0.1}),
    ("clearance_mm", {"clearance_mm": True}), ("bead_mm", {"bead_mm": 0}), ("faults", {"faults": "arm stall 600ms"}),
    ("faults[1]", {"faults": ["arm drop", "arm dance"]}), ("faults[0]", {"faults": [5]}),
    ("faults", {"faults": ["camera9 off"]}), ("faults", {"faults": ["disk full"]}), ("motion", {"motion": 5}),
    ("motion", {"motion": {"kind": "sine"}}), ("motion[0].kind", {"motion": [{"kind": "dance"}]}),
    ("motion[1].rate_hz", {"motion": [{"kind": "hand", "rms_mm": [1, 1, 1]}, {"kind": "sine", "amplitude_mm": 1}]}),
    ("motion[0].file", {"motion": [{"kind": "trace"}]}), ("titel", {"titel": "x"}),
    *((table, {table: 5}) for table in ("scene", "strain", "rig", "cameras", "sensor", "tracking", "arm", "limits")),
    ("planted", {"planted": []}), ("scene.nozzle", {"scene": {"nozzle": 1}}),
    ("scene.beads", {"scene": {"beads": "yes"}}), ("strain.kind", {"strain": {"rate_hz": 0.25}}),
    ("strain.kind", {"strain": {"kind": "hand"}}),
    ("strain.amplitude_mm", {"strain": {"kind": "sine", "rate_hz": 1, "amplitude_mm": 1}}),
    ("rig.angle", {"rig": {"angle": 3}}), ("rig.angles_deg", {"rig": {"angles_deg": 3}}),
    ("rig.angles_deg", {"rig": {"angles_deg": []}}), ("rig.distance_mm", {"rig": {"distance_mm": 50}}),
    ("rig.focal_px", {"rig": {"focal_px": 50}}), ("rig.size", {"rig": {"size": [640]}}),
    ("rig.size", {"rig": {"size": [640, 0]}}), ("rig.size", {"rig": {"size": [640.5, 480]}}),
    ("rig.size", {"rig": {"size": [64000, 48000]}}),
    ("rig.distortion", {"rig": {"distortion": [0, 0, 0, 0]}}),
    ("rig.size", {"rig": {"file": "rig.toml", "size": [640, 480]}}),
    ("cameras.fps", {"cameras": {"fps": 0}}), ("cameras.exposure_s", {"cameras": {"exposure_s": 1}}),
    ("cameras.transport_s", {"cameras": {"transport_s": -0.1}}),
    ("cameras.offset_s", {"cameras": {"offset_s": [0, 0]}}),
    ("cameras.offset_s.side", {"cameras": {"offset_s": {"side": 0.01}}}),
    ("cameras.off[0]", LOST),
    ("cameras.drop + duplicate + garble", {"cameras": {"drop": 0.5, "duplicate": 0.3, "garble": 0.3}}),
    ("cameras.shutter", {"cameras": {"shutter": 1}}),
    ("sensor.jpeg_quality", {"sensor": {"jpeg_quality": -1}}),
    ("sensor.jpeg_quality", {"sensor": {"jpeg_quality": 101}}),
    ("sensor.jpeg_quality", {"sensor": {"jpeg_quality": 90.5}}),
    ("noise", {"sensor": {"noise": -1}}), ("sensor.grain", {"sensor": {"grain": 1}}),
    ("tracking.by", {"tracking": {"by": "magic"}}),
    ("tracking.processing_s", {"tracking": {"processing_s": -0.01}}),
    ("tracking.processing_s", {"tracking": {"processing_s": "fast"}}),
    ("tracking.register", {"tracking": {"register": "hand"}}),
    ("tracking.scan", {"tracking": {"scan": True}}), ("arm.file", {"arm": {"file": 3}}),
    ("arm.assumed_lag_s", {"arm": {"assumed_lag_s": -0.01}}),
    ("arm.assumed_lag_s", {"arm": {"assumed_lag_s": 1.01}}),
    ("arm.assumed_lag_s", {"arm": {"assumed_lag_s": "none"}}),
    ("arm.dead_time_s + servo_lag_s", {"arm": {"dead_time_s": 0.9, "servo_lag_s": 0.9}}),
    ("arm.wire_baud", {"arm": {"wire_baud": 9600}}), ("arm.wire_baud", {"arm": {"wire_baud": "fast"}}),
    ("arm.wire_baud", {"arm": {"wire_baud": True}}), ("arm.wire_baud", {"arm": {"wire_baud": math.nan}}),
    ("arm.tool_mm", {"arm": {"tool_mm": [[0, 1]]}}), ("arm.tool_mm", {"arm": {"tool_mm": "needle"}}),
    ("arm.dead_time_s", {"arm": {"dead_time_s": -0.1}}), ("arm.replies", {"arm": {"replies": "loud"}}),
    ("arm.speed", {"arm": {"speed": 1}}),
    ("planted.rig_offset_mm", {"planted": {"rig_offset_mm": [1, 2]}}),
    ("planted.arm_offset_mm", {"planted": {"arm_offset_mm": 1}}),
    ("planted.wound", {"planted": {"wound": [1, 2, 3]}}), ("limits.p95", {"limits": {"p95": 1}}),
    ("limits.duty", {"limits": {"duty": 1.5}}), ("limits.p95_mm", {"limits": {"p95_mm": -1}}),
]  # fmt: skip


@pytest.mark.parametrize(("key", "change"), WRONG, ids=[f"{key} {i}" for i, (key, _) in enumerate(WRONG)])
def test_what_makes_no_sense_is_refused_by_file_and_key(key: str, change: dict[str, object], tmp_path: Path) -> None:
    file = write_scenario(tmp_path, change)
    with pytest.raises(InputError) as refused:
        read_scenario(file)
    assert refused.value.where == str(file)
    assert key in str(refused.value.what)
    assert refused.value.allowed


@pytest.mark.parametrize("key", ["title", "seconds", "path"])
def test_what_must_be_there_is_named(key: str, tmp_path: Path) -> None:
    file = write_scenario(tmp_path)
    file.write_text("\n".join(line for line in file.read_text().splitlines() if not line.startswith(key)))
    with pytest.raises(InputError, match=f"scenario.toml: {key}.*missing"):
        read_scenario(file)


@pytest.mark.parametrize("text", ["", "title = ", "\xff"])
def test_what_is_no_toml_is_refused(text: str, tmp_path: Path) -> None:
    file = tmp_path / "scenario.toml"
    file.write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=r"scenario\.toml"):
        read_scenario(file)


def test_the_files_that_a_scenario_names_must_be_there(tmp_path: Path) -> None:
    for change, name in (
        ({"rig": {"file": "none.toml"}}, "none.toml"),
        ({"arm": {"file": "gone.toml"}}, "gone.toml"),
        ({"motion": [{"kind": "trace", "file": "lost.tum"}]}, "lost.tum"),
    ):
        with pytest.raises(InputError, match=name):
            read_scenario(write_scenario(tmp_path, change))
    with pytest.raises(InputError, match=r"nothing\.toml"):
        read_scenario(tmp_path / "nothing.toml")


def test_the_tool_is_the_arm_files_unless_the_scenario_tells_another(tmp_path: Path) -> None:
    assert np.array_equal(read_scenario(write_scenario(tmp_path)).profile.tool, ArmProfile().tool)
    file = write_scenario(tmp_path, arm={"file": "arm.toml"})
    with (tmp_path / "arm.toml").open("a") as arm:
        arm.write("tool_mm = [[0, 1], [20, 3]]\n")
    assert read_scenario(file).profile.tool.tolist() == [[0, 1], [20, 3]]
    told = tmp_path / "told.toml"
    told.write_text(file.read_text().replace('"arm.toml"', '"arm.toml", tool_mm = [[0, 2], [9, 4]]'))
    assert read_scenario(told).profile.tool.tolist() == [[0, 2], [9, 4]]


def test_files_are_relative_to_the_scenario(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "deep").mkdir()
    write_path(tmp_path / "deep" / "path.csv", [[0, 0, 0], [1, 0, 0]])
    file = write_scenario(tmp_path / "deep", arm={"file": "arm.toml"})
    monkeypatch.chdir(tmp_path)
    scenario = read_scenario(file.relative_to(tmp_path))
    assert scenario.path.exists() and not np.array_equal(scenario.true_arm.home, ArmProfile().arm.home)


COARSE = {"texel_mm": 0.8}


def test_a_table_says_what_is_built() -> None:
    table = {
        **COARSE,
        "body": "chest",
        "wetness": 0.9,
        "tone": 0.6,
        "wound_size_mm": [30, 20],
        "deformation": {"stretch": [0.01, 0.005], "bulge_mm": 1.0, "radius_mm": 30.0},
    }
    scene = scene_from_table("a.toml", table, Path(), 2)
    assert (scene.look.wetness, scene.look.tone, scene.look.texel) == (0.9, 0.6, 0.8)
    assert (scene.deformation.stretch, scene.deformation.bulge, scene.deformation.radius) == ((0.01, 0.005), 1.0, 30.0)
    assert scene.opening == pytest.approx((120.0, 90.0))
    np.testing.assert_array_equal(scene.base_from_rest, BASE_FROM_REST)
    bare = scene_from_table("a.toml", {**COARSE, "wound": False, "drape": False}, Path(), 2)
    assert bare.shape.inside is None and bare.opening == bare.shape.size


def test_a_scan_is_read_beside_the_file_and_keeps_its_frame(tmp_path: Path) -> None:
    source = scene_from_table("a.toml", {**COARSE, "body": "chest", "wound": False}, tmp_path, 0).shape
    vertices, triangles = source.mesh(3.0)
    write_ply(tmp_path / "scan.ply", vertices + [100.0, -20.0, 40.0], triangles)
    scene = scene_from_table("a.toml", {**COARSE, "scan": "scan.ply"}, tmp_path, 0)
    xy = source.grid(15.0, 0.6)
    points = source.points(xy) + [100.0, -20.0, 40.0]
    np.testing.assert_allclose(scene.shape.points(scene.shape.material(points)), points, atol=0.25)
    assert scene.shape.inside is not None


def test_a_scan_that_is_closed_has_no_outside_and_is_refused(tmp_path: Path) -> None:
    corners = np.array([[0.0, 0, 0], [40, 0, 0], [0, 40, 0], [0, 0, 40]])
    write_ply(tmp_path / "scan.ply", corners, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))
    with pytest.raises(InputError, match="mean normal") as caught:
        scene_from_table("a.toml", {**COARSE, "scan": "scan.ply"}, tmp_path, 0)
    assert caught.value.where == str(tmp_path / "scan.ply")


def test_a_scan_too_small_for_a_drape_is_taken_without_one(tmp_path: Path) -> None:
    write_ply(tmp_path / "scan.ply", *flat((30.0, 60.0)).mesh(5.0))
    table = {**COARSE, "scan": "scan.ply", "wound": False}
    with pytest.raises(InputError, match=r"30\.0 x 60\.0 mm") as caught:
        scene_from_table("a.toml", table, tmp_path, 0)
    assert caught.value.what == "scene.drape"
    assert scene_from_table("a.toml", {**table, "drape": False}, tmp_path, 0).opening == pytest.approx((30.0, 60.0))


@pytest.mark.parametrize(
    ("table", "what"),
    [
        ({"bodi": "chest"}, "scene.bodi"), ({"body": "leg"}, "scene.body"),
        ({"body": "chest", "scan": "x.ply"}, "scene"), ({"wetness": 1.001}, "scene.wetness"),
        ({"tone": -0.001}, "scene.tone"), ({"hair": "much"}, "scene.hair"), ({"texel_mm": 0.049}, "scene.texel_mm"),
        ({"texel_mm": 1.001}, "scene.texel_mm"), ({"drape": 1}, "scene.drape"), ({"wound": "yes"}, "scene.wound"),
        ({"wound_size_mm": [30]}, "scene.wound_size_mm"), ({"wound_size_mm": [30, 4.99]}, "scene.wound_size_mm"),
        ({"wound_depth_mm": 8.01}, "scene.wound_depth_mm"),
        ({"deformation": {"bulge": 1.0}}, "scene.deformation.bulge"),
        ({"deformation": {"bulge_mm": 30.01}}, "scene.deformation.bulge_mm"),
        ({"deformation": {"stretch": [0.51, 0]}}, "scene.deformation.stretch"),
        ({"deformation": {"radius_mm": 4.99}}, "scene.deformation.radius_mm"),
        ({"deformation": 3}, "scene.deformation"), ({"scan": "missing.ply"}, "scan"),
    ],
)  # fmt: skip
def test_wrong_values_are_named(table: dict[str, Any], what: str) -> None:
    with pytest.raises(InputError) as caught:
        scene_from_table("a.toml", {**COARSE, **table}, Path("/nowhere"), 0)
    assert what in caught.value.what
    assert caught.value.where.endswith(("a.toml", "missing.ply"))


@pytest.mark.parametrize(
    ("table", "what"),
    [
        ({"noise": 50.01}, "noise"),
        ({"vignetting": -0.01}, "vignetting"),
        ({"blur_px": 10.01}, "blur_px"),
        ({"blur_px": float("nan")}, "blur_px"),
        ({"iso": 1}, "iso"),
    ],
)
def test_wrong_sensors_are_named(table: dict[str, Any], what: str) -> None:
    with pytest.raises(InputError) as caught:
        sensor_from_table("a.toml", table)
    assert caught.value.what == f"sensor.{what}" and caught.value.where == "a.toml"


def test_a_sensor_is_what_its_table_says() -> None:
    sensor = sensor_from_table("a.toml", {"noise": 2.0, "vignetting": 0.5, "blur_px": 0.7})
    assert (sensor.noise, sensor.vignetting, sensor.blur) == (2.0, 0.5, 0.7)
