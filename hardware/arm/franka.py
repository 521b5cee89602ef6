"""The driver of a Franka Research 3 or Panda, by franky (libfranka): franka://HOST.

libfranka wants an answer every millisecond, so franky lives in a process of its own, whose C++ thread gives it. Every
CONTROL_PERIOD that process compares where the robot says that it is with where the commands lead, and asks for the
joints' velocities that lead there: those of the commands, and a share of what is missing, by the robot's own Jacobian.
franky shapes each change of velocity by Ruckig within libfranka's limits of acceleration and jerk. (Streamed Cartesian
velocities failed in its planner about once in a thousand, error -110; those of joints did not in 4000.) A velocity is
good for VELOCITY_TIME only: where the process says nothing more, the robot brakes. It also brakes where the motion
process ends, as its pipe is closed then.

The robot is told where its flange goes; `flange_from_nozzle` of the arm file says what hangs on it.
"""

from __future__ import annotations

import math
import socket
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array
from hardware.arm.driver import G1, G4, ArmDriver, ByteListener, Pause, Reply, ReplyKind, Reported, Sent, UnpluggedError
from hardware.arm.profile import ArmProfile
from hardware.arm.protocol import encode
from hardware.arm.queue import ArmQueue
from hardware.process.clock import WallClock
from hardware.process.system import SPAWN, SharedLatest, ask_for_real_time, set_up_process, take_messages

SCHEME = "franka://"
FCI_PORT = 1337  # of libfranka
USUAL_HOSTS = ("127.0.0.1", "172.16.0.2")  # a simulator's, and the one that Franka's manual gives the robot
FIND_TIME = 0.3  # s for a host to answer
FIRST_CONNECT_TIME = (
    20.0  # s of the first connection, while nothing moves: libraries are loaded, and a host may be slow
)
CLOSE_TIME = 1.5  # s for the process to bring the robot to rest and end
CONTROL_PERIOD = 0.01  # s between velocities, and between reported places: twice a tick, and ten of libfranka's
GONE_TIME = 0.5  # s without a new state, after which the connection is given up and made anew
VELOCITY_TIME = 0.06  # s that a velocity is good for: three ticks
LOOK_BACK = 0.02  # s by which the commands are followed later: a tick, so that the next one is known
GAIN = 20.0  # 1/s of what is missing: settles in 0.05 s, five control periods
DYNAMICS = 0.5  # of franky's limits, which are libfranka's: 6.5 m/s^2 and 3250 m/s^3
STOP_TIME = 0.3  # s, after which a robot that still moves is told the hard way
RATE_STEP = 1e-5  # rad/s: 0.005 mm/s at the tool; Ruckig is spared changes smaller than that
POSTURE_GAIN = 1.0  # 1/s: far slower than the tool's
MAX_JOINT_RATE = 1.0  # rad/s: less than half of what the slowest joint may do
MAX_TURN_RATE = 1.0  # rad/s: no tool on a wound turns that fast
MIN_MANIPULABILITY = 0.02  # Yoshikawa's, sqrt(det(J J^T)), m^3 rad^3: at 0.1 it stands well, at 0 it is singular
JOINT_MARGIN = math.radians(2.0)  # rad from the end of a joint's range
JOINT_LOW = np.radians([-157.2, -102.2, -166.2, -174.2, -160.8, 31.2, -172.7])  # (7,) of the FR3's data sheet
JOINT_HIGH = np.radians([157.2, 102.2, 166.2, -8.7, 160.8, 258.8, 172.7])  # (7,)
ENABLE, STOP = "enable", "stop"  # orders without numbers


@dataclass(frozen=True, slots=True, eq=False)
class FrankaState:
    """A report of the robot's process."""

    stamp: float  # s, our clock
    axes: Array | None = None  # (6,) mm and rad, of the nozzle; None before the first state
    fault: str = ""  # why the robot has stopped by itself
    gone: str = ""  # why the connection has ended


