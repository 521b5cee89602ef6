"""Wrong edits to the most dangerous lines of the product; a named fast test must fail under each of them.

python -m tests.mutants              makes all the edits, one after the other, each in a copy of the tree
python -m tests.mutants NAME ...     those whose names hold one of the words

The tests named must pass in the copy first. A mutant is killed where pytest then finds a failing test; it survives
where all pass. Exit code 1 where one survives, no longer applies, or comes to no verdict. The tree itself is not
touched, and nothing is left of the copies, after Ctrl-C neither.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from enum import Enum
from importlib.util import cache_from_source
from pathlib import Path
from queue import SimpleQueue
from tempfile import TemporaryDirectory

ROOT = Path(__file__).parents[1]
WORKERS = 2
TIME_LIMIT_S = 120.0  # of one mutant's tests; the unedited tree's compile all loops first and have TIME_LIMIT_ALL_S
TIME_LIMIT_ALL_S = 600.0
NOT_COPIED = ("out", "demo", "build", "dist", "*.egg-info", ".*")


@dataclass(frozen=True)
class Mutant:
    """One wrong edit. old: stands once in the file. tests: names of pytest, in tests/, of which one must fail."""

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]


MUTANTS = (
    Mutant(
        "the slowest of all angles is laid",
        "planning/fill/fill.py",
        "return min(smooth",
        "return max(smooth",
        ("test_fill_laws.py::test_of_all_angles_that_are_tried_none_is_faster_than_the_one_chosen",),
    ),
    Mutant(
        "the slowest of all angles is settled on",
        "planning/fill/fill.py",
        "np.argmin",
        "np.argmax",
        ("test_fill_laws.py::test_of_all_angles_that_are_tried_none_is_faster_than_the_one_chosen",),
    ),
    Mutant(
        "the nozzle prints however far off the path",
        "planning/motion/planner.py",
        "reference[:3]) <= self._limits.on_path",
        "reference[:3]) < np.inf",
        ("test_planner.py::test_nothing_is_printed_farther_off_the_path_than_may_be",),
    ),
    Mutant(
        "the path is followed with a pose that is too old",
        "planning/motion/planner.py",
        "if not 0 <= age <= POSE_LIMIT_FRACTION",
        "if not 0 <= age <= 9",
        ("test_planner.py::test_what_a_pose_lacks_is_braked_for_before_the_guard_would_refuse",),
    ),
    Mutant(
        "a prediction forgets that the velocity is not exact",
        "estimation/pose.py",
        " + dt**2 * self.twist_covariance",
        "",
        ("test_pose.py::test_velocity_and_acceleration_widen_a_prediction_as_they_scatter_samples",),
    ),
    Mutant(
        "a covariance is carried the wrong way",
        "estimation/pose.py",
        "se3.adjoint(se3.inverse(step))",
        "se3.adjoint(step)",
        ("test_pose.py::test_the_predicted_covariance_is_that_of_predicted_samples",),
    ),
    Mutant(
        "the adjoint has its blocks exchanged",
        "estimation/se3.py",
        "out[..., 3:, :3] = hat(transform[..., :3, 3]) @ r",
        "out[..., :3, 3:] = hat(transform[..., :3, 3]) @ r",
        ("test_se3.py",),
    ),
    Mutant(
        "the window holds on to its prior whatever is measured",
        "estimation/online/window.py",
        "> MAX_PRIOR_CHI2",
        "> np.inf",
        ("test_smoother.py::test_however_far_a_surface_at_rest_jumps_the_window_is_with_it_at_once",),
    ),
    Mutant(
        "clocks learn from a velocity that is noise",
        "estimation/online/camera_errors.py",
        "if signal_share < self.MIN_SIGNAL_SHARE",
        "if signal_share < 0",
        ("test_outages.py::test_of_a_velocity_that_is_noise_nothing_is_learned_of_the_clocks",),
    ),
    Mutant(
        "clocks are corrected by what chance explains",
        "estimation/online/camera_errors.py",
        "self.offset = mean * min(",
        "self.offset = mean * max(1.0, ",
        ("test_outages.py::test_what_chance_explains_moves_no_clock_and_what_it_does_not_is_found",),
    ),
    Mutant(
        "half a pixel is added where it is to be taken off",
        "perception/mapping/features.py",
        "(x0 - SIFT_OFFSET_PX, y0 - SIFT_OFFSET_PX)",
        "(x0 + SIFT_OFFSET_PX, y0 + SIFT_OFFSET_PX)",
        ("test_patches.py::test_sift_finds_the_middle_of_a_spot_to_a_tenth_of_a_pixel",),
    ),
    Mutant(
        "one frame set is enough to be trusted again",
        "estimation/online/surface_state.py",
        "< self.settings.settle",
        "< 0",
        ("test_estimator.py::test_an_outage_coasts_then_is_lost_and_then_found",),
    ),
    Mutant(
        "a surface that is not seen is never lost",
        "estimation/online/surface_state.py",
        "seconds > self.settings.coast",
        "seconds > np.inf",
        ("test_estimator.py::test_an_outage_coasts_then_is_lost_and_then_found",),
    ),
    Mutant(
        "the guard takes a pose twice as old",
        "planning/motion/guard.py",
        "<= limits.pose_age",
        "<= 2 * limits.pose_age",
        ("test_guard.py",),
    ),
    Mutant(
        "the guard takes a pose that is not measured",
        "planning/motion/guard.py",
        "if not pose.state.measured",
        "if pose.state is None",
        ("test_guard.py",),
    ),
    Mutant(
        "the guard forgets that acceleration is unknown",
        "planning/motion/guard.py",
        " + np.diag(pose.acceleration_psd) * beyond**3 / 3",
        "",
        ("test_guard.py",),
    ),
    Mutant(
        "material flows while the pose is not trusted",
        "planning/motion/guard.py",
        "if move.extrude",
        "if move.extrude is None",
        ("test_guard.py",),
    ),
    Mutant(
        "the guard lets a long step pass",
        "planning/motion/guard.py",
        "if jump > limits.jump",
        "if jump > 1.01 * limits.jump",
        ("test_guard.py",),
    ),
    Mutant(
        "the guard looks for zones at the end of a step alone",
        "planning/motion/guard.py",
        "zone.depth_along(start, end)",
        "zone.depth_along(end, end)",
        ("test_arm_file.py::test_no_step_goes_through_a_zone_or_ends_behind_it",),
    ),
    Mutant(
        "after a call-back the guard counts from where the arm was sent",
        "hardware/motion/step.py",
        "self._guard.stands(stands)",
        "self._guard.stands(self._guard.axes)",
        ("test_motion.py::test_after_moves_were_called_back_planner_and_guard_go_on_from_where_the_arm_stands",),
    ),
    Mutant(
        "the planner does not learn that a move was refused",
        "hardware/motion/step.py",
        "self._planner.refused(self._guard.axes)",
        "pass",
        ("test_motion.py::test_after_a_refusal_the_planner_knows_where_the_arm_stands",),
    ),
    Mutant(
        "the loop ends and the arm is not stopped",
        "hardware/motion/loop.py",
        'shut_down(self.arm, "the motion has ended", self._clock, self._poll_period)',
        "pass",
        ("test_motion_loop.py::test_whatever_ends_it_the_arm_is_stopped",),
    ),
    Mutant(
        "an order to stop only disarms",
        "hardware/motion/loop.py",
        "arm.stop(BY_OPERATOR, now)",
        "arm.disarm(now)",
        ("test_motion_loop.py::test_a_stop_waits_for_no_tick",),
    ),
    Mutant(
        "material flows on when the loop ends",
        "hardware/motion/loop.py",
        "self.material.off(ended)",
        "pass",
        ("test_material_loop.py::test_whatever_ends_the_loop_closes_the_material",),
    ),
    Mutant(
        "material flows though the arm is not armed",
        "hardware/motion/loop.py",
        "if self.arm.state is not ArmState.ARMED:\n                self.material",
        "if self.arm.state is None:\n                self.material",
        ("test_material_loop.py::test_what_ends_extrusion_ends_the_material",),
    ),
    Mutant(
        "a hold leaves the material on",
        "hardware/motion/loop.py",
        "if not isinstance(command, Move):\n            self.off(now)",
        "if not isinstance(command, Move):\n            self.poll(now)",
        ("test_material_loop.py::test_what_ends_extrusion_ends_the_material",),
    ),
    Mutant(
        "a command that was not sent counts as sent",
        "hardware/motion/loop.py",
        "if hold := self.arm.send(command, now)",
        "if hold := self.arm.send(command, now) and DONE",
        ("test_motion_loop.py::test_what_the_link_does_not_send_is_told_as_a_hold",),
    ),
    Mutant(
        "armed again, the arm goes on to what was called back",
        "hardware/motion/loop.py",
        "self._last_target = recalled.stands",
        "pass",
        ("test_motion_loop.py::test_an_arm_armed_again_stays_where_it_came_to_rest_when_moves_were_called_back",),
    ),
    Mutant(
        "a stop waits for the frames before it",
        "hardware/arm/s6h4d.py",
        "> (1 if self._written_bytes else 0)",
        "> 9",
        ("test_arm_link.py::test_a_frame_of_which_no_byte_is_gone_goes_out_no_more_once_the_arm_is_to_rest",),
    ),
    Mutant(
        "nothing waits until less than 50 ms are under way",
        "hardware/arm/queue.py",
        "in_flight_with(duration, now) + backlog > self.flight",
        "in_flight_with(duration, now) + backlog > 9",
        ("test_arm_link.py::test_what_the_link_does_not_hold_back_it_takes_and_never_has_to_stop_the_arm",),
    ),
    Mutant(
        "what an arm has made good counts as under way",
        "hardware/arm/feedback.py",
        "return behind - queue.idle(since, now) if",
        "return behind if",
        ("test_arm_link.py::test_the_backlog_is_never_taken_for_more_than_it_is",),
    ),
    Mutant(
        "a command of any length is sent",
        "hardware/arm/queue.py",
        "if flight > self.flight",
        "if flight > 9",
        ("test_arm_link.py::test_a_command_too_long_or_too_fast_stops_the_arm_and_is_not_sent",),
    ),
    Mutant(
        "an arm that runs away is let go on",
        "hardware/arm/link.py",
        "elif self._feedback.off > self.settings.lost",
        "elif self._feedback.off > 1e9",
        ("test_arm_link.py::test_an_arm_that_runs_away_is_stopped_at_once",),
    ),
    Mutant(
        "an arm that has stopped by itself is sent more",
        "hardware/arm/link.py",
        "if self.fault and self.state is ArmState.ARMED",
        "if False",
        ("test_arm_laws.py::test_an_arm_that_has_stopped_by_itself_is_stopped_and_says_why",),
    ),
    Mutant(
        "an arm that is away is thought to stand where it was",
        "hardware/arm/device.py",
        "self._online, self._queue = False, None",
        "self._online = False",
        ("test_arm_laws.py::test_unplugged_it_is_known_nowhere_and_back_it_waits_for_the_operator",),
    ),
    Mutant(
        "a frame with wrong reserved bytes is taken",
        "hardware/arm/protocol.py",
        "if encode(instruction, dialect) != frame",
        "if len(frame) == 0",
        ("test_protocol.py",),
    ),
    Mutant(
        "the run goes on without pictures",
        "hardware/live/state_machine.py",
        "now - tracking.pose.stamp) > self.task.patience",
        "now - tracking.pose.stamp) > 1e9",
        ("test_live_stages.py",),
    ),
    Mutant(
        "an arm is taken for armed by a report from before it was asked to",
        "hardware/live/state_machine.py",
        "self._armed |= motion.tick.stamp > self._order_time",
        "self._armed = True",
        ("test_live_stages.py",),
    ),
    Mutant(
        "the run goes on though nothing is recorded",
        "hardware/live/state_machine.py",
        "if reports.recorder is not None and reports.recorder.failed",
        "if reports.recorder is None and self.done",
        ("test_live_stages.py",),
    ),
    Mutant(
        "a recording is handed over at its end alone",
        "hardware/recording/recorder.py",
        "if abs(stamp - self._chunk_start) >= MAX_CHUNK_SECONDS",
        "if abs(stamp - self._chunk_start) >= 1e9",
        ("test_recording_damage.py",),
    ),
    Mutant(
        "a broken part of a recording is read as if it were whole",
        "hardware/recording/mcap_file.py",
        "breakup_chunk(Chunk.read(stream), validate_crc=True)",
        "breakup_chunk(Chunk.read(stream), validate_crc=False)",
        ("test_recording_damage.py",),
    ),
    Mutant(
        "a lens is taken however its corners scatter",
        "estimation/calibration/camera_rig.py",
        "if not spread <= MAX_FIT_ERROR",
        "if not spread <= 1e9",
        ("test_camera_calibration.py::test_a_board_that_is_not_the_one_described_is_told_by_how_its_corners_scatter",),
    ),
    Mutant(
        "an arm is calibrated from places on a line",
        "estimation/calibration/arm_model.py",
        "if spread[1] < MIN_LINE_SPREAD",
        "if spread[1] < 0",
        ("test_arm_calibration.py::test_moves_that_cannot_tell_are_named",),
    ),
    Mutant(
        "an outline stays on the picture while the surface moves on",
        "hardware/operator/overlays.py",
        "outline.in_pixels(roi.camera, base_from_surface)",
        "outline.in_pixels(roi.camera, self._placed[1])",
        ("test_wound_outline.py::test_an_outline_goes_to_where_the_surface_is_when_it_is_taken",),
    ),
    Mutant(
        "the first outline of a picture counts",
        "hardware/recording/session_reader.py",
        "newest[key].stamp <= record.stamp",
        "newest[key].stamp > record.stamp",
        ("test_wound_outline.py::test_each_picture_counts_once_with_the_last_outline_in_order_of_camera_and_stamp",),
    ),
    Mutant(
        "an outline that another one has replaced is followed",
        "hardware/operator/shared_state.py",
        "own = newest is not None and newest.number == request.number",
        "own = newest is not None",
        ("test_operator_messages.py::test_an_outline_goes_with_its_own_request_and_with_no_other",),
    ),
    Mutant(
        "a guess is confirmed as it lies",
        "hardware/live/state_machine.py",
        "return placement.certain or (placement.usable and self.moves > 0)",
        "return placement.usable",
        ("test_live_stages.py::test_a_guess_is_confirmed_by_nobody_before_it_was_moved",),
    ),
    Mutant(
        "a guess is printed with nobody there",
        "hardware/live/state_machine.py",
        "if task.unattended and not placement.certain:",
        "if task.unattended and not placement.usable:",
        ("test_live_stages.py::test_nobody_there_and_no_certain_place_ends_the_run",),
    ),
    Mutant(
        "a scan of something else fits",
        "estimation/scans/registration.py",
        "fits = not problems",
        "fits = True",
        ("test_placement.py::test_the_scan_of_something_else_cannot_be_used_at_all",),
    ),
    Mutant(
        "a moved path does not follow the surface",
        "planning/placement.py",
        "place = foot + height * leaning",
        "place = place + 0 * height",
        ("test_placement.py::test_a_moved_path_keeps_its_height_and_leans_with_the_surface",),
    ),
    Mutant(
        "a move of any size is a message",
        "hardware/operator/broadcast.py",
        "if not MoveRequest(*shift).allowed:",
        "if not shift:",
        ("test_operator_messages.py::test_a_move_that_is_not_three_figures_within_bounds_is_no_message",),
    ),
    Mutant(
        "the colours of ink are the tissue's",
        "perception/mapping/masks.py",
        "first.free & ~self._ink_mask &",
        "first.free &",
        ("test_colours.py::test_ink_has_its_own_colours",),
    ),
    Mutant(
        "what one camera alone sees displaced counts",
        "perception/mapping/masks.py",
        "[-2] > MIN_SECOND_SHARE",
        "[-1] > MIN_SECOND_SHARE",
        ("test_colours.py::test_a_displacement_is_what_a_second_camera_sees_as_well",),
    ),
    Mutant(
        "shadows over dark tissue move its colours",
        "perception/mapping/masks.py",
        "light = LIGHT_SIGMA * dark[k, p]",
        "light = 0 * dark[k, p]",
        ("test_colours.py::test_a_shadow_over_dark_tissue_is_no_displacement",),
    ),
    Mutant(
        "one place alone is displaced by its colours",
        "perception/mapping/masks.py",
        "MIN_BELLS, MIN_BELL_SHARE = 3,",
        "MIN_BELLS, MIN_BELL_SHARE = 1,",
        ("test_colours.py::test_a_displacement_is_what_several_places_see",),
    ),
    Mutant(
        "displaced colours are forgotten while they stand apart",
        "perception/mapping/masks.py",
        "np.isinf(expected_energy) | (energy > USUAL_RATIO * expected_energy)",
        "np.isinf(expected_energy)",
        ("test_colours.py::test_what_is_told_is_remembered_until_the_colours_are_back",),
    ),
    Mutant(
        "a surface that deforms looks like cameras that hang",
        "estimation/online/bump_detector.py",
        "return bool(projection > max(",
        "return bool(projection > -max(",
        ("test_warp.py::test_the_error_that_is_left_is_the_one_predicted",),
    ),
    Mutant(
        "two cameras that hang are believed",
        "estimation/online/camera_errors.py",
        "elif rival_hangs or in_step:",
        "else:",
        ("test_rival_cameras.py::test_two_that_hang_never_outvote_the_third_in_silence",),
    ),
    Mutant(
        "a repeat that the pictures do not rule out is dropped",
        "perception/mapping/verification.py",
        "possible = evidence < (ODD",
        "possible = evidence < -(ODD",
        ("test_verification.py::test_where_the_marks_are_hidden_nothing_is_sure",),
    ),
    Mutant(
        "a small bump is only told while it is found",
        "estimation/online/local_motion.py",
        "self._small[usable & (size < MIN_DISPLACEMENT_MM)] = 0.0",
        "self._small[:] = 0.0",
        ("test_local_error.py::test_a_bump_of_three_landmarks_is_never_off_by_a_millimetre_in_silence",),
    ),
    Mutant(
        "two groups in a region are no doubt",
        "estimation/online/parted_texture.py",
        "if periodic or not self._core or self._ambiguous(np.flatnonzero(self._members), MAX_PARTED_SHARE):",
        "if periodic or not self._core:",
        ("test_local_error.py::test_a_region_that_holds_two_groups_is_sure_of_neither",),
    ),
    Mutant(
        "cloth that slips over tissue is sure to be the surface",
        "estimation/online/parted_texture.py",
        "if periodic or not self._core or",
        "if not self._core or",
        ("test_local_error.py::test_where_the_texture_repeats_as_cloth_does_even_a_small_group_may_be_the_surface",),
    ),
    Mutant(
        "a part of cloth that moves says nothing of the rest",
        "estimation/online/parted_texture.py",
        "self._moved = moved if periodic else 0.0",
        "self._moved = 0.0",
        ("test_local_error.py::test_a_bump_is_a_matter_of_its_place_and_in_cloth_of_all_of_it",),
    ),
)


class Verdict(Enum):
    """What came of a mutant."""

    KILLED = "killed"
    SURVIVED = "SURVIVED"
    STALE = "THE EDIT NO LONGER APPLIES"
    NO_VERDICT = "NO VERDICT"


@dataclass(frozen=True)
class Outcome:
    """A mutant's verdict, and the tests' last words."""

    mutant: Mutant
    verdict: Verdict
    seconds: float
    words: str


def applies(mutant: Mutant, root: Path = ROOT) -> bool:
    """Whether the text to replace stands once in its file."""
    file = root / mutant.file
    return file.is_file() and file.read_text(encoding="utf-8").count(mutant.old) == 1


@contextmanager
def edited(mutant: Mutant, tree: Path) -> Iterator[None]:
    """The edit, for a while."""
    file = tree / mutant.file
    before, status = file.read_text(encoding="utf-8"), file.stat()
    _write(file, before.replace(mutant.old, mutant.new))
    try:
        yield
    finally:
        _write(file, before)
        os.utime(file, ns=(status.st_atime_ns, status.st_mtime_ns))  # so that numba takes its loops for compiled


def _write(file: Path, text: str) -> None:
    """Write a module and forget its bytecode: Python takes one of the same second and size for the same."""
    file.write_text(text, encoding="utf-8")
    Path(cache_from_source(str(file))).unlink(missing_ok=True)


class Copies:
    """Copies of the tree, each used by one process at a time; all processes end before they are removed."""

    def __init__(self, root: Path, folder: Path) -> None:
        self._root, self._folder = root, folder
        self._running: set[subprocess.Popen[str]] = set()
        self._ended = False

    def copy(self, name: str) -> Path:
        """One more copy, with what was compiled of the tree."""
        tree = self._folder / name
        shutil.copytree(self._root, tree, ignore=shutil.ignore_patterns(*NOT_COPIED))
        self._root = tree  # the next copy has what this one has compiled by then
        return tree

    def pytest(self, tree: Path, tests: Sequence[str], limit: float) -> tuple[int | None, str]:
        """Run tests in a copy up to the first failure: pytest's exit code, None beyond `limit` s, and its words."""
        command = [
            sys.executable,
            "-m",
            "pytest",
            "-x",
            "-q",
            "-p",
            "no:cacheprovider",
            "-o",
            "addopts=",
            "-m",
            "not slow",
            *(f"tests/{test}" for test in tests),
        ]
        environment = {**os.environ, "PYTHONPATH": str(tree), "HYPOTHESIS_PROFILE": "unshrunk"}
        environment.pop("PYTHONDONTWRITEBYTECODE", None)
        process = subprocess.Popen(
            command,
            cwd=tree,
            env=environment,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        self._running.add(process)
        if self._ended:
            self.end()
        try:
            words = process.communicate(timeout=limit)[0]
            return process.returncode, words
        except subprocess.TimeoutExpired:
            return None, f"not done within {limit:g} s"
        finally:
            _kill(process)
            self._running.discard(process)

    def end(self) -> None:
        """End all processes, and those that begin later at once."""
        self._ended = True
        for process in list(self._running):
            _kill(process)


def _kill(process: subprocess.Popen[str]) -> None:
    """End a process with all that it started."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def judge(mutant: Mutant, tree: Path, copies: Copies) -> Outcome:
    """Make the edit in a copy and run its tests."""
    begun = time.monotonic()
    if not applies(mutant, tree):
        return Outcome(mutant, Verdict.STALE, 0.0, "")
    with edited(mutant, tree):
        code, words = copies.pytest(tree, mutant.tests, TIME_LIMIT_S)
    verdict = {0: Verdict.SURVIVED, 1: Verdict.KILLED}.get(-1 if code is None else code, Verdict.NO_VERDICT)
    return Outcome(mutant, verdict, time.monotonic() - begun, words)


def judge_all(mutants: Sequence[Mutant], root: Path = ROOT, say: Callable[[str], None] = print) -> list[Outcome]:
    """Judge all of them, WORKERS at a time. RuntimeError where a test fails without any edit."""
    with TemporaryDirectory(prefix="mutants-") as folder:
        copies = Copies(root, Path(folder))
        first = copies.copy("0")
        tests = list(dict.fromkeys(test for mutant in mutants for test in mutant.tests))
        say(f"{len(tests)} tests and files of tests without an edit ...")
        pool = ThreadPoolExecutor(WORKERS)
        try:
            code, words = pool.submit(copies.pytest, first, tests, TIME_LIMIT_ALL_S).result()
            if code != 0:
                raise RuntimeError(f"the tests must pass without an edit:\n{words}")
            trees: SimpleQueue[Path] = SimpleQueue()
            for tree in (first, *(copies.copy(str(n)) for n in range(1, WORKERS))):
                trees.put(tree)

            def one(mutant: Mutant) -> Outcome:
                tree = trees.get()
                try:
                    return judge(mutant, tree, copies)
                finally:
                    trees.put(tree)

            outcomes = []
            for number, outcome in enumerate(pool.map(one, mutants), 1):
                say(f"{number:3}/{len(mutants)}  {row(outcome)}")
                outcomes.append(outcome)
            return outcomes
        finally:
            copies.end()
            pool.shutdown(cancel_futures=True)


def row(outcome: Outcome) -> str:
    """A line of the table."""
    mutant = outcome.mutant
    return f"{outcome.verdict.value:8} {outcome.seconds:5.1f} s  {mutant.name}  ({mutant.file})"


def main(arguments: list[str]) -> int:
    """Judge the mutants whose names hold one of the arguments, or all; 1 where one is not killed."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C: what was begun is cleaned up
    chosen = [each for each in MUTANTS if not arguments or any(word in each.name for word in arguments)]
    if not chosen:
        print("no such mutant; there are:", *(each.name for each in MUTANTS), sep="\n  ")
        return 2
    begun = time.monotonic()
    try:
        outcomes = judge_all(chosen)
    except RuntimeError as error:
        print(error)
        return 2
    except KeyboardInterrupt:
        print("interrupted")
        return 130
    alive = [each for each in outcomes if each.verdict is not Verdict.KILLED]
    for each in alive:
        print(f"\n{row(each)}\n  {' '.join(each.mutant.tests)}\n{each.words.strip()[-2000:]}")
    print(f"{len(outcomes) - len(alive)} of {len(outcomes)} mutants killed, {time.monotonic() - begun:.0f} s")
    return int(bool(alive))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
