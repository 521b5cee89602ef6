"""Scenes and sensors from tables: what is written is what is built, and every wrong value is named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from estimation.errors import InputError
from estimation.synthetic.arc_rig import REST
from hardware.ply_file import write_ply
from hardware.simulator.scene.shape import flat
from hardware.simulator.scene_table import scene_from_table, sensor_from_table

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
    np.testing.assert_array_equal(scene.base_from_rest, REST)
    bare = scene_from_table("a.toml", {**COARSE, "wound": False, "drape": False}, Path(), 2)
    assert bare.shape.inside is None
    assert bare.opening == bare.shape.size


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
        ({"bodi": "chest"}, "scene.bodi"),
        ({"body": "leg"}, "scene.body"),
        ({"body": "chest", "scan": "x.ply"}, "scene"),
        ({"wetness": 1.001}, "scene.wetness"),
        ({"tone": -0.001}, "scene.tone"),
        ({"hair": "much"}, "scene.hair"),
        ({"texel_mm": 0.049}, "scene.texel_mm"),
        ({"texel_mm": 1.001}, "scene.texel_mm"),
        ({"drape": 1}, "scene.drape"),
        ({"wound": "yes"}, "scene.wound"),
        ({"wound_size_mm": [30]}, "scene.wound_size_mm"),
        ({"wound_size_mm": [30, 4.99]}, "scene.wound_size_mm"),
        ({"wound_depth_mm": 8.01}, "scene.wound_depth_mm"),
        ({"deformation": {"bulge": 1.0}}, "scene.deformation.bulge"),
        ({"deformation": {"bulge_mm": 30.01}}, "scene.deformation.bulge_mm"),
        ({"deformation": {"stretch": [0.51, 0]}}, "scene.deformation.stretch"),
        ({"deformation": {"radius_mm": 4.99}}, "scene.deformation.radius_mm"),
        ({"deformation": 3}, "scene.deformation"),
        ({"scan": "missing.ply"}, "scan"),
    ],
)
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
    assert caught.value.what == f"sensor.{what}"
    assert caught.value.where == "a.toml"


def test_a_sensor_is_what_its_table_says() -> None:
    sensor = sensor_from_table("a.toml", {"noise": 2.0, "vignetting": 0.5, "blur_px": 0.7})
    assert (sensor.noise, sensor.vignetting, sensor.blur) == (2.0, 0.5, 0.7)
