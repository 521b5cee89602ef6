"""The pytest plugin: a fixture that makes a synthetic world in one line; pytest loads it by its entry point."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from estimation.synthetic.world import World


@pytest.fixture(scope="session")
def synthetic_world() -> Callable[..., World]:
    """`estimation.synthetic.world.synthetic_world`: trajectory, rig, landmarks, pixels and noise in one line."""
    from estimation.synthetic.world import synthetic_world as make_world  # pytest starts as fast as without this plugin

    return make_world
