"""Speed and memory: compiled loops (numba), fast median, cubic spline, heap settings, and modules that are not loaded.

Dozens of short numpy calls a frame cost more than what they compute, so loops over tracks are compiled. Their types are
stated: a loop is compiled once, when its module is first imported, and cached. Other threads run meanwhile.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array

REORDERED_SUMS = {"reassoc", "contract", "nsz"}  # sums may be taken in parts, the same ones every time; nan stays nan
UNUSED_OPEN3D_MODULES = "dash", "plotly", "plotly.graph_objects"  # half of the time that open3d takes to load
TRIM_THRESHOLD, MMAP_THRESHOLD, ARENA_MAX = -1, -3, -8  # glibc's numbers of the options of mallopt

Function = TypeVar("Function", bound=Callable[..., object])


def compiled(signature: str, reordered: bool = False, inlined: bool = False) -> Callable[[Function], Function]:
    """Compile a function for the given types; arrays must be contiguous and writable, as new ones are.

    reordered: whether long sums may be taken several terms at a time, which is many times faster. Runs on one machine
    give the same bits; another kind of processor may round otherwise.
    inlined: whether the code is inlined at each call, which is several times faster for a few operations in a loop.
    """

    from numba import njit  # half a second, which processes without such loops need not spend

    load_scipy()  # as numba does for the first loop

    def decorate(function: Function) -> Function:
        fast = REORDERED_SUMS if reordered else False
        jit = njit(signature, cache=True, nogil=True, error_model="numpy", fastmath=fast, forceinline=inlined)
        return cast(Function, jit(function))

    return decorate


def contiguous(values: NDArray[Any], kind: type = float) -> NDArray[Any]:
    """The array in the layout that compiled functions take, itself if it has it; 20 times as fast as np.require."""
    values = np.asarray(values)
    if values.dtype == kind and values.flags.c_contiguous and values.flags.writeable:
        return values
    return np.require(values, kind, ("C", "W"))


def median(values: Array) -> float:
    """The upper median of values (N,), N > 0, nan if any is: ten times faster than numpy's for some hundreds."""
    if np.isnan(values).any():
        return float("nan")
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle])


class CubicCurve:
    """The cubic spline through values (K, ...) at rising knots (K,), K >= 2, with continuous second derivative.

    As scipy's CubicSpline, of which the motion process would load half a second: "not-a-knot", the first two pieces are
    one cubic and the last two; or `at_rest`, with rate 0 at both ends. Of fewer than four knots it is the polynomial.
    """

    def __init__(self, knots: Array, values: Array, at_rest: bool = False) -> None:
        step = _column(np.diff(knots), values.ndim)
        slope = np.diff(values, axis=0) / step
        rates = _knot_rates(step, slope, at_rest)
        bend = (rates[:-1] + rates[1:] - 2 * slope) / step
        square, cube = (slope - rates[:-1]) / step - bend, bend / step
        self._starts, self._inner = knots[:-1], knots[1:-1]
        self._terms = np.stack([values[:-1], rates[:-1], square, cube, 2 * square, 3 * cube])  # (6, K - 1, ...)

    def __call__(self, at: Array) -> tuple[Array, Array]:
        """Values (T, ...) and their rates (T, ...) at places (T,); outside, of the first and last piece."""
        piece = self._inner.searchsorted(at, "right")
        a, b, c, d, twice_c, thrice_d = self._terms.take(piece, axis=1)
        s = _column(at - self._starts.take(piece), a.ndim)
        square = s * s
        return a + b * s + c * square + d * (square * s), b + twice_c * s + thrice_d * square


def _column(values: Array, axes: int) -> Array:
    """Values (N,) along the first of so many axes."""
    return values.reshape(-1, *[1] * (axes - 1))


