"""What an operator is asked at each stage, and what would be followed there."""

from __future__ import annotations

from hardware.operator.shared_state import Wish
from hardware.operator.view import Stage

RUNNING = (Stage.APPROACH, Stage.PRINT, Stage.HOMING, Stage.PAUSED)  # the arm may move, or is armed
OFFERS = {
    Stage.CHECK: (Wish.END,),
    Stage.FIND: (Wish.END,),
    Stage.CONFIRM: (Wish.CONFIRM, Wish.AGAIN, Wish.END),
    Stage.READY: (Wish.START, Wish.AGAIN, Wish.END),
    Stage.APPROACH: (Wish.PAUSE, Wish.HOME, Wish.END),
    Stage.PRINT: (Wish.PAUSE, Wish.HOME, Wish.END),
    Stage.PAUSED: (Wish.RESUME, Wish.HOME, Wish.END),
    Stage.STOPPED: (Wish.RESUME, Wish.HOME, Wish.END),
    Stage.HOMING: (Wish.END,),
}
QUESTIONS = {
    Stage.CHECK: "Checking cameras, arm, path and recording",
    Stage.FIND: "Looking for the wound and laying the path on it",
    Stage.CONFIRM: "Does the path lie where it should be printed?",
    Stage.READY: "Is nobody within the arm's reach? Then it may start",
    Stage.APPROACH: "The nozzle goes to where printing begins",
    Stage.PRINT: "Printing",
    Stage.PAUSED: "Paused: resume, go home, or end",
    Stage.STOPPED: "Stopped: resume, go home, or end",
    Stage.HOMING: "The arm goes home",
    Stage.DONE: "The path is printed",
    Stage.ENDED: "The run was ended; what is left can be resumed",
    Stage.FAILED: "The run cannot go on; what is left can be resumed",
}
