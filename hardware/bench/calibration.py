"""`stillbed bench calibration`: rendered boards before three cameras, calibrated, beside the exact rig."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from estimation import se3
from estimation.calibration.camera_rig import Calibration, calibrate
from estimation.calibration.lens_model import image, lens_of, matrix_of
from estimation.calibration.validation import predicted_error, working_volume
from estimation.camera_calibration.views import Views
from estimation.rig import Camera, Rig, pixels_from_points
from estimation.se3 import Array
from hardware.bench.figures import Figure, Target, at_most
from hardware.calibration.verdict import held_out, residual
from hardware.simulator.scene.ground_truth_views import BoardView
from perception.boards.board import Board
from perception.boards.collection import CornerTable, empty_table, usable
from perception.boards.corners import CornerFinder

BOARD = Board(squares=(8, 11), square=30.0)
SIZE = (1280, 720)
LENSES = np.array(
    [
        [894.0, 896.0, 634.0, 361.0, -0.30, 0.10, 0.0, 0.0, 0.0],
        [980.0, 979.0, 647.0, 368.0, -0.08, 0.0, 0.0, 0.0, 0.0],
        [861.0, 861.5, 629.0, 353.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    ]
)
TURNS = ((0.0, 0.0, 0.0), (4.0, -30.0, 2.0), (-5.0, 35.0, -3.0))  # degrees about a point DEPTH before the first camera
DEPTH = 700.0  # mm
LATE = (-0.016, 0.004, 0.012)  # s
RATE, BLUR, NOISE = 10.0, 0.8, 1.5  # Hz; px; grey levels
SIGMA = 0.15  # px, of the corners that are drawn without pictures
DRAWN = 30  # instants of a run without pictures
BENT = np.array([0.003, 0.003, 0.1])  # one sigma of p1, p2 and k3 of the worst lens drawn: as webcams were measured
LEAST_BENT = 0.01  # in parts of that, of the best one
REFERENCE = "none"


@dataclass(frozen=True, slots=True)
class Sway:
    """A hand's slow motion: 6 axes times 3 sines. sizes: rad and mm; rates: Hz; phases: (6, 3)."""

    sizes: Array
    rates: Array
    phases: Array

    def __call__(self, stamps: Array) -> Array:
        """base_from_board (N, 4, 4) at stamps (N,), s."""
        waves = np.sin(2 * np.pi * self.rates * stamps[:, None, None] + self.phases)
        way = (self.sizes * waves).sum(-1)
        turned = se3.make(se3.exp_rotation(way[:, :3]), np.array([0.0, 0.0, DEPTH]) + way[:, 3:])
        return np.asarray(turned @ se3.make(np.eye(3), -BOARD.corners.mean(0)))


def run(options: argparse.Namespace) -> list[Figure]:
    """Accuracy on rendered pictures, and whether the stated doubts are honest."""
    figures = list(_rendered(options.instants))
    if options.runs:
        values = [_nees(seed) for seed in range(options.runs)]
        note = f"{options.runs} runs on drawn corners of {SIGMA:g} px, {DRAWN} instants, lenses bent more or less"
        figures.append(
            Figure(
                "squared error, in parts of what is claimed",
                float(np.mean(values)),
                "",
                Target(0.8, 1.25),
                REFERENCE,
                note,
            )
        )
    return figures


def true_rig(lenses: Array = LENSES) -> Rig:
    """Three cameras about the board, the first one the base; lenses: (3, 9)."""
    centre = np.array([0.0, 0.0, DEPTH])
    turns = se3.exp_rotation(np.radians(TURNS))
    places = se3.make(turns, centre - turns @ centre)
    cameras = zip("abc", lenses, places, LATE, strict=True)
    return Rig(tuple(Camera(n, SIZE, matrix_of(lens), lens[4:].copy(), p, late) for n, lens, p, late in cameras))


def sway(seed: int, speed: float = 1.0) -> Sway:
    """A motion of its own for each seed; speed: times the usual."""
    rng = np.random.default_rng([seed, 61])
    rates = np.array([0.07, 0.17, 0.31])
    sizes = np.array([0.4, 0.45, 0.6, 130.0, 80.0, 110.0])[:, None] * rng.uniform(0.5, 1.0, (6, 3)) / (1 + 6 * rates)
    return Sway(sizes, rates * speed, rng.uniform(0, 2 * np.pi, (6, 3)))


