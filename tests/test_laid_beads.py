"""What was laid, judged by two height fields: laws of the volume, known noise, gaps, blobs and clogs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.errors import InputError
from estimation.se3 import Array
from estimation.surface_map import SurfaceHeights
from planning.laid_beads import (
    STATION_LENGTH,
    BeadPieces,
    LaidBeads,
    bead_heights,
    judge_beads,
    pieces_between,
    stations_of,
)
from planning.path import Path
from tests.moving_surfaces import path_through

AREA, WIDTH, PITCH, LENGTH = 0.64, 1.6, 1.6, 20.0  # mm^2 and mm of the usual layer
NOISE = 0.03  # mm


def raster(rows: int, pitch: float = PITCH, area: float = AREA, angle: float = 0.0, slope: float = 0.0) -> BeadPieces:
    """Lines of LENGTH along x, a bead each, turned by `angle` and tilted."""
    y = pitch * (np.arange(rows) - (rows - 1) / 2)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    ends = [np.column_stack([np.full(rows, s * LENGTH / 2), y]) @ turn.T for s in (-1.0, 1.0)]
    start, end = (np.column_stack([flat, slope * flat[:, 0]]) for flat in ends)
    size = np.linalg.norm(end - start, axis=1)
    place = np.arange(rows) * (size + 2.0)
    number = np.arange(rows)
    return BeadPieces(start, end, np.full(rows, area), np.full(rows, WIDTH), number, np.zeros(rows, np.int64), place)


def field(seed: int = 0, sigma: float = NOISE, step: float = 0.2) -> SurfaceHeights:
    """A wavy surface on a lattice, 36 mm by 30 mm."""
    low, shape = np.array([-18.0, -15.0]), (round(30 / step), round(36 / step))
    flat = SurfaceHeights(low, step, np.zeros(shape), np.full(shape, max(sigma, 1e-6)))
    x, y = np.moveaxis(flat.nodes, -1, 0)
    phase = np.random.default_rng(seed).uniform(0, 6, 2)
    return replace(flat, heights=0.1 * x + np.sin(x / 4 + phase[0]) * np.cos(y / 5 + phase[1]))


def with_noise(of: SurfaceHeights, rng: np.random.Generator, sigma: float = NOISE) -> SurfaceHeights:
    """Noise that neighbours within a patch of a millimetre share, as matched pictures have it."""
    from scipy.ndimage import gaussian_filter

    noise = gaussian_filter(rng.standard_normal(of.heights.shape), 0.5 / of.step)
    return replace(of, heights=of.heights + sigma * noise / noise.std())


def laid(pieces: BeadPieces, share: Array | float, seed: int = 0, noise: float = NOISE, bias: float = 0.0) -> LaidBeads:
    """A layer of which each piece got its share; the surface is seen with noise, and the second time off by a bias."""
    truth, rng = field(seed), np.random.default_rng(seed)
    came = bead_heights(replace(pieces, area=pieces.area * share), truth.nodes)
    after = replace(truth, heights=truth.heights + came + bias)
    return judge_beads(with_noise(truth, rng, noise), with_noise(after, rng, noise), pieces)


@settings(max_examples=25, deadline=None)
@given(
    st.floats(0.2, 1.5),
    st.floats(0.8, 4.0),
    st.floats(-np.pi, np.pi),
    st.floats(-0.5, 0.5),
    st.sampled_from([0.1, 0.2]),
)
def test_planned_beads_keep_their_volume(area: float, pitch: float, angle: float, slope: float, step: float) -> None:
    pieces = raster(3, pitch, area, angle, slope)
    nodes = SurfaceHeights(np.full(2, -20.0), step, np.zeros((round(40 / step),) * 2), np.zeros(0)).nodes
    true = float((np.linalg.norm(pieces.end - pieces.start, axis=1) * pieces.area).sum())
    assert bead_heights(pieces, nodes).sum() * step**2 == pytest.approx(true, rel=0.02)  # of sums over nodes


def test_a_bead_cut_in_pieces_is_the_same_bead() -> None:
    whole = raster(1)
    middle = whole.start + 0.3 * (whole.end - whole.start)
    both = BeadPieces(
        *(np.concatenate(pair) for pair in ((whole.start, middle), (middle, whole.end))),
        *(np.repeat(column, 2) for column in (whole.area, whole.width, whole.bead, whole.layer)),
        np.array([0.0, 0.3 * LENGTH]),
    )
    nodes = field().nodes
    assert np.abs(bead_heights(both, nodes) - bead_heights(whole, nodes)).max() < 1e-9
    assert len(stations_of(both).bead) == len(stations_of(whole).bead) == LENGTH / STATION_LENGTH


@settings(max_examples=20, deadline=None)
@given(st.floats(0.0, 2.0), st.floats(0.9, 4.0), st.floats(-0.3, 0.3), st.floats(-np.pi, np.pi), st.integers(0, 99))
def test_without_noise_each_station_gets_its_share(
    share: float, pitch: float, bias: float, angle: float, seed: int
) -> None:
    found = laid(raster(4, pitch, angle=angle), share, seed, noise=0.0, bias=bias)
    assert np.allclose(found.share, share, atol=1e-6)
    assert np.allclose(found.height, share * found.stations.crest, atol=1e-6)
    assert found.total[0] == pytest.approx(share * found.total[1], abs=1e-6)


def test_what_is_said_of_the_error_is_true() -> None:
    off = np.concatenate([(f.volume - f.planned) / f.sigma for f in (laid(raster(6), 1.0, seed) for seed in range(12))])
    assert 0.5 < np.sqrt(np.mean(off**2)) < 1.3 and np.mean(np.abs(off) < 2) > 0.93
    heights = [(f.height - f.stations.crest) / f.height_sigma for f in (laid(raster(6), 1.0, s) for s in range(12))]
    assert 0.4 < np.sqrt(np.mean(np.square(heights))) < 1.3


def test_a_clog_is_found_and_none_in_fifty_good_layers() -> None:
    assert not any(laid(raster(8), 1.0, seed).clogs for seed in range(50))
    for seed in range(10):
        share = np.ones(24)
        share[9:11] = 0.0  # 6.7 mm of the bead
        row = raster(8)
        cut = BeadPieces(
            *(_cut(getattr(row, name)) for name in ("start",)),
            _cut_ends(row),
            *(np.repeat(column, 3) for column in (row.area, row.width, row.bead, row.layer)),
            np.repeat(row.place, 3) + np.tile(np.arange(3) * LENGTH / 3, 8),
        )
        (begin, end), *others = laid(cut, share, seed).clogs
        assert not others
        assert begin == pytest.approx(cut.place[9], abs=2.6) and end == pytest.approx(cut.place[11], abs=2.6)


def _cut(start: Array) -> Array:
    return np.concatenate([[s + np.array([k * LENGTH / 3, 0, 0]) for k in range(3)] for s in start])


def _cut_ends(row: BeadPieces) -> Array:
    return _cut(row.start) + np.array([LENGTH / 3, 0, 0])


def test_gaps_in_a_row_go_on_from_bead_to_bead_and_short_ones_are_no_clog() -> None:
    row = raster(8, pitch=4.0)
    share = np.array([1, 1, 1, 0, 0, 1, 1, 1.0])
    found = laid(row, share)
    gaps = np.flatnonzero((found.stations.bead == 3) | (found.stations.bead == 4))
    assert found.clogs == [(found.stations.begin[gaps[0]], found.stations.end[gaps[-1]])]
    assert np.flatnonzero(found.gap).tolist() == gaps.tolist() and not found.blob.any()
    assert laid(row, np.where(share == 0, 2.5, 1.0)).blob.sum() == len(gaps)


def test_what_was_not_seen_is_not_judged() -> None:
    truth, pieces = field(), raster(4, pitch=4.0)
    hidden = np.where(truth.nodes[..., 0] > 5.0, np.nan, truth.heights)
    found = judge_beads(truth, replace(truth, heights=hidden + bead_heights(pieces, truth.nodes)), pieces)
    assert np.isnan(found.volume).sum() == 4 * 4 and not found.clogs
    assert found.total[0] == pytest.approx(found.total[1], rel=1e-6) and 0.7 < found.total[2] < 0.8


def test_a_path_gives_its_beads_and_one_without_amounts_is_refused() -> None:
    path = path_through(np.array([[0.0, 0, 0], [10, 0, 0], [10, 2, 0], [0, 2, 0]]))
    amounts = {"width_mm": np.full(4, "1.6"), "height_mm": np.full(4, "0.4")}
    path = replace(path, extrude=np.array([False, True, False, True]), extra=amounts)
    pieces = pieces_between(path, 0.0, 3.0)
    assert pieces.bead.tolist() == [0, 1] and pieces.place.tolist() == [0.0, 12.0]
    assert pieces.area == pytest.approx([0.64, 0.64]) and len(pieces_between(path, 1.0, 3.0)) == 1
    halves = [pieces_between(path, 0.0, 0.5), pieces_between(path, 0.5, 2.25), pieces_between(path, 2.25, 3.0)]
    assert [(p.place[0], p.start[0, 0], p.end[0, 0]) for p in halves] == [(0, 0, 5), (5, 5, 10), (14.5, 7.5, 0)]
    assert len(pieces_between(path, 1.0, 2.0)) == 0 and len(pieces_between(path, 0.0, 1.0 + 1e-9)) == 1
    bare: Path = replace(path, extra={})
    with pytest.raises(InputError, match="width_mm"):
        pieces_between(bare, 0.0, 3.0)