class Franka(ArmDriver):
    """The robot, by its process."""

    def __init__(self, host: str, profile: ArmProfile, listener: ByteListener | None = None) -> None:
        """listener: is told each command as a frame of the S6H4D, the form in which commands are recorded."""
        if profile.flange_from_nozzle is None:
            allowed = "a 4x4 matrix, mm: what hangs on the flange; data/arms/fr3.toml has an example"
            raise InputError("arm file", "flange_from_nozzle", "missing", allowed)
        self._host, self._profile, self._listener = host, profile, listener
        self._process: Any = None
        self._former: tuple[Any, float] | None = None  # the process before, and when it was closed, s
        self._last_state: FrankaState | None = None
        self._patience = FIRST_CONNECT_TIME

    def connect(self, now: float) -> None:
        """Start the process, and see whether it has the robot; only the first call waits for that."""
        if self._former is not None:
            self._reap(now)
        if self._process is None:
            self._states: SharedLatest[FrankaState] = SharedLatest(1 << 16)
            theirs, self._orders = SPAWN.Pipe(duplex=False)
            self._process = SPAWN.Process(target=serve, args=(self._host, self._profile, theirs, self._states))
            self._process.start()
            theirs.close()
        clock, self._last_state = WallClock(), None
        deadline, self._patience = clock.now() + self._patience, 0.0
        while (state := self._states.get()) is None and self._process.is_alive() and clock.now() < deadline:
            clock.wait_until(clock.now() + CONTROL_PERIOD)
        if state is None and self._process.is_alive():
            raise UnpluggedError(f"{SCHEME}{self._host} is being connected to")
        if state is None or state.gone:
            reason = "its process ended" if state is None else state.gone
            self.close()
            raise UnpluggedError(f"{SCHEME}{self._host}: {reason}")

    def state(self, now: float) -> Reported:
        """The newest place."""
        state = self._states.get()
        if state is None or state.gone or not self._process.is_alive():
            raise UnpluggedError(f"{SCHEME}{self._host}: {state.gone if state and state.gone else 'its process ended'}")
        if state is self._last_state or state.axes is None:
            return Reported(now, (), b"", state.fault)
        self._last_state = state
        places = Reply(ReplyKind.PLACE, state.axes[:3]), Reply(ReplyKind.TOOL, state.axes[3:])
        return Reported(state.stamp, places, b"", state.fault)

    def send(self, instruction: G1 | G4, now: float) -> Sequence[Sent]:
        """Hand it to the process."""
        self._send_order((instruction, now))
        if self._listener is not None:
            self._listener(encode(instruction, self._profile.dialect), True)
        return (Sent(instruction),)

    def stop(self, now: float) -> Sequence[Sent]:
        """Have the robot brake as fast as libfranka lets it."""
        self._send_order((STOP, now))
        if self._listener is not None:
            self._listener(encode(Pause(), self._profile.dialect), True)
        return (Sent(Pause()),)

    def enable(self, now: float) -> str:
        """Have the robot recover from a reflex; whether it does, its next states say."""
        self._send_order((ENABLE, now))
        return ""

    def close(self) -> None:
        """Let the process bring the robot to rest and end; nobody waits for that here."""
        if self._process is not None:
            self._orders.close()
            self._former, self._process = (self._process, WallClock().now()), None

    def release(self) -> None:
        """Wait until the process has ended."""
        if self._former is not None:
            self._former[0].join(CLOSE_TIME)
            with suppress(UnpluggedError):
                self._reap(math.inf)

    def _reap(self, now: float) -> None:
        """End the former process once its time is over; UnpluggedError until then."""
        assert self._former is not None
        process, closed = self._former
        if process.is_alive() and now < closed + CLOSE_TIME:
            raise UnpluggedError(f"{SCHEME}{self._host}: its former connection is ended")
        process.kill()
        process.join()
        self._former = None

    def _send_order(self, order: tuple[object, float]) -> None:
        try:
            self._orders.send(order)
        except OSError as error:
            raise UnpluggedError(f"{SCHEME}{self._host}: its process ended") from error


def open_arm(address: str, profile: ArmProfile, listener: ByteListener | None = None) -> Franka:
    """The robot at franka://HOST."""
    host = address.removeprefix(SCHEME).rstrip("/")
    if not host:
        raise InputError("arm", "address", address, f"{SCHEME}HOST, such as {SCHEME}{USUAL_HOSTS[1]}")
    return Franka(host, profile, listener)


def emergency_stop(address: str, profile: ArmProfile) -> tuple[float, str]:
    """Nothing is left to do: the robot's process brakes once the motion process is gone, and ends."""
    return WallClock().now(), ""


def find_arms() -> list[tuple[str, str]]:
    """Controllers at the usual addresses; libfranka knows no search."""
    arms = []
    for host in USUAL_HOSTS:
        with suppress(OSError), socket.create_connection((host, FCI_PORT), FIND_TIME):
            arms.append((f"{SCHEME}{host}", "something answers at libfranka's port"))
    return arms


# -- the robot's own process


