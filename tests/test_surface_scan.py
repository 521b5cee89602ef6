"""`stillbed scan`: the cameras' own scan beside the true surface, its file, its page, and what it refuses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from estimation import se3
from estimation.errors import InputError, StillbedError
from estimation.scans.scan import lattice_triangles, open_edges, scan_from_triangles
from estimation.se3 import Array
from estimation.synthetic.world import BASE_FROM_REST, arc_rig
from hardware.bench.mapping import scan_figures, shape_of
from hardware.cli.plan import scanned_settings
from hardware.files.mesh_file import read_mesh, read_raw_mesh, write_scan
from hardware.live.settings import FROM_CAMERAS, LiveSettings, read_settings
from hardware.live.surface_scan import (
    ScanOrder,
    ScanSource,
    SurfaceScan,
    camera_advice,
    check_scan,
    fuse,
    run_scan,
    scan_page,
    scan_surface,
)
from hardware.simulator.scene.appearance import Appearance, Sensor
from hardware.simulator.scene.render import render
from hardware.simulator.scene.scene import Scene, WorldState
from perception.lens import Lenses
from perception.mapping.dense_surface import DenseFit, SurfaceView
from planning.layers.repair import repair_mesh
from planning.layers.wound import find_wound

RIG = arc_rig(size=(640, 360), focal=550.0)  # a node of 0.8 mm: errors are twice those of the bench
SHAPE = shape_of("forearm", 1)
LOW, HIGH = np.array([-30.0, -22.0]), np.array([30.0, 22.0])
STEP = 0.8
POSES = [BASE_FROM_REST @ se3.exp([0.02 * k, 0.01 * k, 0.0, 0.4 * k, 0.5 * k, 2.0 * k]) for k in range(2)]


def pictures(wetness: float = 1.0, cameras: tuple[int, ...] = (0, 1, 2)) -> list[SurfaceView]:
    scene, rng, views = Scene(SHAPE, Appearance(wetness=wetness), seed=1), np.random.default_rng(3), []
    for number, pose in enumerate(POSES):
        own = [RIG.cameras[c] for c in cameras]
        images = render(scene, own, [WorldState(0.0, 0.0, pose, np.zeros(6))] * len(own), Sensor(), rng.spawn(len(own)))
        for c, image in zip(cameras, images, strict=True):
            views.append(SurfaceView(c, number, image, se3.inverse(pose) @ RIG.cameras[c].base_from_camera))
    return views


def guess(flat: Array) -> Array:
    """The skin as if there was no wound."""
    return np.asarray(SHAPE.heights_at(np.sign(flat) * np.maximum(np.abs(flat), [30.0, 0.0])))


@pytest.fixture(scope="module")
def views() -> list[SurfaceView]:
    return pictures()


@pytest.fixture(scope="module")
def fit(views: list[SurfaceView]) -> DenseFit:
    return DenseFit(Lenses(RIG), views)
