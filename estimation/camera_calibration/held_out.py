"""How well a rig images a board that it was not calibrated from: stretches of the recording held out in turn.

Lenses, places and clocks are found from the rest; of the stretch itself only the board's poses are, which all cameras
share. A rig whose cameras fit their own views but not each other's shows here.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimation.calibration.lens_model import KnownLenses
from estimation.calibration.rig_fit import RigState, fit_rig
from estimation.camera_calibration.model_choice import folds_of
from estimation.camera_calibration.views import Views
from estimation.se3 import Array

LEAST_VIEWS = 6  # of each camera, that the rest must have: fewer leave its place to the board's drawing


def held_out(
    views: Views, state: RigState, free: NDArray[np.bool_], jitter: float, known: KnownLenses | None = None
) -> Array:
    """Residuals (V, P, 2) px of every view under the rig of the other stretches; nan where those do not hold it.

    state, free, jitter, known: of the fit to all views.
    """
    out = np.full(views.pixels.shape, np.nan)
    folds = folds_of(len(state.base_from_board))[views.instant]
    for fold in range(folds.max() + 1):
        held, cameras = folds == fold, range(len(views.names))
        if min(int((~held & (views.camera == c)).sum()) for c in cameras) < LEAST_VIEWS:
            continue
        rig = fit_rig(views.only(~held), _part(views, state, ~held), free, jitter, known).state
        begin = replace(
            _part(views, state, held), lens=rig.lens, base_from_camera=rig.base_from_camera, offset=rig.offset
        )
        out[held] = fit_rig(views.only(held), begin, np.zeros_like(free), jitter, known).residuals
    return out


def _part(views: Views, state: RigState, kept: NDArray[np.bool_]) -> RigState:
    """The state of the views `kept` (V,)."""
    boards = state.base_from_board[np.unique(views.instant[kept])]
    return replace(state, jitter=state.jitter[kept], base_from_board=boards)