def serve(host: str, profile: ArmProfile, orders: Connection, states: SharedLatest[FrankaState]) -> None:
    """Have the robot follow orders until the other end of their pipe is closed; then it is brought to rest."""
    set_up_process("franka", outlives=True)
    ask_for_real_time()
    clock = WallClock()
    try:
        import franky

        kernel = Path("/sys/kernel/realtime").exists()
        realtime = franky.RealtimeConfig.Enforce if kernel else franky.RealtimeConfig.Ignore
        robot = franky.Robot(host, realtime_config=realtime)
        robot.relative_dynamics_factor = DYNAMICS
        follower = FrankaFollower(franky, robot, profile)
        follower.run(orders, states, clock)
    except Exception as error:  # whatever libfranka throws ends the connection, and is told
        states.put(FrankaState(clock.now(), gone=one_line(error)))


def one_line(error: Exception) -> str:
    """An error of libfranka's as one line."""
    return " ".join(str(error).split()) or type(error).__name__


class FrankaFollower:
    """One robot following commands."""

    def __init__(self, franky: Any, robot: Any, profile: ArmProfile) -> None:
        assert profile.flange_from_nozzle is not None
        self._franky, self._robot, self._arm = franky, robot, profile.arm
        self._flange_from_nozzle = profile.flange_from_nozzle
        self._max_speed = float(profile.limits.feed) * 2  # mm/s: what is missing may be caught up with
        self._queue: ArmQueue | None = None  # None: it follows nothing
        self._posture = np.zeros(7)  # rad, of the joints when it set out
        self._stop_time = math.inf  # s, when it was told to stop and has not come to rest
        self._fault, self._last_message, self._robot_time = "", 0.0, -1.0

    def run(self, orders: Connection, states: SharedLatest[FrankaState], clock: WallClock) -> None:
        """Follow `orders` and report the robot's state, until orders end, or the robot is silent for GONE_TIME."""
        next_cycle = self._last_message = clock.now()
        reported = 0.0  # s, the stamp of the last place
        while True:
            messages, closed = take_messages(orders)
            now = clock.now()
            for order, stamp in messages:
                self._take(order, stamp, now)
            if closed:
                self._end(clock)
                return
            axes, ee = self._look(now)
            self._check_motion(now)
            if now - self._last_message > GONE_TIME:
                states.put(FrankaState(now, gone=f"the robot said nothing for {GONE_TIME:g} s"))
                return
            if self._last_message > reported:  # an old place is no answer
                reported = self._last_message
                states.put(FrankaState(reported, axes, self._fault))
            if self._queue is not None and not self._fault:
                self._follow(self._queue, axes, ee, now)
            next_cycle = max(next_cycle + CONTROL_PERIOD, clock.now())
            orders.poll(max(next_cycle - clock.now(), 0.0))

    def _take(self, order: object, stamp: float, now: float) -> None:
        """Enter one order. stamp: s, when it was given."""
        if order == STOP:
            self._queue, self._stop_time = None, now
            self._brake()
        elif order == ENABLE:
            if self._fault or self._robot.has_errors:
                self._robot.recover_from_errors()
            self._fault = ""
        elif isinstance(order, G1 | G4) and not self._fault:
            if self._queue is None:
                if isinstance(order, G4):
                    return
                self._queue, self._stop_time = ArmQueue(self._look(now)[0].tolist(), 0.0, stamp), math.inf
                self._posture = np.asarray(self._robot.state.q)
            self._queue.add(order, stamp)

    def _look(self, now: float) -> tuple[Array, Array]:
        """The nozzle's axes (6,), mm and rad, and the end effector (3,), mm; a wrong posture becomes the fault."""
        state = self._robot.state
        if (robot_time := state.time.to_sec()) != self._robot_time:
            self._robot_time, self._last_message = robot_time, now
        base_from_ee, flange_from_ee = in_mm(state.O_T_EE.matrix), in_mm(state.F_T_EE.matrix)
        base_from_nozzle = base_from_ee @ se3.inverse(flange_from_ee) @ self._flange_from_nozzle
        angles = se3.euler_from_rotation(base_from_nozzle[:3, :3] @ self._arm.arm_from_upright.T)
        if self._queue is not None and not self._fault:
            self._fault = posture_fault(np.asarray(state.q), self._robot.model, state, self._franky)
        return np.concatenate([base_from_nozzle[:3, 3], angles]), base_from_ee[:3, 3]

    def _check_motion(self, now: float) -> None:
        """Check for reflexes, and that a stop is obeyed."""
        try:
            moving = bool(self._robot.poll_motion())
        except Exception as error:  # franky's ControlException names the reflex
            self._queue, self._fault, moving = None, one_line(error), False
        if self._fault and self._queue is not None:
            self._queue, self._stop_time = None, now
            self._brake()
        if not moving:
            self._stop_time = math.inf
        elif now - self._stop_time > STOP_TIME:
            self._stop_time = math.inf
            self._robot.stop()

    def _follow(self, queue: ArmQueue, axes: Array, ee: Array, now: float) -> None:
        """Command the velocity that leads from `axes` (6,), the robot's own, along the queue's commands."""
        begin, end = (np.array(queue.at(t)) for t in (now - LOOK_BACK, now - LOOK_BACK + CONTROL_PERIOD))
        arm_from_begin, arm_from_end, arm_from_now = (
            se3.rotation_from_euler(axes_at[3:]) @ self._arm.arm_from_upright for axes_at in (begin, end, axes)
        )
        turn = se3.log_rotation(arm_from_end @ arm_from_begin.T) / CONTROL_PERIOD
        turn = clipped(turn + GAIN * se3.log_rotation(arm_from_begin @ arm_from_now.T), MAX_TURN_RATE)
        velocity = (end - begin)[:3] / CONTROL_PERIOD + GAIN * (begin - axes)[:3]
        velocity = clipped(velocity, self._max_speed) + np.cross(turn, ee - axes[:3])  # of the end effector
        self._ask(self._joint_velocities(np.concatenate([velocity / 1000, turn])), VELOCITY_TIME)

    def _joint_velocities(self, twist: Array) -> Array:
        """Velocities (7,), rad/s, of the joints for a twist (6,) of the end effector, m/s and rad/s.

        The null space returns the elbow to its posture at the start of the motion.
        """
        state = self._robot.state
        jacobian = np.asarray(self._robot.model.zero_jacobian(self._franky.Frame.EndEffector, state))
        inverse = np.linalg.pinv(jacobian)
        free = np.eye(7) - inverse @ jacobian
        velocities = inverse @ twist + free @ (POSTURE_GAIN * (self._posture - np.asarray(state.q)))
        return np.asarray(velocities * min(1.0, MAX_JOINT_RATE / max(float(np.abs(velocities).max()), 1e-9)))

    def _ask(self, velocities: Array, seconds: float) -> None:
        """Ask for velocities (7,), rad/s, of the joints for so long; after that the robot brakes."""
        time = self._franky.Duration(round(1000 * seconds))
        rounded = np.round(velocities / RATE_STEP) * RATE_STEP
        self._robot.move(self._franky.JointVelocityMotion(rounded, duration=time), asynchronous=True)

    def _brake(self) -> None:
        """Slow down as fast as the limits of acceleration and jerk let it, and leave the robot to itself."""
        with suppress(Exception):  # of a motion that has just ended
            if self._robot.is_in_control:
                self._ask(np.zeros(7), CONTROL_PERIOD)

    def _end(self, clock: WallClock) -> None:
        """Come to rest."""
        self._brake()
        deadline = clock.now() + STOP_TIME
        with suppress(Exception):  # the reflex that ends it, too, is rest
            while self._robot.is_in_control and clock.now() < deadline:
                clock.wait_until(clock.now() + CONTROL_PERIOD)
            if self._robot.is_in_control:
                self._robot.stop()


