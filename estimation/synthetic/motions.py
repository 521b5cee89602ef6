"""How the surface moves: parts, each a displacement of its own, composed in order; all exact functions of time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from estimation import se3
from estimation.se3 import Array
from estimation.synthetic.waveforms import Waveform

FRAMES_PER_S = 29.91  # of the camera over the thesis's shaking table (thesis 4.6)


class Part(Protocol):
    """One displacement: a rotation vector about a pivot and a shift, each a smooth function of time."""

    @property
    def pivot(self) -> Array:
        """Point (3,), mm, in the rest frame that the rotation leaves where it is."""
        ...

    def coordinates(self, times: Array) -> Array:
        """Rotation vector and shift (N, 6), rad and mm, at times (N,), s."""
        ...

    def rates(self, times: Array) -> Array:
        """Derivatives (N, 6) of the coordinates, 1/s."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Driven:
    """Waveforms, each along a direction. directions: (W, 6) [rx ry rz tx ty tz], rad and mm at 1. pivot: (3,) mm.

    from_start: whether the coordinates are counted from where they are at 0 s.
    """

    waveforms: tuple[Waveform, ...]
    directions: Array
    pivot: Array
    from_start: bool = False

    def coordinates(self, times: Array) -> Array:
        """Rotation vector and shift (N, 6), rad and mm."""
        values = self._values(times)
        return weighed(values - self._values(np.zeros(1)) if self.from_start else values, self.directions)

    def rates(self, times: Array) -> Array:
        """Their derivatives (N, 6)."""
        return weighed(np.stack([w.rate(times) for w in self.waveforms], axis=-1), self.directions)

    def _values(self, times: Array) -> Array:
        return np.stack([w(times) for w in self.waveforms], axis=-1)


@dataclass(frozen=True, slots=True)
class Motion:
    """Displacement of the surface from its rest pose: base_from_surface = base_from_rest @ motion(times)."""

    parts: tuple[Part, ...]

    def __call__(self, times: ArrayLike) -> Array:
        """rest_from_surface (..., 4, 4), mm, at times (...), s."""
        flat, shape = _flat(times)
        out = np.broadcast_to(np.eye(4), (len(flat), 4, 4))
        for part in self.parts:
            out = out @ _transform(part.coordinates(flat), part.pivot)
        return np.array(out).reshape(*shape, 4, 4)

    def twist(self, times: ArrayLike) -> Array:
        """Body velocity (..., 6) of the surface, rad/s and mm/s, at times (...), s: exact, part by part."""
        flat, shape = _flat(times)
        out = np.zeros((len(flat), 6))
        for part in self.parts:
            coordinates = part.coordinates(flat)
            carry = se3.adjoint(se3.inverse(_transform(coordinates, part.pivot)))
            out = (carry @ out[..., None])[..., 0] + _body_twist(coordinates, part.rates(flat), part.pivot)
        return out.reshape(*shape, 6)


def weighed(values: Array, directions: Array) -> Array:
    """values (N, W) @ directions (W, 6), added up in one order whatever N is: an instant alone gives the same bits."""
    return np.asarray((values[:, :, None] * directions).sum(axis=1))


def _flat(times: ArrayLike) -> tuple[Array, tuple[int, ...]]:
    array = np.asarray(times, float)
    return array.reshape(-1), array.shape


def _transform(coordinates: Array, pivot: Array) -> Array:
    rotation = se3.exp_rotation(coordinates[:, :3])
    return se3.make(rotation, coordinates[:, 3:] + pivot - rotation @ pivot)


def _body_twist(coordinates: Array, rates: Array, pivot: Array) -> Array:
    """Twist (N, 6) of x -> R (x - pivot) + pivot + shift, R = exp(w): [omega, R^T shift' - omega x pivot].

    omega is w' times the right Jacobian of SO(3) at w, which is the left one at -w (Barfoot 2017, 7.1.5).
    """
    w, w_rate = coordinates[:, :3], rates[:, :3]
    omega = se3.exp(np.concatenate([-w, w_rate], axis=-1))[:, :3, 3]  # exp shifts by the left Jacobian of w
    rotation = se3.exp_rotation(w)
    shift = np.squeeze(np.swapaxes(rotation, -1, -2) @ rates[:, 3:, None], -1)
    return np.concatenate([omega, shift - np.cross(omega, pivot)], axis=-1)


def shaking_amplitude(mm_per_frame: float, rate_hz: float, frames_per_s: float = FRAMES_PER_S) -> float:
    """Amplitude, mm, of a sine that goes so far between two frames on average.

    The thesis (4.6) states its shaking table by the distance per frame of a 29.91 fps camera: 0.08 mm at 0.1 Hz and
    0.47 mm at 0.5 Hz. A sine of amplitude A goes 4 A in a cycle, 4 A rate / fps in a frame; so A = 5.98 mm and 7.03 mm.
    Read as the largest distance (2 pi A rate / fps) they would be 3.81 mm and 4.47 mm; no reading makes the two equal.
    """
    return mm_per_frame * frames_per_s / (4 * rate_hz)
