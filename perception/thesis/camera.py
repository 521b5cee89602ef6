"""One camera's part: its region found from picture to picture, that region's motion, and its Kalman filter.

Features are followed in one of two ways: SIFT with FLANN, or corners with optical flow.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation.errors import InputError
from estimation.rig import Camera
from estimation.se3 import Array
from perception.frames import Image
from perception.lens import bilateral, undistort
from perception.mapping.features import FLANN_KD_TREE, bounding_box, grey

Box = tuple[int, int, int, int]  # x0, y0, x1, y1 px, the last two excluded

REGION_BORDER_PX = 5.0  # px around the region, Appendix A


def bounds_of(polygon: Array, size: tuple[int, int]) -> Array:
    """Lowest and highest x and y (2, 2) px of a polygon (N, 2) px, as far as an image of `size` (W, H) shows it."""
    shown = np.clip(polygon, 0.0, np.array(size) - 1.0)
    return np.stack([shown.min(0), shown.max(0)])


def union_box(before: Array, now: Array, size: tuple[int, int]) -> Box:
    """The box around where the region was and where it is, corners (2, 2) px each, and the border (thesis Fig. 3.4)."""
    return bounding_box(np.concatenate([before, now]), size, REGION_BORDER_PX)


def crop(view: Image, box: Box) -> Image:
    """The box of a picture, its reflections filtered out and its contours kept (thesis Fig. 4.9)."""
    x0, y0, x1, y1 = box
    return bilateral(np.ascontiguousarray(view[y0:y1, x0:x1]))


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """The same features in two pictures: source (N, 2) px in the one before, destination (N, 2) px in this one.

    Both count from the corner of the box looked at. In Appendix A each counts from the corner of its own picture's
    box, so whenever the box changes its corner's move is taken for the surface's; that is a slip and not repeated.
    """

    source: Array
    destination: Array

    def __len__(self) -> int:
        return len(self.source)


class Finder(Protocol):
    """Remembers the features of one picture and finds them again in the next."""

    def begin(self, view: Image, box: Box) -> Array:
        """Remember the features in a box of a picture; their pixels (N, 2) there."""

    def find(self, view: Image, box: Box) -> Pairs:
        """The remembered features in the next picture, within `box`, which holds both places of the region."""

    def keep(self) -> None:
        """Remember the picture last looked at instead; not called where it gave no motion."""


NO_PAIRS = Pairs(np.zeros((0, 2)), np.zeros((0, 2)))


SIFT_FEATURES = 100  # SIFT is configured to find, 4.6
FLANN_TREES, FLANN_CHECKS = 4, 10  # 4.6
LOWE_RATIO = 0.8  # of the nearest descriptor's distance to the next one's, Appendix A

Descriptors = NDArray[np.float32]


class KeyPoints:
    """The key points of one picture, found again in the next by their descriptors.

    Each picture's are extracted once and used twice, as thesis 4.3 and Fig. 4.17 (b) have it.
    """

    def __init__(self) -> None:
        self._sift = cv2.SIFT.create(nfeatures=SIFT_FEATURES)
        index: dict[str, bool | int | float | str] = {"algorithm": FLANN_KD_TREE, "trees": FLANN_TREES}
        self._flann = cv2.FlannBasedMatcher(index, {"checks": FLANN_CHECKS})
        self._before: tuple[Array, Descriptors] = np.zeros((0, 2)), np.zeros((0, 128), np.float32)
        self._now = self._before

    def begin(self, view: Image, box: Box) -> Array:
        """Remember the key points in a box of a picture; their pixels (N, 2) there."""
        self._before = self._now = self._extract(view, box)
        return self._before[0]

    def find(self, view: Image, box: Box) -> Pairs:
        """The remembered key points in the next picture: thesis Eq. 4.11 and the ratio test."""
        self._now = self._extract(view, box)
        (points_before, before), (points_now, now) = self._before, self._now
        if len(before) < 2 or len(now) < 2:
            return NO_PAIRS
        cv2.setRNGSeed(0)  # of this thread: the trees are built by chance, and the same pictures must match alike
        nearest = [two for two in self._flann.knnMatch(before, now, k=2) if len(two) == 2]
        good = [m for m, n in nearest if m.distance < LOWE_RATIO * n.distance]
        corner = np.array(box[:2], float)
        source, destination = [m.queryIdx for m in good], [m.trainIdx for m in good]
        return Pairs(points_before[source] - corner, points_now[destination] - corner)

    def keep(self) -> None:
        """Remember the key points of the picture last looked at."""
        self._before = self._now

    def _extract(self, view: Image, box: Box) -> tuple[Array, Descriptors]:
        points, descriptors = self._sift.detectAndCompute(crop(view, box), None)
        if not points:
            return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
        return np.array([point.pt for point in points]) + box[:2], np.asarray(descriptors, np.float32)


MAX_CORNERS, CORNER_QUALITY, CORNER_SPACING_PX = 30, 0.3, 1.0  # at most, of the best one's quality, px between two: 4.6


class Corners:
    """The corners of one picture, followed into the next one: thesis Eq. 4.7-4.10 as calcOpticalFlowPyrLK solves them.

    They are chosen anew in each picture: followed on, fewer and fewer would be left, and the thesis tells no limit.
    """

    def __init__(self) -> None:
        self._before: Image | None = None
        self._now: Image | None = None

    def begin(self, view: Image, box: Box) -> Array:
        """Remember a picture; the corners (N, 2) px in a box of it."""
        self._before = self._now = view
        return self._corners(crop(view, box)) + box[:2]

    def find(self, view: Image, box: Box) -> Pairs:
        """The corners of the remembered picture in the next one, those that the flow lost left out."""
        self._now = view
        assert self._before is not None
        before, now = crop(self._before, box), crop(view, box)
        source = self._corners(before)
        if not len(source):
            return NO_PAIRS
        start = source.astype(np.float32).reshape(-1, 1, 2)
        moved, status, _ = cv2.calcOpticalFlowPyrLK(before, now, start, np.empty_like(start))
        valid = np.asarray(status).reshape(-1) == 1
        return Pairs(source[valid], np.asarray(moved, float).reshape(-1, 2)[valid])

    def keep(self) -> None:
        """Remember the picture last looked at."""
        self._before = self._now

    @staticmethod
    def _corners(inside: Image) -> Array:
        corners = cv2.goodFeaturesToTrack(inside, MAX_CORNERS, CORNER_QUALITY, CORNER_SPACING_PX)
        return np.zeros((0, 2)) if corners is None else np.asarray(corners, float).reshape(-1, 2)


MIN_PAIRS = 4  # pairs that a homography takes
MAX_REPROJECTION_PX = 3.0  # px, of RANSAC, Appendix A


def displacement(pairs: Pairs) -> Array:
    """The median move (2,) px, each image axis for itself: thesis 4.4 and `track` of Appendix A.

    4.6 says "mean" of the shaking table's measurement; the median is what 4.4, the second experiment and the program
    say, and the mean would follow a single wrong match.
    """
    return np.asarray(np.median(pairs.destination - pairs.source, axis=0))


def turn(pairs: Pairs) -> float | None:
    """The turn in the image, rad, from x towards y: about the camera's optical axis; None without a homography.

    The arctangent of h21 / h11 of the homography H (thesis Eq. 4.19) by RANSAC. Eq. 4.20 writes H from the second
    picture to the first; as in Appendix A it is that from the first to the second, so the turn is the surface's own.

    Of Eq. 4.21-4.22, P_x = t_x / (1 - cos) and P_y = t_y / sin, no use is made: the point that a turn leaves in place
    solves (I - R) P = t, which is another one, and turning about it while moving by the median as well (Eq. 5.4-5.7)
    would count the same motion twice. The surface turns about its own middle instead, which the median moves.
    """
    if len(pairs) < MIN_PAIRS:
        return None
    homography, _ = cv2.findHomography(pairs.source, pairs.destination, cv2.RANSAC, MAX_REPROJECTION_PX)
    return None if homography is None else float(np.arctan2(homography[1, 0], homography[0, 0]))


# px/s^2 and rad/s^2: 50 px/s, or 15 deg/s, within a tenth of a second
ACCELERATION_SIGMA = np.array([500.0, 500.0, 2.5])
MOVE_SIGMA = np.array([0.15, 0.15, 5e-3])  # px and rad, of one measured move: some twenty matches, each to half a px
# px/s and rad/s, at the start: of any surface that could be printed on
INITIAL_VELOCITY_SIGMA = np.array([300.0, 300.0, 1.5])


@dataclass(frozen=True, slots=True, eq=False)
class GaussianState:
    """The estimate of a state: X and P of the thesis."""

    mean: Array  # (n,)
    covariance: Array  # (n, n)


def predict(state: GaussianState, transition: Array, noise: Array) -> GaussianState:
    """The state one step later, thesis Eq. 4.12-4.13. transition: A (n, n). noise: Q (n, n).

    The term B U is left out: nothing that drives a wound is known.
    """
    return GaussianState(transition @ state.mean, transition @ state.covariance @ transition.T + noise)


def update(state: GaussianState, measured: Array, observation: Array, noise: Array) -> GaussianState:
    """The state after a measurement (m,), thesis Eq. 4.14-4.18. observation: H (m, n). noise: R (m, m)."""
    residual = measured - observation @ state.mean  # Eq. 4.14
    spread = observation @ state.covariance @ observation.T + noise  # Eq. 4.15
    gain = np.linalg.solve(spread, observation @ state.covariance).T  # Eq. 4.16; S and P are symmetric
    return GaussianState(state.mean + gain @ residual, state.covariance - gain @ spread @ gain.T)  # Eq. 4.17, 4.18


def initial_velocity() -> GaussianState:
    """The image velocity (3,), px/s, px/s, rad/s, before the first measurement."""
    return GaussianState(np.zeros(3), np.diag(INITIAL_VELOCITY_SIGMA**2))


def predict_velocity(state: GaussianState, dt: float) -> GaussianState:
    """The velocity `dt` s later: the same, less surely."""
    return predict(state, np.eye(3), np.diag((ACCELERATION_SIGMA * dt) ** 2))


def update_velocity(state: GaussianState, move: Array, dt: float) -> GaussianState:
    """The velocity after a move (3,) px, px, rad was measured over `dt` s.

    Thesis 4.4: the median displacement gives the velocity between the frames, which is the filter's observation and
    corrects its predictions. The thesis gives no matrices; here H = I, and R is that of a move divided by its time.
    """
    return update(predict_velocity(state, dt), move / dt, np.eye(3), np.diag((MOVE_SIGMA / dt) ** 2))


class FlatView:
    """One camera's undistorted view: getOptimalNewCameraMatrix with alpha = 1, which retains all pixels, thesis 4.2.

    camera: what the pictures are of. matrix: (3, 3) px, the view's own. The maps are worked out once; OpenCV's
    undistort(), which the thesis calls, makes the same ones again for each picture.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        matrix, _ = cv2.getOptimalNewCameraMatrix(camera.matrix, camera.distortion, camera.size, 1)
        self.matrix = np.asarray(matrix, np.float64)
        self._maps = cv2.initUndistortRectifyMap(
            camera.matrix, camera.distortion, np.eye(3), self.matrix, camera.size, cv2.CV_16SC2
        )

    def flatten(self, image: Image) -> Image:
        """The whole picture, grey (H, W), as the view shows it; InputError where it is not of the camera's size."""
        (h, w), size = image.shape[:2], self.camera.size
        if (w, h) != size:
            raise InputError(f"camera {self.camera.name}", "image size", f"{w} x {h}", "{} x {} px".format(*size))
        return np.asarray(cv2.remap(grey(image), *self._maps, cv2.INTER_LINEAR), np.uint8)

    def pixels(self, imaged: Array) -> Array:
        """The view's pixels (N, 2) of pixels as the lens images them (N, 2)."""
        return self._between(self.camera.matrix, self.matrix, undistort(self.camera, imaged))

    def ideal(self, pixels: Array) -> Array:
        """Undistorted pixels (N, 2) of the camera's own matrix from the view's (N, 2)."""
        return self._between(self.matrix, self.camera.matrix, pixels)

    @staticmethod
    def _between(old: Array, new: Array, pixels: Array) -> Array:
        x = (pixels - old[:2, 2]) / old[[0, 1], [0, 1]]
        return np.asarray(x * new[[0, 1], [0, 1]] + new[:2, 2])

    def scale(self, point_base: Array) -> Array:
        """mm per px (2,), along the image's x and y, at the depth of a point (3,) mm, base frame.

        Thesis 4.2 divides the known size of a chessboard's squares by their size in pixels, the board held where the
        surface is; of a calibrated camera that is depth over focal length. One factor an axis instead of one a camera:
        the view's pixels are not square where alpha = 1 stretches them. As in the thesis it stays what it was at the
        start, however the depth changes.
        """
        depth = (self.camera.base_from_camera[:3, :3].T @ (point_base - self.camera.base_from_camera[:3, 3]))[2]
        return np.asarray(depth / self.matrix[[0, 1], [0, 1]])