def in_mm(matrix: Array) -> Array:
    """A pose (4, 4) in metres as one in mm."""
    pose = np.array(matrix)
    pose[:3, 3] *= 1000.0
    return pose


def clipped(vector: Array, max_length: float) -> Array:
    """A vector (3,) no longer than `max_length`."""
    length = float(np.linalg.norm(vector))
    return vector if length <= max_length else vector * (max_length / length)


def posture_fault(joints: Array, model: Any, state: Any, franky: Any) -> str:
    """Why the robot cannot go on from its joints (7,), rad: one is at its end, or it is singular; "" where it can."""
    room = np.minimum(joints - JOINT_LOW, JOINT_HIGH - joints)
    worst = int(np.argmin(room))
    if room[worst] < JOINT_MARGIN:
        angle, limit = math.degrees(room[worst]), math.degrees(JOINT_MARGIN)
        return f"joint {worst + 1} is {angle:.1f} degrees from its end, limit {limit:g}"
    jacobian = np.asarray(model.zero_jacobian(franky.Frame.Flange, state))
    if (manipulability := float(np.sqrt(max(np.linalg.det(jacobian @ jacobian.T), 0.0)))) < MIN_MANIPULABILITY:
        return f"the arm is nearly singular: manipulability {manipulability:.3f}, limit {MIN_MANIPULABILITY:g}"
    return ""
