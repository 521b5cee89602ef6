"""A whole driver, of an arm that takes lines over TCP, MOVE X Y Z A B C FEED and STOP, and answers AT X Y Z A B C.

python docs/examples/own_arm.py HOST PORT      listens for 2 s and tells where the arm stands; see docs/drivers.md
"""

import socket
from typing import Any

import numpy as np

from hardware.arm.console import ArmRequest, run_arm
from hardware.arm.driver import G1, G4, ArmDriver, Pause, Reply, ReplyKind, Reported, Sent, UnpluggedError
from hardware.arm.profile import ArmProfile
from hardware.cli.parser import run_script
from hardware.process.clock import WallClock


class LineArm(ArmDriver):  # mm, rad, mm/s
    def __init__(self, host: str, port: str) -> None:
        self.address, self.rest = (host, int(port)), b""

    def connect(self, now: float) -> None:
        self.line: socket.socket = self.tried(socket.create_connection, self.address, 0.2)
        self.line.setblocking(False)

    def state(self, now: float) -> Reported:
        if (data := self.tried(self.line.recv, 4096)) == b"":
            raise UnpluggedError("the arm has closed the line")
        *lines, self.rest = (self.rest + (data or b"")).split(b"\n")
        places = np.array([line.split()[1:] for line in lines[-1:]], float).reshape(-1, 2, 3)  # none or one
        return Reported(now, [Reply(ReplyKind(half), place[half]) for place in places for half in (0, 1)])

    def send(self, instruction: G1 | G4, now: float) -> list[Sent]:
        if isinstance(instruction, G1):
            self.tried(self.line.sendall, f"MOVE {' '.join(map(str, instruction.axes))} {instruction.feed}\n".encode())
        return [Sent(instruction)]

    def stop(self, now: float) -> list[Sent]:
        self.tried(self.line.sendall, b"STOP\n")
        return [Sent(Pause())]

    def close(self) -> None:
        self.line.close()

    def tried(self, what: Any, *given: object) -> Any:
        try:
            return what(*given)
        except BlockingIOError:
            return None  # nothing has come
        except OSError as error:
            raise UnpluggedError(str(error)) from error


def main(host: str, port: str) -> None:
    run_arm(LineArm(host, port), ArmProfile(dead_time=0.0), ArmRequest(seconds=2.0), WallClock())


if __name__ == "__main__":
    run_script(main, __doc__)
