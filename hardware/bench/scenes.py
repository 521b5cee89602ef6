"""The worlds in which the estimator is measured: movements, conditions, and what is asked of it in each."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from hardware.bench.figures import Target, at_most

APART = 0.016  # s, half a frame period at 30 Hz: webcams are not synchronised


@dataclass(frozen=True, slots=True)
class Scene:
    """One world, but for its seed. conditions: of `estimation.synthetic.conditions`.

    error: target, mm. rigid: whether all is as the model says, so that the error is asked to be near the bound.
    """

    name: str
    movement: str
    conditions: dict[str, Any] = field(default_factory=dict)
    error: Target | None = None
    rigid: bool = False
    surface: str = "patch"

    @property
    def seconds(self) -> float:
        """How long it lasts: offsets are asked to be known after 20 s."""
        return 24.0 if "offsets" in self.conditions else 10.0


CLEAN = tuple(
    Scene(f"{movement}, clean", movement, error=at_most(0.03), rigid=True)
    for movement in ("still", "breathing", "irregular", "shaker", "steps", "turns", "sway", "lively")
)

TROUBLED = tuple(
    Scene(f"breathing, {name}", "breathing", conditions, at_most(limit) if limit else None, rigid)
    for name, conditions, limit, rigid in (
        ("noise 0.5 px", {"noise": 0.5}, 0.0, True),
        ("dropouts 15 %", {"dropouts": 0.15}, 0.03, True),
        ("churn 5 s", {"churn": 5.0}, 0.03, True),
        ("outage 0.4 s", {"outages": ((4.0, 4.4),)}, 0.03, True),
        ("outliers 10 %", {"outliers": 0.1}, 0.03, True),
        ("coherent 20 %", {"coherent": 0.2}, 0.0, False),
        ("correlated 0.6 px", {"correlated": 0.6}, 0.0, False),
        ("offsets 16 ms", {"offsets": (0.0, APART, -APART)}, 0.1, False),
        ("offsets 16, 4, 12 ms", {"offsets": (APART, -0.004, -0.012)}, 0.1, False),
        ("offsets 16 ms, lens 0.3 px", {"offsets": (0.0, APART, -APART), "calibration": 0.3}, 0.1, False),
        ("jitter 5 ms", {"jitter": 0.005}, 0.1, False),
    )
)

SCENES = (
    *CLEAN,
    *TROUBLED,
    Scene("lively, offsets 16 ms", "lively", {"offsets": (0.0, APART, -APART)}, at_most(0.1)),
    Scene("breathing, cube", "breathing", rigid=True, surface="cube"),
)
