"""Paths: what is refused and how it is said, the CSV's round trip, and the curve through the checkpoints."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path as File

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array
from hardware.files.path_file import PATH_HEADER, read_path, write_path
from planning.motion.curve import curve_through
from planning.path import LEVER_ARM, Path, check_path, way_lengths
from tests.moving_surfaces import path_through, raster

HEAD = ",".join(PATH_HEADER)
GOOD = [f"{x},0,0,0,0,0,5,1,20,0,1" for x in range(3)]
SAMPLE = File(__file__).parents[1] / "data/paths/square_10mm.csv"


def csv_file(folder: File, *lines: str) -> File:
    file = folder / "path.csv"
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return file


def wandering(seed: int, count: int = 12) -> Path:
    draw = np.random.default_rng(seed)
    path = path_through(draw.uniform(-20, 20, (count, 3)))
    rotations = se3.rotation_from_euler(draw.uniform(-1.2, 1.2, (count, 3)))
    return replace(
        path,
        surface_from_nozzle=se3.make(rotations, path.surface_from_nozzle[:, :3, 3]),
        speed=draw.uniform(1, 30, count),
        temperature=draw.uniform(4, 37, count),
        layer=draw.integers(0, 4, count),
        extrude=draw.random(count) < 0.7,
        material=np.array([f"gel {i % 3}" for i in range(count)]) if seed % 2 else draw.integers(0, 9, count),
        extra={
            "wait_s": draw.random(count),
            "run": draw.integers(0, 9, count),
            "note": np.array(["a", "0.5"] * count)[:count],
        },
    )


@given(st.integers(0, 10_000))
def test_a_file_gives_the_path_back(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    path = wandering(seed)
    file = tmp_path_factory.mktemp("path") / "path.csv"
    write_path(file, path)
    back = read_path(file)
    assert np.abs(back.surface_from_nozzle - path.surface_from_nozzle).max() < 1e-12
    assert np.array_equal(back.surface_from_nozzle[:, :3, 3], path.surface_from_nozzle[:, :3, 3])
    for name in ("speed", "material", "temperature", "layer", "extrude"):
        assert np.array_equal(getattr(back, name), getattr(path, name)), name
    assert list(back.extra) == list(path.extra)
    for name, column in path.extra.items():  # numbers as numbers
        assert back.extra[name].dtype.kind == column.dtype.kind and np.array_equal(back.extra[name], column), name


def test_a_file_as_people_write_it(tmp_path: File) -> None:
    file = csv_file(
        tmp_path,
        "\ufeffx_mm, y_mm, z_mm, alpha_deg, beta_deg, gamma_deg, speed_mm_min, material, temperature_c",
        " 0, 0, 0, 0, 0, 90, 300, collagen, 20",
        "",
        "10, 0, 0, 0, 0, 90, 300, collagen, 20",
    )
    path = read_path(file)
    assert np.allclose(path.speed, 5.0)
    assert np.allclose(path.surface_from_nozzle[1, :3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert path.material.tolist() == ["collagen"] * 2 and path.layer.tolist() == [0, 0]
    assert path.extrude.all()


def test_the_sample_path_is_a_square_of_10_mm() -> None:
    path = read_path(SAMPLE)
    assert np.ptp(path.surface_from_nozzle[:, :3, 3], axis=0).tolist() == [10, 10, 0]
    assert (path.speed == 5).all() and not path.extrude[0]


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ([], ["file", "empty"]),
        ([HEAD], ["checkpoints", "= 0", "2 or more"]),
        ([HEAD, GOOD[0]], ["checkpoints", "= 1", "2 or more"]),
        ([HEAD, GOOD[0], "nan,0,0,0,0,0,5,1,20,0,1"], ["line 3", "x_mm", "nan", "finite"]),
        ([HEAD, GOOD[0], "1,0,0,0,inf,0,5,1,20,0,1"], ["line 3", "beta_deg", "inf", "finite"]),
        ([HEAD, GOOD[0], "", "one,0,0,0,0,0,5,1,20,0,1"], ["line 4", "x_mm", "one"]),
        ([HEAD, GOOD[0], "1,0,0,0,0,0,0,1,20,0,1"], ["line 3: speed_mm_s = '0'", "200 mm/s"]),
        ([HEAD, GOOD[0], "1,0,0,0,0,0,-5,1,20,0,1"], ["line 3: speed_mm_s = '-5'"]),
        (
            [HEAD.replace("mm_s", "mm_min"), GOOD[0], "1,0,0,0,0,0,-5,1,20,0,1"],
            ["line 3: speed_mm_min = '-5', allowed 0 < speed <= 200 mm/s"],
        ),
        ([HEAD, GOOD[0], "1,0,0,0,0,0,900,1,20,0,1"], ["line 3: speed_mm_s = '900'"]),
        ([HEAD, GOOD[0], "1,0,0,0,0,0,5,1,2000,0,1"], ["line 3: temperature_c = '2000'"]),
        ([HEAD, GOOD[0], "1e9,0,0,0,0,0,5,1,20,0,1"], ["line 3", "position", "1000 mm"]),
        ([HEAD, GOOD[0], "1,0,0,0,0,0,5,1,20,0"], ["line 3", "10 values", "11"]),
        ([HEAD, GOOD[0], GOOD[1] + ",7"], ["line 3", "12 values", "11"]),
        ([HEAD, *GOOD, GOOD[2]], ["line 5", "position", "line 4"]),
        ([HEAD, *(f"{x},0,0,0,0,0,5,1,20,0,1" for x in (0, 0.01, 0.05))], ["positions", "0.05 mm", "in metres?"]),
        ([HEAD, GOOD[0], "1,0,0,0,0,0,5,,20,0,1"], ["line 3", "material"]),
        ([HEAD, GOOD[0], "1,0,0,0,0,0,5,1,20,0.5,1"], ["line 3", "layer", "whole number"]),
        ([HEAD, GOOD[0], "1,0,0,0,0,0,5,1,20,0,yes"], ["line 3", "extrude", "0 or 1"]),
        ([HEAD.replace("x_mm", "x"), *GOOD], ["header, column 1", "'x'", "x_mm"]),
        ([HEAD.replace("x_mm", "x_cm"), *GOOD], ["header, column 1", "'x_cm'", "x_mm"]),
        ([HEAD.replace("speed_mm_s", "speed"), *GOOD], ["header, column 7", "'speed'", "speed_mm_s or speed_mm_min"]),
        ([line.replace(",", ";") for line in (HEAD, *GOOD)], ["header", "commas between them"]),
        ([HEAD.replace("layer", "layers"), *GOOD], ["header, column 10", "'layers'", "did you mean 'layer'"]),
        ([HEAD.replace("y_mm", "x_mm"), *GOOD], ["header, column 2", "each once"]),
        ([HEAD.replace("material", "colour"), *GOOD], ["header", "no material"]),
        ([HEAD.replace("layer", "speed_mm_min"), *GOOD], ["header", "one of speed_mm_s, speed_mm_min"]),
    ],
)
def test_what_cannot_be_printed_is_told_by_line_and_column(tmp_path: File, lines: list[str], words: list[str]) -> None:
    file = tmp_path / "path.csv"
    file.write_text("\n".join(lines), encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read_path(file)
    for word in [str(file), "allowed", *words]:
        assert word in str(caught.value)


def test_a_file_that_is_not_there_or_not_text(tmp_path: File) -> None:
    for file in (tmp_path / "missing.csv", tmp_path):
        with pytest.raises(InputError):
            read_path(file)
    (tmp_path / "binary.csv").write_bytes(bytes(range(256)))
    with pytest.raises(InputError):
        read_path(tmp_path / "binary.csv")


@given(st.binary(max_size=300))
def test_any_file_is_a_path_or_an_input_error(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    file = tmp_path_factory.mktemp("path") / "path.csv"
    file.write_bytes(HEAD.encode() + b"\n" + content)
    try:
        assert len(read_path(file)) >= 2
    except InputError as error:
        assert "allowed" in str(error)


@pytest.mark.parametrize("spoilt", [np.nan, np.inf])
def test_no_pose_that_is_not_finite_gets_into_a_path(spoilt: float) -> None:
    path = raster()
    for at in ((2, 0, 3), (2, 1, 1), (2, 3, 3)):
        transforms = path.surface_from_nozzle.copy()
        transforms[at] = spoilt
        with pytest.raises(InputError, match="checkpoint 2: surface_from_nozzle"):
            check_path(replace(path, surface_from_nozzle=transforms))


def test_columns_are_of_one_length() -> None:
    path = raster()
    with pytest.raises(InputError, match="wait = '2 values', allowed 6"):
        check_path(replace(path, extra={"wait": np.array(["0", "0"])}))
    with pytest.raises(InputError, match="speed"):
        check_path(replace(path, speed=path.speed[1:]))


def test_a_turn_on_the_spot_has_a_length() -> None:
    path = path_through(np.zeros((2, 3)))
    rotations = se3.exp_rotation([[0, 0, 0], [0, 0, 0.5]])
    turned = replace(path, surface_from_nozzle=se3.make(rotations, np.zeros(3)))
    assert way_lengths(check_path(turned).surface_from_nozzle) == pytest.approx([0.5 * LEVER_ARM])


def steps(curve_length: float) -> Array:
    return np.linspace(0, curve_length, 4001)


@given(st.integers(0, 10_000))
def test_the_curve_passes_near_each_checkpoint_and_never_outruns_its_length(seed: int) -> None:
    path = wandering(seed)
    curve = curve_through(path.surface_from_nozzle, path.speed[1:], ~path.extrude[1:])
    at_knots = curve.poses(curve.knots)
    off = np.linalg.norm(at_knots[:, :3, 3] - path.surface_from_nozzle[:, :3, 3], axis=1)
    cut = np.full(len(path), 0.05)
    ways, free = np.diff(curve.knots), ~path.extrude[1:-1] & ~path.extrude[2:]  # nothing is printed on either side
    cut[1:-1][free] = np.clip(0.1 * np.minimum(ways[:-1], ways[1:]), 0.05, 0.5)[free]
    assert (off <= cut + 1e-9).all()
    turned = np.swapaxes(path.surface_from_nozzle[:, :3, :3], -1, -2) @ at_knots[:, :3, :3]
    assert (LEVER_ARM * se3.angle_of(turned) <= cut + 1e-9).all()
    s = steps(curve.length)
    assert np.linalg.norm(curve.derivatives(s)[0], axis=1).max() <= 1 + 1e-12
    places = curve.poses(s)[:, :3, 3]
    assert np.linalg.norm(np.diff(places, axis=0), axis=1).max() <= s[1] * (1 + 1e-9)
    middle = (s[1:] + s[:-1]) / 2
    first, _ = curve.derivatives(middle)
    assert np.abs(np.diff(places, axis=0) / s[1] - first).max() < 2 * s[1] / curve.half[1:-1].min()


@given(st.integers(0, 10_000))
def test_the_tool_turns_at_a_rate_without_steps_and_never_faster_than_between_checkpoints(seed: int) -> None:
    path = wandering(seed)
    curve = curve_through(path.surface_from_nozzle, path.speed[1:], ~path.extrude[1:])
    ends = np.concatenate([curve.knots - curve.half, curve.knots, curve.knots + curve.half])[:, None]
    h = 1e-6
    s = (ends[(ends > 3 * h) & (ends < curve.length - 3 * h)][:, None] + h * np.array([-2, -1, 0, 1, 2])).ravel()
    rotations = curve.poses(s)[:, :3, :3].reshape(-1, 5, 3, 3)
    rate = se3.log_rotation(np.swapaxes(rotations[:, :-1], -1, -2) @ rotations[:, 1:]) / h
    change = np.linalg.norm(curve.swing, axis=1)[1:-1] / (2 * curve.half[1:-1])
    assert np.linalg.norm(np.diff(rate, axis=1), axis=-1).max() < 2 * h * change.max() + 1e-8
    assert np.linalg.norm(rate, axis=-1).max() <= np.linalg.norm(curve.spin, axis=1).max() + 1e-8


@given(st.integers(0, 10_000), st.floats(0.02, 0.3))
def test_corners_closer_than_their_blends_share_the_way_between_them(seed: int, spacing: float) -> None:
    steps_mm = np.random.default_rng(seed).normal(size=(30, 3))
    points = np.cumsum(steps_mm / np.linalg.norm(steps_mm, axis=1, keepdims=True) * spacing, axis=0)
    curve = curve_through(path_through(points).surface_from_nozzle, np.full(29, 5.0), np.zeros(29, bool))
    reach = curve.knots + curve.half
    assert (reach[:-1] <= (curve.knots - curve.half)[1:] + 1e-12).all()
    s = steps(curve.length)
    assert np.linalg.norm(curve.derivatives(s)[0], axis=1).max() <= 1 + 1e-12
    assert np.linalg.norm(np.diff(curve.poses(s)[:, :3, 3], axis=0), axis=1).max() <= s[1] * (1 + 1e-9)
    assert np.linalg.norm(curve.poses(curve.knots)[:, :3, 3] - points, axis=1).max() <= 0.05 + 1e-9
