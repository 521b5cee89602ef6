"""What an arm that does not follow is called back from: nothing is lost or done twice, and it goes on soon."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from hardware.arm.device import ArmState
from hardware.arm.driver import G1, Pause, Reply, ReplyKind
from hardware.arm.feedback import ArmFeedback, near
from hardware.arm.jog import MIN_TRIAL_STEP, AbortRecovery, is_underway
from hardware.arm.link import RECALLED
from hardware.arm.profile import ArmProfile, LinkSettings
from hardware.arm.queue import ArmQueue
from hardware.motion.loop import Order, Tick
from hardware.simulator.arm.settings import ArmSettings, ReplyMode
from planning.command import Move
from planning.kinematics import nozzle_from_axes
from planning.motion.curve import place_passed
from planning.motion.planner import Planner
from tests.linked_arm import Linked, circle, linked
from tests.moving_surfaces import breathing, pose_at, raster
from tests.slow_cases import slowly
from tests.test_motion_loop import Looping, seen
from tests.virtual_arm import HOME, arm_fault

ANSWERING = ArmSettings(servo_lag=0.02, replies=ReplyMode.STREAM)
ROUNDING = 0.15  # mm: of answers that count 0.1 mm
STEP = 0.6  # mm, of which an arm that obeys may have some before it
SOON = 0.2  # s
UNDER_WAY = 0.05  # s of motion, of which what struck the arm may have spoilt the last frame


def recalled_by(link: Linked, seconds: float) -> list[float]:
    """Follow a circle as a motion does that takes note of recalls; the instants, s, at which frames went out."""
    sent: list[float] = []

    def each(now: float) -> None:
        before = link.executed()
        if recalled := link.arm.take_up():
            assert np.linalg.norm((recalled.stands - before)[:3]) < ROUNDING + STEP
        if not link.arm.hold(now) and not link.send(circle(link.phase + 0.02)):
            link.phase += 0.02
            sent.append(now)

    link.run(seconds, each)
    return sent


@settings(max_examples=12)
@given(
    fault=st.sampled_from(["stall", "drop", "garble", "unplug", "slow 40%"]),
    start=st.floats(1.0, 1.2),
    seconds=st.floats(0.15, 1.0),
)
def test_it_goes_on_soon_after_what_struck_it_is_gone(fault: str, start: float, seconds: float) -> None:
    link = linked(ANSWERING, arm_fault(f"{fault} at {start}s for {seconds}s seed 3"))
    gone = start + seconds
    sent = np.array(recalled_by(link, gone + 1.5))
    assert sent[sent > gone][0] < gone + SOON
    on = gone + SOON + UNDER_WAY
    assert np.diff([on, *sent[sent > on]]).max() < 0.05
    assert link.arm.state is ArmState.ARMED and link.virtual.queued_work <= 0.06


def test_an_arm_that_has_begun_its_step_is_not_called_back_for_the_time_it_did_not() -> None:
    for seconds in np.arange(0.5, 0.6, 0.007):  # answers come from all over the step
        link = linked(ANSWERING, arm_fault(f"stall {seconds:.3f}s at 1.1s"))
        recalled_by(link, 1.3)
        link.run(1.2, lambda now, arm=link.arm: arm.take_up() and None)
        assert sum("called back" in event.text for event in link.arm.events()) == 1, seconds
        assert link.arm.arrived(link.clock.now())


def test_nothing_is_sent_before_somebody_has_taken_note_of_what_was_called_back() -> None:
    link = linked(ANSWERING, arm_fault("stall 300ms at 1s"))
    recalled_by(link, 1.2)
    assert link.arm.hold(link.clock.now()) == RECALLED and link.arm.take_up() is None  # it stands still
    rested = link.executed()
    link.run(0.5)
    assert link.arm.hold(link.clock.now()) == RECALLED
    recalled = link.arm.take_up()
    assert recalled is not None and link.arm.hold(link.clock.now()) == ""
    assert np.abs(recalled.place - rested)[:3].max() < ROUNDING
    assert np.abs(recalled.stands - link.executed())[:3].max() < ROUNDING
    assert MIN_TRIAL_STEP - ROUNDING < np.linalg.norm((recalled.stands - rested)[:3]) < 1.0  # the step that told
    assert link.arm.take_up() is None


def test_a_step_that_is_lost_is_given_again_and_goes_no_farther() -> None:
    link = linked(ANSWERING, arm_fault("drop at 1s for 800ms"))
    recalled_by(link, 1.75)
    rested = link.executed()
    assert sum("called back" in event.text for event in link.arm.events()) == 1  # and pause frames since
    link.run(0.5)
    assert link.arm.take_up() is not None
    assert np.linalg.norm((link.executed() - rested)[:3]) < 0.03 * link.arm.settings.speed + ROUNDING


def printed(ticks: list[Tick], link: Linked) -> np.ndarray:
    """Where the tip was on the surface (N, 3), mm, while moves that extrude were made."""
    profile = link.arm.profile
    times = np.concatenate(
        [
            t.stamp + profile.tick + profile.lag - np.arange(0, profile.tick, 0.002)
            for t in ticks
            if isinstance(t.command, Move) and t.command.extrude
        ]
    )
    times = times[times < link.virtual.now]
    tips = nozzle_from_axes(profile.arm, link.virtual.axes_at(times))[:, :3, 3]
    surfaces = np.stack([breathing(t) for t in times])
    return np.asarray(se3.transform_points(se3.inverse(surfaces), tips[:, None])[:, 0])


def test_of_the_path_nothing_is_left_out_and_it_is_done_as_soon_as_it_can_be() -> None:
    link = linked(ANSWERING, arm_fault("stall 500ms at 6s"), stand=False, profile=ArmProfile())
    looping = Looping({0.0: Order.AT_HOME, 0.5: Order.ARM}, link, seen)
    ticks = looping.run(10.0)
    recalls = [t for t in ticks if t.recalled is not None]
    assert len(recalls) == 1 and 6.5 < recalls[0].stamp < 6.5 + SOON
    done = printed(ticks, link)
    path = looping.motion.progress.place
    assert path > 20 and unprinted(done, path) < 0.4


@pytest.mark.parametrize(
    "struck",
    [
        ("stall 500ms at 6s", {6.2: Order.STOP, 8.0: Order.ARM}),
        *slowly(
            ("stall 3s at 6s", {10.0: Order.ARM}),  # stopped by patience
            ("stall 500ms at 6s", {6.2: Order.DISARM, 8.0: Order.ARM}),
        ),
    ],
)
def test_nothing_is_left_out_where_a_call_back_ends_in_a_stop(struck: tuple[str, dict[float, Order]]) -> None:
    fault, orders = struck
    link = linked(ANSWERING, arm_fault(fault), stand=False, profile=ArmProfile())
    looping = Looping({0.0: Order.AT_HOME, 0.5: Order.ARM, **orders}, link, seen)
    done = printed(looping.run(max(orders) + 6.0), link)
    path = looping.motion.progress.place
    assert path > 20 and unprinted(done, path) < 0.2


def test_what_is_undone_is_told_though_the_arm_goes_home_first() -> None:
    link = linked(ANSWERING, arm_fault("stall 500ms at 6s"), stand=False, profile=ArmProfile())
    orders = {0.0: Order.AT_HOME, 0.5: Order.ARM, 6.2: Order.STOP, 8.0: Order.HOME}
    looping = Looping(orders, link, seen)
    ticks = looping.run(12.0)
    (told,) = [t for t in ticks if t.recalled is not None]
    assert 8.0 < told.stamp < 8.05 and told.recalled is not None
    assert np.abs(told.recalled.place - link.virtual.axes_at(np.array([7.9]))[0])[:3].max() < ROUNDING
    path = looping.motion.progress.place
    assert path > 10 and unprinted(printed(ticks, link), path) < 0.2
    assert link.arm.arrived(link.clock.now()) and link.arm.state is ArmState.DISARMED


def unprinted(done: np.ndarray, path: float) -> float:
    """The largest distance, mm, of a place on the first `path` mm of the raster from where it was printed."""
    ways = raster(speed=10.0).surface_from_nozzle[:, :3, 3]
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(ways, axis=0), axis=1))])
    asked = np.arange(0.0, path - 0.5, 0.05)
    places = np.stack([np.interp(asked, along, ways[:, i]) for i in range(3)], 1)
    return float(np.linalg.norm(places[:, None] - done[None], axis=2).min(1).max())


def test_home_waits_until_the_arm_is_known_to_obey() -> None:
    link = linked(ANSWERING, arm_fault("stall 600ms at 1s"))
    recalled_by(link, 1.3)
    assert link.arm.home(link.clock.now()) == RECALLED
    link.run(0.6)
    assert link.arm.take_up() is not None and link.arm.home(link.clock.now()) == ""


def test_the_path_goes_on_where_the_arm_came_to_rest() -> None:
    profile = ArmProfile()
    planner = Planner(raster(speed=10.0), profile.limits, profile.arm, profile.tick)
    sent: list[tuple[np.ndarray, float]] = []
    now = 0.0
    while not (sent and sent[-1][1] > 6.0):
        command = planner(pose_at(breathing, now), now)
        if isinstance(command, Move):
            sent.append((command.axes, planner.progress.place))
        now += profile.tick
    where = 0.5 * (sent[-6][0] + sent[-5][0])
    stands = sent[-2][0]
    planner.recalled(where, stands)
    assert planner.progress.place == pytest.approx(0.5 * (sent[-6][1] + sent[-5][1]), abs=1e-6)
    first = planner(pose_at(breathing, now), now)
    assert isinstance(first, Move) and np.linalg.norm((first.axes - stands)[:3]) < 0.5
    planner.recalled(HOME, HOME)  # far from all that was sent since: no farther on than it was
    assert planner.progress.place <= 0.5 * (sent[-6][1] + sent[-5][1]) + 1e-9


def test_where_moves_passed_is_told_by_the_last_time_they_did() -> None:
    ends = [np.array([x, 0.0, 0.0]) for x in (0.0, 1.0, 2.0, 1.0, 0.0)]
    sent = list(zip(ends, (0.0, 1.0, 2.0, 3.0, 4.0), strict=True))
    assert place_passed(sent, np.array([1.5, 0.3, 0.0])) == pytest.approx(2.5)
    assert place_passed(sent[:2], np.array([9.0, 0.0, 0.0])) == 1.0 and place_passed(sent[:1], ends[4]) == 0.0


def test_an_answer_is_near_within_its_rounding_alone() -> None:
    assert near(HOME + 0.1, HOME) is False and near(HOME + [0.1, 0, 0, 0, 0, 0], HOME)
    assert not near(HOME + [0.2, 0, 0, 0, 0, 0], HOME) and not near(None, HOME) and not near(HOME, None)


SIX = st.lists(st.floats(-1, 1), min_size=6, max_size=6).map(np.array)
COUNT = np.array([*[0.1] * 3, *[np.deg2rad(0.01)] * 3])  # of answers, mm and rad


@given(place=SIX, beside=SIX, far=st.booleans())
def test_where_it_rests_is_as_known_as_its_answer_allows(place: np.ndarray, beside: np.ndarray, far: bool) -> None:
    true = HOME + 100 * COUNT * place
    known = true + (20 if far else 1) * COUNT * beside
    answered, echo = np.round(true / COUNT) * COUNT, ArmFeedback(LinkSettings(), 0.02)
    assert echo.stands(known, 0.0) is None  # it has not answered
    queue = ArmQueue(known.tolist(), 0.004, 0.0)
    echo.take(Reply(ReplyKind.PLACE, answered[:3]), queue, 0.1)
    echo.take(Reply(ReplyKind.TOOL, answered[3:]), queue, 0.1)
    stands = echo.stands(known, 0.1)
    assert stands is not None and (np.abs(stands - answered) <= 0.501 * COUNT).all()
    if near(answered, known):
        assert (np.abs(stands - true) <= np.abs(known - true) + 1e-3 * COUNT).all()  # never farther off than before
    else:
        assert (stands == answered).all()
    assert np.array_equal(echo.stands(None, 0.1), answered)


def test_an_arm_is_under_way_between_the_ends_of_its_step_alone() -> None:
    end = HOME + [0.6, -0.3, 0, 0, 0, 0]
    assert is_underway(HOME + [0.3, -0.1, 0, 0, 0, 0], HOME, end) and is_underway(end, HOME, end)
    assert not is_underway(HOME, HOME, end)  # it has not left
    assert not is_underway(HOME + [0.3, 0.4, 0, 0, 0, 0], HOME, end)  # it goes elsewhere
    assert not is_underway(HOME + [0.3, -0.1, 0, 0, 0, 0.01], HOME, end)
    assert not is_underway(None, HOME, end) and not is_underway(end, None, end)


@pytest.mark.parametrize(
    ("away", "said"),
    [([0.3, 0, 0], "obeys"), ([0.6, 0, 0], "obeys"), ([0, 0, 0], "once more"), ([0, 0.3, 0], "called back")],
)
def test_what_an_arm_does_with_its_step_says_whether_it_obeys(away: list[float], said: str) -> None:
    recall, echo = AbortRecovery(0.03, 20.0, 0.02), ArmFeedback(LinkSettings(), 0.02)

    def answer(place: np.ndarray, now: float) -> None:
        for kind, values in (ReplyKind.PLACE, place[:3]), (ReplyKind.TOOL, place[3:]):
            echo.take(Reply(kind, values), ArmQueue(HOME.tolist(), 0.004, 0.0), now)

    recall.begin("a stall", HOME + [5, 0, 0, 0, 0, 0], None, 1.0)
    for now in 0.95, 1.05, 1.1:
        answer(HOME, now)
    (step,) = recall.next(echo, HOME, 1.1)
    assert isinstance(step, G1) and np.allclose(step.axes - HOME, [0.6, 0, 0, 0, 0, 0]) and not recall.waits
    assert recall.next(echo, step.axes, 1.12) == ()  # too soon to say
    answer(HOME + [*away, 0, 0, 0], 1.2)
    following = recall.next(echo, step.axes, 1.2)
    if said == "once more":
        pause, again = following
        assert isinstance(pause, Pause) and isinstance(again, G1) and np.array_equal(again.axes, step.axes)
    else:
        assert [type(each) for each in following] == ([Pause] if said == "called back" else [])
    assert recall.waits == (said == "called back") and recall.obeys == (said == "obeys")
