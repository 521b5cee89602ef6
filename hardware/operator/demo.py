"""The operator's page with nothing behind it but a made-up run: `python -m hardware.operator.demo`.

To learn the page by, and to look at it. Nothing moves, whatever is pressed.
"""

from __future__ import annotations

from dataclasses import replace
from math import nan

import numpy as np

from estimation.pose import TrackState
from hardware.operator.demo_world import Painter, demo_path, demo_rig, demo_scene, nozzle_at, surface_at
from hardware.operator.link import OperatorLink
from hardware.operator.process import OperatorPage
from hardware.operator.settings import OperatorSettings
from hardware.operator.shared_state import Request, Wish, refusal
from hardware.operator.taker import PictureTaker
from hardware.operator.view import (
    Activity,
    Answer,
    CameraView,
    Check,
    LatencyView,
    MotionView,
    OperatorView,
    ProgressView,
    Stage,
    TrackingView,
    Verdict,
)
from hardware.process.clock import Clock, WallClock

PERIOD = 0.1  # s between two views
SPEED = 9.0  # checkpoints/s
HELD = 0.62  # mm: of error while it holds
OFFERS: dict[Stage, tuple[Wish, ...]] = {
    Stage.CHECK: (Wish.AGAIN,),
    Stage.FIND: (),
    Stage.CONFIRM: (Wish.CONFIRM, Wish.AGAIN),
    Stage.READY: (Wish.START, Wish.AGAIN, Wish.HOME, Wish.END),
    Stage.APPROACH: (Wish.PAUSE,),
    Stage.PRINT: (Wish.PAUSE,),
    Stage.PAUSED: (Wish.RESUME, Wish.HOME),
    Stage.STOPPED: (Wish.RESUME, Wish.HOME, Wish.END),
    Stage.HOMING: (),
    Stage.DONE: (Wish.HOME, Wish.END),
    Stage.FAILED: (Wish.AGAIN, Wish.HOME, Wish.END),
}
LEADS = {
    Wish.CONFIRM: Stage.READY,
    Wish.AGAIN: Stage.FIND,
    Wish.START: Stage.APPROACH,
    Wish.PAUSE: Stage.PAUSED,
    Wish.RESUME: Stage.APPROACH,
    Wish.STOP: Stage.STOPPED,
    Wish.HOME: Stage.HOMING,
    Wish.END: Stage.DONE,
}
AFTER = {  # stages that end by themselves: after how many s, and what follows
    Stage.CHECK: (6.0, Stage.FIND),
    Stage.FIND: (4.0, Stage.CONFIRM),
    Stage.APPROACH: (2.5, Stage.PRINT),
    Stage.HOMING: (3.0, Stage.READY),
}
WHY = {
    Stage.STOPPED: "stopped by the operator",
    Stage.PAUSED: "paused by the operator",
    Stage.FAILED: "camera1 has sent no picture for 2 s: check its cable, then look again",
}
ARMED = (Stage.APPROACH, Stage.PRINT, Stage.PAUSED, Stage.HOMING)