def _rendered(instants: int) -> Iterator[Figure]:
    rig = true_rig()
    views, _ = usable(_looked_at(rig, instants), BOARD, tuple("abc"), (SIZE,) * 3)
    found = calibrate(views)
    error = errors(found, rig)
    note = f"{instants} frame sets at {RATE:g} Hz, {BOARD}, blur {BLUR:g} px, noise {NOISE:g}; largest of three cameras"
    focal = float(np.abs(error[:, 0] / [lens[0] for lens in LENSES]).max())
    yield Figure("focal length", 100 * focal, "%", at_most(0.1), REFERENCE, note)
    yield Figure("place", float(np.linalg.norm(error[:, 12:15], axis=1).max()), "mm", at_most(0.05))
    claimed = max(float(np.sqrt(np.trace(found.covariance_of(c)[12:15, 12:15]))) for c in range(len(rig)))
    yield Figure("place, as claimed", claimed, "mm")
    yield Figure("turn", float(np.degrees(np.linalg.norm(error[:, 9:12], axis=1).max())), "degrees", at_most(0.02))
    yield Figure("clock offset", 1e3 * float(np.abs(error[:, 15]).max()), "ms", at_most(1.0))
    points = working_volume(found)
    made = displaced(found.rig, rig, points)
    yield Figure(
        "3D error in the working volume", float(np.sqrt(np.mean(made**2))), "mm", at_most(0.05), "", "RMS, shape only"
    )
    yield Figure("3D error as predicted", predicted_error(found, points).typical, "mm")
    yield Figure("corner residual, median", residual(found), "px")
    yield Figure("and in stretches held out", held_out(found), "px")
    yield Figure("squared error, rendered, in parts of what is claimed", consistency(found, error), "")


def _looked_at(rig: Rig, instants: int) -> CornerTable:
    """The corners that are found in rendered pictures."""
    rng, motion, finder = np.random.default_rng(62), sway(0), CornerFinder(BOARD)
    eyes = [BoardView(camera, BOARD) for camera in rig.cameras]
    rows = []
    for instant in range(instants):
        for c, camera in enumerate(rig.cameras):
            pose = motion(np.array([instant / RATE + camera.clock_offset]))[0]
            found = finder(eyes[c].picture(pose, BLUR, NOISE, rng))
            if found.count:
                rows.append((c, instant, instant / RATE, found))
    nothing = empty_table(BOARD, len(rig))
    return CornerTable(
        np.array([r[0] for r in rows]),
        np.array([r[1] for r in rows]),
        np.array([r[2] for r in rows]),
        np.stack([r[3].pixels for r in rows]),
        np.array([r[3].sigma for r in rows]),
        np.array([r[3].blur for r in rows]),
        np.array([r[3].marker for r in rows]),
        np.full(len(rig), instants),
        nothing.strangers,
        instants,
    )


def errors(found: Calibration, rig: Rig) -> Array:
    """(C, 16) what the estimate lacks: lens, place in its own tangent space, offset."""
    out = []
    for camera, true in zip(found.rig.cameras, rig.cameras, strict=True):
        place = se3.log(se3.inverse(camera.base_from_camera) @ true.base_from_camera)
        offset = true.clock_offset - camera.clock_offset
        out.append(np.concatenate([lens_of(true) - lens_of(camera), place, [offset]]))
    return np.array(out)


def consistency(found: Calibration, error: Array) -> float:
    """Squared error by the stated covariance, per degree of freedom; the last offset follows from the others."""
    covariance = found.fit.covariance
    free = np.flatnonzero(np.diag(covariance) > 0)[:-1]
    e = error.ravel()[free]
    return float(e @ np.linalg.solve(covariance[np.ix_(free, free)], e)) / len(free)


def displaced(found: Rig, true: Rig, points: Array) -> Array:
    """Distances (N,), mm, of points from where the found rig sees them, after the best rigid motion of all."""
    seen = [pixels_from_points(camera, points)[0] for camera in true.cameras]
    at = points.copy()
    for _ in range(8):
        held, pull = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
        for camera, pixels in zip(found.cameras, seen, strict=True):
            camera_from_base = se3.inverse(camera.base_from_camera)
            there, _, by_point = image(lens_of(camera), se3.transform_points(camera_from_base, at))
            by_point = by_point @ camera_from_base[:3, :3]
            held += np.swapaxes(by_point, 1, 2) @ by_point
            pull += np.einsum("npi,np->ni", by_point, there - pixels)
        at = at - np.linalg.solve(held, pull[..., None])[..., 0]
    carried = se3.transform_points(se3.rigid_from_points(points, at), points)
    return np.asarray(np.linalg.norm(at - carried, axis=1))


def _nees(seed: int) -> float:
    """Of one run whose corners are drawn about their true places, without pictures."""
    rng = np.random.default_rng([seed, 63])
    lenses = LENSES.copy()
    lenses[:, 6:] = rng.normal(0, BENT, (3, 3)) * LEAST_BENT ** rng.uniform(0, 1, (3, 1))
    rig = true_rig(lenses)
    camera, instant = np.tile(np.arange(3), DRAWN), np.repeat(np.arange(DRAWN), 3)
    boards = sway(seed, 2.0)(instant / RATE + np.array(LATE)[camera])
    corners = BOARD.corners.reshape(10, 7, 3)[::3, ::3].reshape(-1, 3)
    pixels = np.stack(
        [
            pixels_from_points(rig.cameras[c], se3.transform_points(b, corners))[0]
            for c, b in zip(camera, boards, strict=True)
        ]
    )
    pixels += rng.normal(0, SIGMA, pixels.shape)
    pixels[((pixels < 2) | (pixels > np.array(SIZE) - 3)).any(-1)] = np.nan
    views = Views(
        tuple("abc"), (SIZE,) * 3, corners, camera, instant, instant / RATE, pixels, np.full(len(camera), SIGMA)
    )
    found = calibrate(views.only(views.seen.sum(1) >= 6))
    return consistency(found, errors(found, rig))
