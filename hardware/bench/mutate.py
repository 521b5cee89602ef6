"""Valid input made wrong in one to four places, as broken disks, other programs and hostile people do."""

from __future__ import annotations

import re

import numpy as np

NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
WORDS = (
    *(b"nan", b"inf", b"-inf", b"1e999", b"-1", b"0", b"1e308", b"-1e-320", b"99999999999999999999", b"1.5", b"0x10"),
    *(b"", b"true", b"[]", b"{}", b"[[]]", b'""', b'"x"', b"[1, 2]", b"null", b"\xff\xfe", b"\x00", b"\xef\xbb\xbf"),
    *(b"[" * 400, b"{" * 400, b'{"a":' * 300, b"9" * 5000, b"\n", b",,,,", b"=", b"2026-01-01", b"../../etc/passwd"),
)
EDGES = (0x00, 0x01, 0x7F, 0x80, 0xFF, 0x0A)
MOST = 4  # places


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """The data with something wrong; it may come out the same, seldom."""
    for _ in range(int(rng.integers(1, MOST + 1))):
        data = CHANGES[int(rng.integers(len(CHANGES)))](data, rng)
    return data


def _place(data: bytes, rng: np.random.Generator) -> int:
    return int(rng.integers(len(data) + 1))


def _span(data: bytes, rng: np.random.Generator) -> tuple[int, int]:
    start = _place(data, rng)
    return start, min(start + int(np.exp(rng.uniform(0, np.log(len(data) + 2)))), len(data))


def _flipped(data: bytes, rng: np.random.Generator) -> bytes:
    if not data:
        return data
    at = int(rng.integers(len(data)))
    return data[:at] + bytes([data[at] ^ (1 << int(rng.integers(8)))]) + data[at + 1 :]


def _set(data: bytes, rng: np.random.Generator) -> bytes:
    at = _place(data, rng)
    return data[:at] + bytes([EDGES[int(rng.integers(len(EDGES)))]]) + data[at + 1 :]


def _cut(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: _place(data, rng)]


def _deleted(data: bytes, rng: np.random.Generator) -> bytes:
    start, end = _span(data, rng)
    return data[:start] + data[end:]


def _doubled(data: bytes, rng: np.random.Generator) -> bytes:
    start, end = _span(data, rng)
    return data[:end] + data[start:end] + data[end:]


def _inserted(data: bytes, rng: np.random.Generator) -> bytes:
    at = _place(data, rng)
    return data[:at] + WORDS[int(rng.integers(len(WORDS)))] + data[at:]


def _renumbered(data: bytes, rng: np.random.Generator) -> bytes:
    """One number, or what looks like one, becomes something else."""
    found = list(NUMBER.finditer(data))
    if not found:
        return _inserted(data, rng)
    one = found[int(rng.integers(len(found)))]
    return data[: one.start()] + WORDS[int(rng.integers(len(WORDS)))] + data[one.end() :]


def _lines(data: bytes, rng: np.random.Generator) -> bytes:
    """Two lines change places, or one is there twice, or no more."""
    lines = data.split(b"\n")
    one, other = rng.integers(len(lines), size=2)
    match int(rng.integers(3)):
        case 0:
            lines[one], lines[other] = lines[other], lines[one]
        case 1:
            lines.insert(int(one), lines[other])
        case _:
            del lines[one]
    return b"\n".join(lines)


CHANGES = (_flipped, _set, _cut, _deleted, _doubled, _inserted, _renumbered, _renumbered, _lines)