class DemoRun:
    """Goes through the stages of a run as a real one would, and obeys as a real one would. taken: all requests."""

    def __init__(self, stage: Stage = Stage.CHECK, fraction: float = 0.0, now: float = 0.0) -> None:
        self._stage, self._since, self._then, self._fraction = stage, now, now, fraction
        self._path = demo_path()
        self._answer: Answer | None = None
        self.turn = 1
        self.taken: list[Request] = []

    @property
    def stage(self) -> Stage:
        """Where it is."""
        return self._stage

    def go(self, stage: Stage, now: float) -> None:
        """Enter a stage at `now`, s."""
        self._stage, self._since, self.turn = stage, now, self.turn + 1

    def obey(self, request: Request, now: float) -> None:
        """Follow a request, or refuse it."""
        self.taken.append(request)
        why = refusal(request.wish, request.turn, OFFERS[self._stage], self.turn)
        self._answer = Answer(request.number, request.wish, not why, why)
        if not why:
            again = request.wish is Wish.AGAIN and self._stage is Stage.CHECK
            self.go(Stage.CHECK if again else LEADS[request.wish], now)

    def step(self, now: float) -> OperatorView:
        """The run at `now`, s."""
        after, follows = AFTER.get(self._stage, (float("inf"), self._stage))
        if now - self._since > after:
            self.go(follows, now)
        if self._stage is Stage.PRINT and not _held(now):
            self._fraction = min(self._fraction + SPEED * (now - self._then), len(self._path) - 1)
            if self._fraction == len(self._path) - 1:
                self.go(Stage.DONE, now)
        self._then = now
        return self._view(now)

    def _view(self, now: float) -> OperatorView:
        stage = self._stage
        known = stage not in (Stage.CHECK, Stage.FIND)
        return OperatorView(
            stamp=now,
            turn=self.turn,
            stage=stage,
            reason=WHY.get(stage, ""),
            offers=OFFERS[stage],
            checks=_checks(now - self._since) if stage is Stage.CHECK else (),
            tracking=_tracking(stage, now),
            motion=self._motion(now) if known else None,
            progress=self._progress() if known else None,
            latency=LatencyView(0.0142, 0.0271 + 0.002 * np.sin(now), 0.035) if known else None,
            cameras=_cameras(stage),
            answer=self._answer,
            notes=("demonstration",),
        )

    def _motion(self, now: float) -> MotionView:
        moves = self._stage in (Stage.PRINT, Stage.APPROACH)
        held = self._stage is Stage.PRINT and _held(now)
        error = HELD if held else 0.17 + 0.06 * np.sin(2.1 * now) + 0.03 * np.sin(7 * now)
        lift = {Stage.PRINT: 0.0, Stage.APPROACH: max(12 - 5 * (now - self._since), 0.0)}.get(self._stage, 25.0)
        activity = Activity.ENTERING if self._stage is Stage.APPROACH else Activity.PRINTING
        activity = Activity.HOLDING if held else activity if moves else Activity.RESTING
        return MotionView(
            activity=activity,
            reason="predicted error 0.62 mm at the nozzle, limit 0.50 mm: the surface moves too fast" if held else "",
            error=float(error) if moves else nan,
            limit=0.5,
            true_error=float(0.8 * error + 0.03 * np.sin(11 * now)) if moves else nan,
            in_flight=0.031 if moves else 0.0,
            most_in_flight=0.05,
            base_from_nozzle=nozzle_at(surface_at(now), self._path, self._fraction, lift),
            arm="armed" if self._stage in ARMED else "disarmed",
        )

    def _progress(self) -> ProgressView:
        total = len(self._path)
        share = self._fraction / (total - 1)
        layer = int(self._path.layer[int(self._fraction)]) + 1
        return ProgressView(self._fraction, total, share, (1 - share) * total / SPEED, 0.87, layer, 2)


def _held(now: float) -> bool:
    return now % 12 > 9.5


def _tracking(stage: Stage, now: float) -> TrackingView:
    pose = surface_at(now)
    spread = np.diag([0.0025, 0.0016, 0.006]) * (1.5 + np.sin(now))
    if stage in (Stage.CHECK, Stage.FIND):
        return TrackingView(TrackState.INITIALISING, "no map of the surface yet", nan, nan, pose, spread * nan)
    state, why = TrackState.TRACKING, "three cameras agree on 182 tracks"
    if stage is Stage.FAILED:
        state, why = TrackState.LOST, "no picture for 2.0 s"
    return TrackingView(state, why, 0.018, float(np.sqrt(spread.max())), pose, spread, 182)


def _cameras(stage: Stage) -> tuple[CameraView, ...]:
    fine = tuple(CameraView(f"camera{k}", Verdict.PASS, 29.9, 61 - 7 * k) for k in range(3))
    if stage is not Stage.FAILED:
        return fine
    return fine[0], replace(fine[1], verdict=Verdict.FAIL, words="no picture for 2 s"), fine[2]


def _checks(age: float) -> tuple[Check, ...]:
    rows = (
        Check("Cameras", Verdict.PASS, "3 cameras at 30 Hz, 1280 x 720"),
        Check("Calibration", Verdict.PASS, "0.31 px on what is seen now"),
        Check("Arm", Verdict.PASS, "answers, 9.6 ms behind"),
        Check("Path", Verdict.PASS, "700 checkpoints, 2 layers, 1.9 ml"),
        Check(
            "Reach", Verdict.WARN, "4 mm from the edge of joint 5", "Move the bed 20 mm nearer to the arm if you can."
        ),
        Check("Disk", Verdict.PASS, "212 GB free, enough for 31 h"),
    )
    done = int(age)
    return tuple(row if k < done else Check(row.name, Verdict.BUSY) for k, row in enumerate(rows))


def run(link: OperatorLink, page: OperatorPage, stage: Stage, clock: Clock) -> None:
    """Go on until interrupted."""
    made, painter = DemoRun(stage, 260.0, clock.now()), Painter(demo_rig(), np.random.default_rng(1))
    taker = PictureTaker(link.pictures, link.requests)
    link.scene.put(demo_scene())
    while True:
        now = clock.now()
        page.tend(now)
        for request in link.requests.take():
            made.obey(request, now)
        link.views.put(made.step(now))
        if link.requests.windows:
            taker.offer(now, painter.shots(surface_at(now)), surface_at(now) if made.stage is not Stage.CHECK else None)
        clock.wait_until(now + PERIOD)


def main() -> None:
    """Serve it and say where."""
    link, clock = OperatorLink(), WallClock()
    page = OperatorPage(link, OperatorSettings())
    try:
        print(page.address, flush=True)
        run(link, page, Stage.CHECK, clock)
    except KeyboardInterrupt:
        page.close()


if __name__ == "__main__":
    main()
