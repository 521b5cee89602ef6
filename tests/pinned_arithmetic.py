"""One arithmetic on every x86-64 machine with AVX2 and FMA, so that the same input gives the same bits there.

Libraries choose their loops by the processor that they find: a sum of eight terms at a time rounds otherwise than one
of four. ENVIRONMENT lets each of them take what a Haswell of 2013 has, on newer ones too; it must be set before any of
them is loaded, so what is to be the same runs in a process of its own.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

ROOT = Path(__file__).parents[1]
FEATURES = (
    *("sse", "sse2", "sse3", "ssse3", "sse4.1", "sse4.2", "avx", "avx2", "fma", "f16c"),
    *("bmi", "bmi2", "lzcnt", "movbe", "popcnt", "cx8", "cx16", "cmov", "fxsr", "mmx", "sahf", "xsave"),
)
ENVIRONMENT = {
    "OPENBLAS_CORETYPE": "Haswell",  # numpy's and scipy's, which have a kernel for each kind
    "OPENBLAS_NUM_THREADS": "1",  # products are cut up by how many threads there are
    "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",  # all that numpy has beyond AVX2 and FMA
    "NUMBA_CPU_NAME": "haswell",  # what LLVM makes loops for
    "NUMBA_CPU_FEATURES": ",".join(f"+{name}" for name in FEATURES),
    "PYTHONHASHSEED": "0",
}
PACKAGES = ("numpy", "scipy", "numba", "llvmlite", "gtsam", "toppra", "ruckig")  # gtsam's wheel has one kind of loop


def made_with() -> dict[str, str]:
    """What bits depend on that an environment cannot set: the libraries' versions, Python's, and the C library's."""
    return {
        "python": ".".join(platform.python_version_tuple()[:2]),
        "libc": " ".join(platform.libc_ver()),
        **{name: version(name) for name in PACKAGES},
    }


def unlike(reference: dict[str, str]) -> list[str]:
    """Why bits may differ on this machine from those made with `reference`, in words; none where they must not."""
    from numpy._core._multiarray_umath import __cpu_features__ as found

    here = made_with()
    reasons = [f"{name} is {here[name]}, not {value}" for name, value in reference.items() if here[name] != value]
    if platform.machine() != "x86_64":
        reasons.insert(0, f"the processor is {platform.machine()}, not x86_64")
    elif not (found.get("AVX2") and found.get("FMA3")):
        reasons.insert(0, "the processor has no AVX2 and FMA")
    return reasons


def run_pinned(module: str, arguments: Sequence[str], before: str = "") -> int:
    """`python -m module arguments` in that arithmetic; its exit code. before: statements that are carried out first."""
    program = f"import runpy, sys\n{before}\nsys.argv[1:] = {json.dumps(list(arguments))}\n"
    program += f"runpy.run_module({module!r}, run_name='__main__')"
    environment = {**os.environ, **ENVIRONMENT}
    return subprocess.run([sys.executable, "-c", program], cwd=ROOT, env=environment, check=False).returncode