def _knot_rates(step: Array, slope: Array, at_rest: bool) -> Array:
    """The rates (K, ...) at the knots, K - 1 steps apart with these slopes (de Boor, A Practical Guide to Splines)."""
    count = len(step) + 1
    diagonal, right = np.ones((count, *step.shape[1:])), np.zeros((count, *slope.shape[1:]))
    below, above = np.zeros_like(step), np.zeros_like(step)
    right[1:-1] = 3 * (step[1:] * slope[:-1] + step[:-1] * slope[1:])
    diagonal[1:-1] = 2 * (step[:-1] + step[1:])
    above[1:], below[:-1] = step[:-1], step[1:]
    if not at_rest and count < 4:
        mean = (step[1:] * slope[:-1] + step[:-1] * slope[1:]) / (step[:-1] + step[1:])
        return np.concatenate([2 * slope[:1] - mean, mean, 2 * slope[-1:] - mean]) if len(mean) else slope[[0, 0]]
    if not at_rest:
        first, last = step[0] + step[1], step[-2] + step[-1]
        diagonal[0], above[0], diagonal[-1], below[-1] = step[1], first, step[-2], last
        right[0] = ((step[0] + 2 * first) * step[1] * slope[0] + step[0] ** 2 * slope[1]) / first
        right[-1] = (step[-1] ** 2 * slope[-2] + (2 * last + step[-1]) * step[-2] * slope[-1]) / last
    for i in range(count - 1):  # no row needs another pivot: the matrix is totally positive
        share = below[i] / diagonal[i]
        diagonal[i + 1] -= share * above[i]
        right[i + 1] -= share * right[i]
    right[-1] /= diagonal[-1]
    for i in reversed(range(count - 1)):
        right[i] = (right[i] - above[i] * right[i + 1]) / diagonal[i]
    return right


class _StubModule(ModuleType):
    """A module in which every name is None."""

    def __getattr__(self, name: str) -> None:
        if name.startswith("__"):
            raise AttributeError(name)


@contextmanager
def stub_modules(*names: str) -> Iterator[None]:
    """Replace modules by empty stubs while a library is imported that does not need them.

    names: full names, parent packages included. Modules loaded before stay as they are.
    """
    stubs = {name: _StubModule(name) for name in names if name not in sys.modules}
    sys.modules.update(stubs)
    parents = [(sys.modules.get(name.rpartition(".")[0]), name.rpartition(".")[2]) for name in stubs]
    for (package, attribute), stub in zip(parents, stubs.values(), strict=True):
        if package is not None:
            setattr(package, attribute, stub)  # as an import does: numpy looks there for its own parts
    try:
        yield
    finally:
        for name in stubs:
            del sys.modules[name]
        for package, attribute in parents:
            if package is not None:
                delattr(package, attribute)


def load_scipy() -> None:
    """Load scipy's core with stubs for numpy's build and test tools: a tenth of a second faster than a plain import."""
    with stub_modules("numpy.f2py", "numpy.testing"):
        import scipy.linalg  # noqa: F401


def trim_heap() -> None:
    """Give free pages of the heap back to the system, where the C library can (glibc's malloc_trim).

    A bundle adjustment takes megabytes for a moment, and small allocations that stay keep them from being given back:
    over 40,000 frame sets a process was measured to grow by 11 MB.
    """
    trim: Callable[[int], int] | None = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def retain_freed_pages(room: int) -> None:
    """Keep up to `room` bytes of freed pages for later allocations, where the C library can (glibc's mallopt).

    Otherwise a process that fills and frees the same few buffers again and again gets new pages each time, which the
    system has to clear: half of the cost of writing pictures.
    """
    _mallopt(MMAP_THRESHOLD, room)
    _mallopt(TRIM_THRESHOLD, room)


def use_one_arena() -> None:
    """Make threads started from now on share one heap, where the C library can (glibc's mallopt).

    Otherwise each thread has a heap of its own, which never shrinks: 26 MB for tracking three cameras, partly used
    again only after hours, which looks like a leak.
    """
    _mallopt(ARENA_MAX, 1)


def _mallopt(option: int, value: int) -> None:
    mallopt: Callable[[int, int], int] | None = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(option, value)
