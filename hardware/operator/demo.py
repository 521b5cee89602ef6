"""The operator's page with nothing behind it but a made-up run: `python -m hardware.operator.demo`.

To learn the page by. Nothing moves, whatever is pressed: three painted cameras look at a wound that breathes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import nan, radians

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.pose import TrackState
from estimation.rig import Camera, Rig, ideal_pixels
from estimation.scans.scan import scan_from_triangles, triangulate_lattice
from estimation.se3 import Array
from hardware.files.images import small_jpeg
from hardware.operator.overlays import SHEET_QUALITY, SHEET_WIDTH, scan_drawing
from hardware.operator.process import CameraShot, OperatorPage, Thumbnailer
from hardware.operator.settings import OperatorSettings
from hardware.operator.shared_state import (
    CameraPicture,
    OperatorLink,
    OperatorRequest,
    PagePictures,
    PageScene,
    ScanDrawing,
    scene_from,
)
from hardware.operator.view import (
    ACTIVE_STAGES,
    OVER_STAGES,
    STAGE_OFFERS,
    STAGE_QUESTIONS,
    Activity,
    CameraView,
    Check,
    CheckVerdict,
    HoldCause,
    HoldRow,
    LatencyView,
    LogLine,
    MotionView,
    MoveRequest,
    OperatorView,
    PlacementView,
    ProgressView,
    RequestAnswer,
    RestView,
    RunResult,
    RunStage,
    TrackingView,
    Wish,
    refusal,
)
from hardware.process.clock import Clock, WallClock
from perception.frames import Image
from planning.path import Path
from planning.placement import NoSurfaceError, PathPlacement, PlacedBy, SurfaceMove, moved_along, tangent_of

DEMO_IMAGE_SIZE = (640, 360)  # px
BREATH_PERIOD = 4.0  # s
WOUND_HALF_AXES = np.array([21.0, 14.0])  # mm, half axes
SKIN_COLOUR, WOUND_COLOUR = np.array([150.0, 178.0, 216.0]), np.array([52.0, 44.0, 150.0])  # BGR
DEMO_CHECKPOINTS = 700


def demo_rig() -> Rig:
    """Three cameras around the wound, half a metre away and above it."""
    return Rig(tuple(_camera(f"camera{k}", turn) for k, turn in enumerate((-1.2, 0.0, 1.2))))


def demo_path() -> Path:
    """A spiral over the wound, in two layers, upright."""
    share = np.linspace(0.0, 1.0, DEMO_CHECKPOINTS)
    angle, radius = 2 * np.pi * 18 * (share % 0.5), 1 - 1.9 * (share % 0.5)
    poses = np.tile(np.eye(4), (DEMO_CHECKPOINTS, 1, 1))
    poses[:, 0, 3] = WOUND_HALF_AXES[0] * radius * np.cos(angle)
    poses[:, 1, 3] = WOUND_HALF_AXES[1] * radius * np.sin(angle)
    poses[:, 2, 3] = surface_height(poses[:, 0, 3], poses[:, 1, 3]) + 0.3 + 0.3 * (share >= 0.5)
    layer = (share >= 0.5).astype(np.int64)
    extrude = np.r_[False, np.diff(layer) == 0]
    speed, temperature = np.full(DEMO_CHECKPOINTS, 6.0), np.full(DEMO_CHECKPOINTS, 37.0)
    return Path(poses, speed, np.zeros(DEMO_CHECKPOINTS, np.int64), temperature, layer, extrude)


def surface_height(x: Array, y: Array) -> Array:
    """Height, mm, of the surface over places in mm."""
    return np.asarray(-(x**2 + 1.6 * y**2) / 400)


def demo_scene(surface_from_path: Array, scan: ScanDrawing) -> PageScene:
    """Cameras, path and scan where they are placed, and the surface."""
    surface, triangles = _surface_mesh(24, 45.0, 32.0)
    path = demo_path()
    path = replace(path, surface_from_nozzle=surface_from_path @ path.surface_from_nozzle)
    lines = se3.transform_points(surface_from_path, scan.lines.reshape(-1, 3)).reshape(-1, 2, 3)
    return scene_from(demo_rig(), path, surface, triangles, lines)


def demo_scan() -> ScanDrawing:
    """A scan of the same surface with its wound, 2 mm deep."""
    points, triangles = _surface_mesh(60, 40.0, 27.0)
    points[:, 2] -= 2 * np.clip(4 * (1 - np.hypot(*(points[:, :2] / WOUND_HALF_AXES).T)), 0, 1)
    return scan_drawing(scan_from_triangles(points, triangles))


def _surface_mesh(side: int, half_x: float, half_y: float) -> tuple[Array, NDArray[np.int64]]:
    """Points (side^2, 3) of the surface, mm, and triangles (T, 3) between them."""
    x, y = (part.ravel() for part in np.meshgrid(*(np.linspace(-half, half, side) for half in (half_x, half_y))))
    triangles = triangulate_lattice(np.ones((side, side), bool))[1]
    return np.column_stack([x, y, surface_height(x, y)]), triangles


def surface_at(now: float) -> Array:
    """base_from_surface (4, 4) mm: it breathes."""
    breath = np.sin(2 * np.pi * now / BREATH_PERIOD)
    pose = se3.exp(np.array([0.05 * breath, 0.03 * breath, 0.1, 0.0, 0.0, 0.0]))
    pose[:3, 3] = [4.0 * breath, 1.5 * breath, 20.0 + 5.0 * breath]
    return np.asarray(pose)


def nozzle_at(base_from_surface: Array, path: Path, fraction: float, lift: float = 0.0) -> Array:
    """base_from_nozzle (4, 4) mm at a place on the path counted in checkpoints, `lift` mm above it."""
    i = int(np.clip(fraction, 0, len(path) - 2))
    share = np.clip(fraction - i, 0.0, 1.0)
    pose = path.surface_from_nozzle[i].copy()
    pose[:3, 3] += share * (path.surface_from_nozzle[i + 1, :3, 3] - pose[:3, 3]) + [0, 0, lift]
    return np.asarray(base_from_surface @ pose)


class Painter:
    """Paints what a camera sees of the surface, as if it were flat."""

    def __init__(self, rig: Rig, rng: np.random.Generator) -> None:
        self._rig = rig
        self._grain = rng.normal(0.0, 9.0, (DEMO_IMAGE_SIZE[1], DEMO_IMAGE_SIZE[0], 1))
        turn = np.linspace(0.0, 2 * np.pi, 48)
        self._edge = np.column_stack([WOUND_HALF_AXES[0] * np.cos(turn), WOUND_HALF_AXES[1] * np.sin(turn), 0 * turn])
        self._edge[:, 2] = surface_height(self._edge[:, 0], self._edge[:, 1])
        self._marks = rng.uniform([-40, -28, 0], [40, 28, 0], (60, 3))
        self._marks[:, 2] = surface_height(self._marks[:, 0], self._marks[:, 1])

    def shots(self, base_from_surface: Array) -> list[CameraShot]:
        """The pictures of all cameras, with outline and tracks."""
        edge, marks = (se3.transform_points(base_from_surface, points) for points in (self._edge, self._marks))
        shots = []
        for camera in self._rig.cameras:
            outline, tracks = ideal_pixels(camera, edge)[0], ideal_pixels(camera, marks)[0]
            shots.append(CameraShot(camera.name, self._image(camera, base_from_surface), (outline,), tracks))
        return shots

    def _image(self, camera: Camera, base_from_surface: Array) -> Image:
        surface_from_camera = se3.inverse(base_from_surface) @ camera.base_from_camera
        u, v = np.meshgrid(np.arange(DEMO_IMAGE_SIZE[0]), np.arange(DEMO_IMAGE_SIZE[1]))
        rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(camera.matrix).T @ surface_from_camera[:3, :3].T
        far = -surface_from_camera[2, 3] / rays[..., 2]
        x, y = (surface_from_camera[k, 3] + far * rays[..., k] for k in range(2))
        inside = np.clip(6 * (1 - np.hypot(x / WOUND_HALF_AXES[0], y / WOUND_HALF_AXES[1])), 0, 1)[..., None]
        shade = 1 - 0.1 * np.clip(np.hypot(x, y) / 60, 0, 2)[..., None]
        painted = (SKIN_COLOUR + inside * (WOUND_COLOUR - SKIN_COLOUR)) * shade + self._grain
        return np.asarray(np.clip(painted, 0, 255), np.uint8)


def _camera(name: str, turn: float) -> Camera:
    place = np.array([320 * np.sin(turn), -320 * np.cos(turn), 330.0])
    ahead = np.array([0.0, 0.0, 20.0]) - place
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(ahead, right), ahead])
    pose[:3, 3] = place
    matrix = np.array([[2900.0, 0, 319.5], [0, 2900.0, 179.5], [0, 0, 1.0]])
    return Camera(name, DEMO_IMAGE_SIZE, matrix, np.zeros(5), pose)


DEMO_VIEW_PERIOD = 0.1  # s between two views
DEMO_SPEED = 9.0  # checkpoints/s
DEMO_HOLD_ERROR = 0.62  # mm: of error while it holds
DEMO_PLACEMENT = PathPlacement(
    np.eye(4), PlacedBy.SCAN, "placed by the scan, good to 0.06 mm and 0.11 degrees", True, True, 0.06, 0.002
)
NEXT_STAGES = {
    Wish.CONFIRM: RunStage.READY,
    Wish.MOVE: RunStage.CONFIRM,
    Wish.OUTLINE: RunStage.FIND,
    Wish.AGAIN: RunStage.FIND,
    Wish.START: RunStage.APPROACH,
    **dict.fromkeys((Wish.PAUSE, Wish.LIFT, Wish.LOOK), RunStage.PAUSED),
    Wish.RESUME: RunStage.APPROACH,
    Wish.STOP: RunStage.STOPPED,
    Wish.HOME: RunStage.HOMING,
    Wish.END: RunStage.ENDED,
}
TIMED_STAGES = {  # stages that end by themselves: after how many s, and what follows
    RunStage.CHECK: (6.0, RunStage.FIND),
    RunStage.FIND: (4.0, RunStage.CONFIRM),
    RunStage.APPROACH: (2.5, RunStage.PRINT),
    RunStage.HOMING: (3.0, RunStage.READY),
}
STAGE_REASONS = {stage: f"{stage.value} by the operator" for stage in (RunStage.STOPPED, RunStage.PAUSED)}


class DemoRun:
    """Goes through the stages of a run and follows requests as a live run does. fraction: where printing begins."""

    def __init__(self, fraction: float, now: float) -> None:
        self.stage, self._turn, self._since, self._then, self._fraction = RunStage.CHECK, 1, now, now, fraction
        self._path = demo_path()
        self._points = _surface_mesh(25, 60.0, 60.0)[0]
        self.placement, self._moved = DEMO_PLACEMENT, False
        self._answer: RequestAnswer | None = None
        self.outline: dict[str, Array] = {}  # (N, 2) px by camera, as the operator corrected it

    def _enter(self, stage: RunStage, now: float) -> None:
        self.stage, self._since, self._turn = stage, now, self._turn + 1

    def follow(self, request: OperatorRequest, now: float) -> None:
        """Follow a request, or refuse it."""
        why = refusal(request.wish, request.turn, STAGE_OFFERS.get(self.stage, ()), self._turn)
        if not why and request.wish is Wish.MOVE and request.move is not None:
            why = self._move(request.move)
        self._answer = RequestAnswer(request.number, request.wish, not why, why)
        if not why and request.wish is Wish.OUTLINE:
            self.outline = {name: np.array(corners) for name, corners in request.outline}
        if not why:
            self._enter(NEXT_STAGES[request.wish], now)

    def _move(self, move: MoveRequest) -> str:
        """Move the path along the surface; why not, "" where it was moved."""
        by = SurfaceMove(move.x_mm, move.y_mm, radians(move.turn_deg))
        try:
            lies = moved_along(self.placement, self._path, self._points, by)
        except NoSurfaceError as error:
            return str(error)
        self.placement, self._moved = replace(self.placement, surface_from_path=lies, by=PlacedBy.HAND), True
        return ""

    def step(self, now: float) -> OperatorView:
        """The run at `now`, s."""
        after, follows = TIMED_STAGES.get(self.stage, (float("inf"), self.stage))
        if now - self._since > after:
            self._enter(follows, now)
        if self.stage is RunStage.PRINT and not _held(now):
            self._fraction = min(self._fraction + DEMO_SPEED * (now - self._then), len(self._path) - 1)
            if self._fraction == len(self._path) - 1:
                self._enter(RunStage.DONE, now)
        self._then = now
        return self._view(now)

    def _view(self, now: float) -> OperatorView:
        stage = self.stage
        known = stage not in (RunStage.CHECK, RunStage.FIND)
        return OperatorView(
            stamp=now,
            turn=self._turn,
            stage=stage,
            reason=STAGE_REASONS.get(stage, ""),
            offers=STAGE_OFFERS.get(stage, ()),
            checks=_checks(now - self._since) if stage is RunStage.CHECK else (),
            tracking=_tracking(stage, now),
            motion=self._motion(now) if known else None,
            progress=self._progress() if known else None,
            latency=LatencyView(0.0142, 0.0271 + 0.002 * np.sin(now), 0.035) if known else None,
            cameras=tuple(CameraView(f"camera{k}", CheckVerdict.PASS, 29.9, 61 - 7 * k) for k in range(3)),
            answer=self._answer,
            placement=self._placement_view() if stage is RunStage.CONFIRM else None,
            notes=("demonstration",),
            log=(LogLine(self._turn, now, stage is RunStage.STOPPED, STAGE_QUESTIONS[stage]),),
            result=self._result() if stage in OVER_STAGES else None,
        )

    def _result(self) -> RunResult:
        share, path = self._fraction / (len(self._path) - 1), np.linspace(0, 1, 400)
        error = np.where(path <= share, 0.2 + 0.15 * np.sin(40 * path) ** 2, nan)
        holds = (HoldRow("the place under the nozzle is known to … mm, limit … mm", 7, 14.2),)
        place, errors = (share, self._fraction, len(self._path) - 1, 260.0), ((0.31, 0.47), (0.22, 0.35))
        return RunResult(*place, 61.0, 0.87, *errors, 84.0, holds, tuple(error.tolist()), "run.mcap", "")

    def _placement_view(self) -> PlacementView:
        placed, tangent = self.placement, tangent_of(self.placement, self._path, self._points)
        worth = placed.verdict, not self._moved, self._moved, True
        return PlacementView(placed.by.value, *worth, tangent)

    def _motion(self, now: float) -> MotionView:
        moves = self.stage in (RunStage.PRINT, RunStage.APPROACH)
        held = self.stage is RunStage.PRINT and _held(now)
        error = DEMO_HOLD_ERROR if held else 0.17 + 0.06 * np.sin(2.1 * now) + 0.03 * np.sin(7 * now)
        lift = {RunStage.PRINT: 0.0, RunStage.APPROACH: max(12 - 5 * (now - self._since), 0.0)}.get(self.stage, 25.0)
        led = Activity.ENTERING if self.stage is RunStage.APPROACH else Activity.PRINTING
        return MotionView(
            activity=Activity.HOLDING if held else led if moves else Activity.RESTING,
            reason="predicted error 0.62 mm at the nozzle, limit 0.50 mm: the surface moves too fast" if held else "",
            error=float(error) if moves else nan,
            limit=0.5,
            sigma=float(0.45 * error) if moves else nan,
            true_error=float(0.8 * error + 0.03 * np.sin(11 * now)) if moves else nan,
            in_flight=0.031 if moves else 0.0,
            most_in_flight=0.05,
            base_from_nozzle=nozzle_at(surface_at(now), self._path, self._fraction, lift),
            arm="armed" if self.stage in ACTIVE_STAGES else "disarmed",
            error_age=0.0 if moves else now - self._since,
            cause=HoldCause("error", "predicted error", "mm", DEMO_HOLD_ERROR, 0.5) if held else None,
            rest=RestView(5.2, 8.0, 0.1) if self.stage is RunStage.STOPPED else None,
        )

    def _progress(self) -> ProgressView:
        total, share = len(self._path), self._fraction / (len(self._path) - 1)
        layer = int(self._path.layer[int(self._fraction)]) + 1
        left = (1 - share) * total / DEMO_SPEED / 0.8
        return ProgressView(
            self._fraction, total - 1, share, left, (0.9 * left, 1.2 * left), 0.87, layer, 2, 120 * share
        )


def demo_sheet(now: float, shots: Sequence[CameraShot], outline: Mapping[str, Array]) -> PagePictures:
    """The pictures on which the wound's outline is corrected, as a network found it, a little wrong, or as it was
    corrected."""
    pictures = []
    for shot in shots:
        found = np.asarray(shot.outline[0])[::4]
        pull = 1 + 0.12 * np.sin(np.linspace(0, 2 * np.pi, len(found)))[:, None]
        middle = found.mean(axis=0)
        corners = outline.get(shot.camera, np.round(middle + 0.9 * pull * (found - middle), 1))
        pictures.append(CameraPicture(shot.camera, small_jpeg(shot.image, SHEET_WIDTH, SHEET_QUALITY), (corners,)))
    return PagePictures(now, tuple(pictures))


def _held(now: float) -> bool:
    return now % 12 > 9.5


def _tracking(stage: RunStage, now: float) -> TrackingView:
    pose = surface_at(now)
    spread = np.diag([0.0025, 0.0016, 0.006]) * (1.5 + np.sin(now))
    if stage in (RunStage.CHECK, RunStage.FIND):
        return TrackingView(TrackState.INITIALISING, "no map of the surface yet", nan, nan, pose, spread * nan)
    return TrackingView(
        TrackState.TRACKING, "three cameras agree on 182 tracks", 0.018, float(np.sqrt(spread.max())), pose, spread, 182
    )


def _checks(age: float) -> tuple[Check, ...]:
    rows = (
        Check("Cameras", CheckVerdict.PASS, "3 cameras at 30 Hz, 1280 x 720"),
        Check("Calibration", CheckVerdict.PASS, "0.31 px on what is seen now"),
        Check("Arm", CheckVerdict.PASS, "answers, 9.6 ms behind"),
        Check("Path", CheckVerdict.PASS, "700 checkpoints, 2 layers, 1.9 ml"),
        Check("Reach", CheckVerdict.WARN, "4 mm from the edge of joint 5", "Move the bed 20 mm nearer to the arm."),
        Check("Disk", CheckVerdict.PASS, "212 GB free, enough for 31 h"),
    )
    done = int(age)
    return tuple(row if k < done else Check(row.name, CheckVerdict.BUSY) for k, row in enumerate(rows))


def run(link: OperatorLink, page: OperatorPage, clock: Clock) -> None:
    """Go on until interrupted."""
    made_up, painter = DemoRun(260.0, clock.now()), Painter(demo_rig(), np.random.default_rng(1))
    thumbnailer, looked = Thumbnailer(link.pictures, link.status), made_up.stage
    scan, shown = demo_scan(), made_up.placement
    link.scene.put(demo_scene(shown.surface_from_path, scan))
    while True:
        now = clock.now()
        page.tend(now)
        for request in link.take():
            made_up.follow(request, now)
        if made_up.placement is not shown:
            shown = made_up.placement
            link.scene.put(demo_scene(shown.surface_from_path, scan))
        if made_up.stage is RunStage.FIND and looked is not RunStage.FIND:
            link.sheet.put(demo_sheet(now, painter.shots(surface_at(now)), made_up.outline))
        looked = made_up.stage
        link.views.put(made_up.step(now))
        if link.status.windows:
            pose = surface_at(now)
            thumbnailer.offer(now, painter.shots(pose), None if made_up.stage is RunStage.CHECK else pose)
        clock.wait_until(now + DEMO_VIEW_PERIOD)


def main() -> None:
    """Serve it and say where."""
    link, clock = OperatorLink(), WallClock()
    page = OperatorPage(link, OperatorSettings())
    try:
        print(page.address, flush=True)
        run(link, page, clock)
    except KeyboardInterrupt:
        page.close()


if __name__ == "__main__":
    main()