MAX_COAST_S = 0.5  # s that a velocity is relied on without a measurement


class CameraTrack:
    """Follows the region in one camera's pictures: what a thread of the thesis does (`capture_frames`, Appendix A).

    motion: (3,) px, px, rad moved and turned since the start. covariance: (3, 3) of what the filter predicts of it, 0
    where it is measured: the thesis keeps no account of the errors that it adds up. measured: whether the newest
    picture took part. pixels: (N, 2) px of the features that did, undistorted and of the camera's own matrix.
    velocity: (3,) px/s, px/s, rad/s, as the filter believes it.

    Motion is the sum of the measured moves, as in the program; the Kalman filter (thesis 4.4) says where the region
    is to be looked for and what it did while it was not seen. Then the features last found are kept, so what follows
    an occlusion is measured from before it and the prediction is given up. Every frame set is used: every 30th, as in
    the program, or every third (4.6) was to save time.
    """

    def __init__(self, camera: Camera, finder: Finder) -> None:
        self.view = FlatView(camera)
        self._finder = finder

    def begin(self, stamp: float, image: Image, polygon: Array) -> None:
        """The first picture at `stamp`, s, and the region in it, (N, 2) px as imaged."""
        size = self.view.camera.size
        self._corners = bounds_of(self.view.pixels(np.clip(polygon, 0, np.array(size) - 1.0)), size)
        features = self._finder.begin(self.view.flatten(image), union_box(self._corners, self._corners, size))
        self._seen, self._sum = stamp, np.zeros(3)
        self._velocity = initial_velocity()
        self.motion, self.covariance, self.measured = self._sum, np.zeros((3, 3)), True
        self.velocity = self._velocity
        self.pixels = self.view.ideal(features)

    def __call__(self, stamp: float, image: Image | None) -> None:
        """The next picture, at `stamp`, s; None where this camera has none."""
        dt = stamp - self._seen
        coasted = predict_velocity(self._velocity, dt)
        ahead = min(dt, MAX_COAST_S)
        move = None if image is None else self._move(image, coasted.mean * ahead)
        self.measured = move is not None
        if move is None:
            self.motion = self._sum + coasted.mean * ahead
            self.covariance = coasted.covariance * ahead**2
            self.velocity, self.pixels = coasted, np.zeros((0, 2))
            return
        self.velocity = self._velocity = update_velocity(self._velocity, move, dt)
        self._seen, self._sum = stamp, self._sum + move
        self.motion, self.covariance = self._sum, np.zeros((3, 3))

    def _move(self, image: Image, expected: Array) -> Array | None:
        """The move (3,) since the picture last measured, or None; the region is looked for at `expected` (3,) too."""
        here = self._corners + self._sum[:2]
        box = union_box(here, here + expected[:2], self.view.camera.size)
        pairs = self._finder.find(self.view.flatten(image), box)
        turned = turn(pairs)
        if turned is None:
            return None
        self._finder.keep()
        self.pixels = self.view.ideal(pairs.destination + box[:2])
        return np.append(displacement(pairs), turned)
