"""franky-sim, a Franka FR3 in MuJoCo that speaks libfranka's protocol, as an arm that the laws are tried on.

python -m tests.franka_bench LOG.npy     serves one on 127.0.0.1 until SIGTERM, then writes where its flange truly was

The log is MuJoCo's own pose of the body that carries the flange, of each step, not what the protocol says: rows of
stamp, s of the machine's monotonic clock, x y z, mm, and the quaternion w x y z.
"""

from __future__ import annotations

import os
import signal
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from estimation import se3
from estimation.se3 import Array
from hardware.arm.profile import ArmProfile, open_arm
from hardware.files.arm_file import read_arm
from hardware.process.clock import WallClock
from hardware.process.system import ask_for_real_time
from tests.arm_benches import READY, CounterpartServer, ServedBench

ROOT = Path(__file__).parents[1]
MISSING = "franky and franky_sim are not installed: make counterparts"
HOST = "127.0.0.1"
FLANGE_BODY, HAND_ABOVE_LINK = "robot0_fr3_link7", 0.107  # m of the flange beyond the last link, as in the URDF
START_TIME = 90.0  # s; a busy machine takes a minute


def installed() -> bool:
    return find_spec("franky") is not None and find_spec("franky_sim") is not None


def serve(log: Path) -> None:
    """Serve one robot until SIGTERM; then write the flange's poses."""
    import franky_sim
    from franky_sim.mujoco_simulator import MujocoSimulator

    rows: list[tuple[float, ...]] = []
    clock = WallClock()
    ask_for_real_time()  # a real controller shares no core with us

    class Logged(MujocoSimulator):  # type: ignore[misc]
        def _step(self) -> None:
            super()._step()
            body = self.data.body(FLANGE_BODY)
            rows.append((clock.now(), *body.xpos.tolist(), *body.xquat.tolist()))

    def write(number: int, frame: object) -> None:
        np.save(log, np.array(rows))
        os._exit(0)

    signal.signal(signal.SIGTERM, write)
    with Logged() as simulator:
        simulator.add_robot()
        with franky_sim.SimulationServer(simulator, hostname_candidates=[HOST]) as server:
            print(READY, flush=True)
            server.run_forever()


class FrankaServer(CounterpartServer):
    """franky-sim in a process of its own."""

    def __init__(self, folder: Path) -> None:
        self.log = folder / "flange.npy"
        super().__init__("franky-sim", [sys.executable, "-m", "tests.franka_bench", str(self.log)])

    def truth(self, profile: ArmProfile) -> tuple[Array, Array]:
        """End it; stamps (N,), s, and axes (N, 6) of the nozzle, by where the flange truly was."""
        self.end()
        rows = np.load(self.log)
        return rows[:, 0], axes_from_flange(rows[:, 1:], profile)


def axes_from_flange(rows: Array, profile: ArmProfile) -> Array:
    """Axes (N, 6), mm and rad, of the nozzle by poses (N, 7) of the last link: m, and a quaternion w x y z."""
    w, x, y, z = rows[:, 3:].T
    rotation = np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        -2,
    )
    link = se3.make(rotation, rows[:, :3] * 1000)
    flange = link @ se3.make(np.eye(3), np.array([0, 0, 1000 * HAND_ABOVE_LINK]))
    assert profile.flange_from_nozzle is not None
    nozzle = flange @ profile.flange_from_nozzle
    angles = se3.euler_from_rotation(nozzle[:, :3, :3] @ profile.arm.arm_from_upright.T)
    return np.concatenate([nozzle[:, :3, 3], angles], axis=1)


def fr3() -> ArmProfile:
    return read_arm(ROOT / "data/arms/fr3.toml")


class FrankaBench(ServedBench):
    """The driver of the Franka before franky-sim."""

    tolerance, rest_time, rest_way, silent_time = 0.5, 0.4, 3.0, 0.5

    def __init__(self, folder: Path) -> None:
        self.server, profile = FrankaServer(folder), fr3()
        super().__init__(open_arm(f"franka://{HOST}", profile), profile, WallClock())

    def truth(self) -> tuple[Array, Array]:
        return self.server.truth(self.profile)


if __name__ == "__main__":
    serve(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(tempfile.mkdtemp()) / "flange.npy")
