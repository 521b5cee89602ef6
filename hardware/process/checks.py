"""Reading tables of unknown origin: each value checked as it is taken, each fault one InputError.

A record is read by one table of its keys: the field that each gives, and the check that its value passes, such as
`{"sag_s": ("sag_time", within(0.01, 1000, "s"))}`. The unit in a key's name is the unit of the file's value.
"""

from __future__ import annotations

import csv
import difflib
import io
import itertools
import json
import math
import tomllib
from collections.abc import Callable, Collection, Iterable, Mapping
from enum import Enum
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from estimation.errors import InputError
from estimation.se3 import Array
from perception import CLONE_DATA, INSTALLED_DATA

Table = dict[str, Any]
CsvRow = tuple[int, list[str]]  # line number and cells
Check = Callable[[object, str, object], Any]  # of a file, a key and its value: what a field holds; InputError
Keys = Mapping[str, tuple[str, Check]]  # a table's keys: each with the field that it gives, and its check
Made = TypeVar("Made")
Kind = TypeVar("Kind", bound=Enum)


def read_toml(path: Path) -> Table:
    """The table in a TOML file; InputError where it is missing, empty, not text or not TOML."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, "file", error_text(error), "a readable UTF-8 text file") from error
    return toml_from_text(path, text)


def toml_from_text(where: object, text: str) -> Table:
    """The table in the text of a TOML file; InputError where it is empty or not TOML."""
    if not text.strip():
        raise InputError(where, "file", "empty", "TOML")
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # too long a number, and brackets in brackets, are no syntax errors
        raise InputError(where, "syntax", error, "valid TOML") from error


def error_text(error: Exception) -> str:
    """Why a file cannot be read, in words without the file's name."""
    if isinstance(error, UnicodeDecodeError):
        return f"not text: byte {error.start} is {error.object[error.start]:#04x}"
    return (error.strerror or str(error)).lower() if isinstance(error, OSError) else str(error)


def read_bytes(path: Path) -> bytes:
    """A file's bytes; InputError where it cannot be read."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(path, "file", error_text(error), "a readable file") from error


def read_csv(path: Path, allowed: str = "a readable CSV file", text: str | None = None) -> list[CsvRow]:
    """The rows of a CSV file with their line numbers; blanks before a word do not count, empty lines do.

    text: what the file holds, where it need not be opened. InputError, with `allowed`, where it is missing, not text or
    not CSV.
    """
    try:
        opened = path.open(newline="", encoding="utf-8-sig") if text is None else io.StringIO(text, newline="")
        with opened as stream:
            reader = csv.reader(stream, skipinitialspace=True)
            return [(reader.line_num, row) for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(path, "file", error_text(error), allowed) from error


def csv_columns(
    where: object, rows: Iterable[CsvRow], contents: str, check: Callable[[list[str]], None] | None = None
) -> tuple[list[int], dict[str, list[str]]]:
    """Line numbers of the rows below a header, and the cells of each column, without blanks; empty rows do not count.

    contents: what is allowed instead of nothing. check: refuses a header. InputError for a row that is not as long.
    """
    non_empty = [(line, [word.strip() for word in row]) for line, row in rows if any(map(str.strip, row))]
    if not non_empty:
        raise InputError(where, "file", "empty", contents)
    (_, header), *body = non_empty
    if check is not None:
        check(header)
    for line, row in body:
        if len(row) != len(header):
            raise InputError(where, f"line {line}", f"{len(row)} values", f"{len(header)}, as in the header")
    return [line for line, _ in body], {name: [row[i] for _, row in body] for i, name in enumerate(header)}


def csv_numbers(where: object, lines: Iterable[int], name: str, cells: Iterable[str]) -> Array:
    """The finite numbers (N,) in the cells of a column."""
    out: list[float] = []
    for line, word in zip(lines, cells, strict=True):
        try:
            out.append(float(word))
        except ValueError:
            out.append(math.nan)
        if not math.isfinite(out[-1]):
            raise InputError(where, f"line {line}: {name}", word, "a finite number")
    return np.array(out, float)


def check_keys(where: object, prefix: str, table: Table, required: Iterable[str], optional: Iterable[str] = ()) -> None:
    """InputError for a required key that is not there, or for one that nobody reads."""
    known = list(dict.fromkeys([*required, *optional]))
    for key in table:
        if key not in known:
            raise InputError(where, prefix + key, "unknown key", one_of_text(key, known))
    for key in required:
        if key not in table:
            raise InputError(where, prefix + key, "missing", f"this key ({', '.join(required)} are required)")


def table_fields(where: object, prefix: str, table: Table, keys: Keys) -> dict[str, Any]:
    """What the keys in a table give, by the names of the fields; a key that is left out gives none."""
    return {keys[key][0]: keys[key][1](where, prefix + key, table[key]) for key in table if key in keys}


def record_from_table(
    where: object,
    prefix: str,
    table: Table,
    make: Callable[..., Made],
    keys: Keys,
    required: Iterable[str] = (),
    also: Iterable[str] = (),
) -> Made:
    """The record that `make` makes of a table; its error about a field is one about the key and the file's value.

    also: keys that are read elsewhere.
    """
    check_keys(where, prefix, table, required, [*keys, *also])
    values = table_fields(where, prefix, table, keys)
    with_keys = {field: key for key, (field, _) in keys.items()}
    try:
        return make(**values)
    except InputError as error:
        key = with_keys.get(error.what, error.what)
        got = error.got if isinstance(error.got, str) else table.get(key, error.got)  # a text: the one wrong word
        raise InputError(where, prefix + key, got, error.allowed) from None


def one_of_text(word: str, known: Collection[str]) -> str:
    """The allowed words, the nearest one first by name if there is a near one."""
    matches = difflib.get_close_matches(word, known, 1)
    hint = f"; did you mean {matches[0]!r}?" if matches else ""
    return f"one of {', '.join(known)}{hint}"


MAX_NAMES = 2000  # of a folder that are compared with a name that is not in it


def near_file_text(*names: object) -> str:
    """What may have been meant by the first of some names, if that is a file's and there is none; else ""."""
    for name in names:
        path = Path(str(name))
        try:
            if path.exists():
                continue
            siblings = list(itertools.islice(path.parent.iterdir(), MAX_NAMES)) if path.parent.is_dir() else []
        except (OSError, ValueError):  # a name that no file can have
            continue
        if path.name == str(name) == path.stem:  # a word: no file's name, but perhaps a scenario's
            siblings = []
        matches = difflib.get_close_matches(path.name, [each.name for each in siblings], 1)
        match = str(path.parent / matches[0]) if matches else _shipped_scenario(path.stem)
        if match:
            return f"; did you mean {match!r}?"
    return ""


def _shipped_scenario(stem: str) -> str:
    """A scenario that comes with stillbed whose name is near, as `named_path` finds it; else ""."""
    places = (place / "scenarios" for place in (CLONE_DATA, INSTALLED_DATA))
    matches = difflib.get_close_matches(stem, [each.stem for place in places for each in place.glob("*.toml")], 1, 0.8)
    return f"data/scenarios/{matches[0]}.toml" if matches else ""


def tables(where: object, key: str, value: object) -> list[Table]:
    """A non-empty list of tables, as `[[key]]` gives."""
    if not isinstance(value, list) or not value or not all(isinstance(v, dict) for v in value):
        raise InputError(where, key, value, f"one [[{key}]] table or more")
    return value


def table_at(where: object, prefix: str, table: Table, key: str) -> Table:
    """A table in a table, a copy; empty where it is left out."""
    value = table.get(key, {})
    if not isinstance(value, dict):
        raise InputError(where, prefix + key, value, f"a table [{prefix}{key}]")
    return dict(value)


def text(where: object, key: str, value: object) -> str:
    """A string that is not empty."""
    if not isinstance(value, str) or not value:
        raise InputError(where, key, value, "a text that is not empty")
    return value


def any_text(where: object, key: str, value: object) -> str:
    """A string."""
    if not isinstance(value, str):
        raise InputError(where, key, value, "a text")
    return value


def flag(where: object, key: str, value: object) -> bool:
    """true or false."""
    if not isinstance(value, bool):
        raise InputError(where, key, value, "true or false")
    return value


def word(allowed: Collection[str]) -> Check:
    """The check for one of several words."""

    def check(where: object, key: str, value: object) -> str:
        if not isinstance(value, str) or value not in allowed:
            raise InputError(where, key, value, one_of_text(str(value), allowed))
        return value

    return check


def member(kind: type[Kind]) -> Check:
    """The check for the value of one of an enumeration's members, which it gives."""
    one_of = word([each.value for each in kind])
    return lambda where, key, value: kind(one_of(where, key, value))


def integer(where: object, key: str, value: object, low: int) -> int:
    """A whole number, at least `low`."""
    if not isinstance(value, int) or isinstance(value, bool) or value < low:
        raise InputError(where, key, value, f"a whole number >= {low}")
    return value


def whole(low: int) -> Check:
    """The check for a whole number, at least `low`."""
    return lambda where, key, value: integer(where, key, value, low)


def whole_pair(low: int, high: float, allowed: str) -> Check:
    """The check for two whole numbers from low to high, which may be written 9.0; allowed: what they are."""

    def check(where: object, key: str, value: object) -> tuple[int, int]:
        pair = numbers(where, key, value, (2,), allowed)
        if (pair != pair.round()).any() or (pair < low).any() or (pair > high).any():
            raise InputError(where, key, value, allowed)
        return int(pair[0]), int(pair[1])

    return check


def within(low: float = -math.inf, high: float = math.inf, unit: str = "", open: bool = False) -> Check:
    """The check for a finite number from low (above it where `open`) to high."""

    def check(where: object, key: str, value: object) -> float:
        number_read = float(numbers(where, key, value, (), range_text(low, high, unit, open)))
        if not low <= number_read <= high or (open and number_read == low):
            raise InputError(where, key, value, range_text(low, high, unit, open))
        return number_read

    return check


def pair(low: float = -math.inf, high: float = math.inf, rising: bool = False) -> Check:
    """The check for two finite numbers from low to high; rising: the first above `low` and below the second."""

    def check(where: object, key: str, value: object) -> tuple[float, float]:
        first, second = numbers(where, key, value, (2,)).tolist()
        if rising and not low < first < second:
            raise InputError(where, key, value, f"[low, high], {low:g} < low < high")
        if not (low <= min(first, second) and max(first, second) <= high):
            raise InputError(where, key, value, f"2 numbers, each {range_text(low, high)}")
        return first, second

    return check


def range_text(low: float, high: float, unit: str = "", open: bool = False) -> str:
    """A range of numbers in words."""
    unit = f" {unit}" if unit else ""
    if math.isinf(high):
        return "" if math.isinf(low) else f"above {low:g}{unit}" if open else f"{low:g}{unit} or more"
    if math.isinf(low):
        return f"at most {high:g}{unit}"
    return f"above {low:g}, at most {high:g}{unit}" if open else f"{low:g} to {high:g}{unit}"


def times(check: Check, factor: Array | float) -> Check:
    """The check, and what it gives times a factor: from the file's unit to ours."""
    return lambda where, key, value: check(where, key, value) * factor


def array(shape: tuple[int | None, ...], unit: str = "") -> Check:
    """The check for an array of finite numbers, as `numbers`."""
    return lambda where, key, value: numbers(where, key, value, shape, unit)


def number(where: object, key: str, value: object) -> float:
    """A finite number."""
    return float(numbers(where, key, value, ()))


def numbers(where: object, key: str, value: object, shape: tuple[int | None, ...], unit: str = "") -> Array:
    """A float64 array of finite numbers; None in `shape` stands for any length."""
    size = " x ".join("N" if n is None else str(n) for n in shape)
    allowed = (f"{size} finite numbers" if shape else "a finite number") + (f", {unit}" if unit else "")
    try:
        array = np.array(value) if _all_numbers(value) else None
    except ValueError:
        array = None
    numeric = array is not None and array.ndim == len(shape) and array.dtype.kind in "iuf"
    if array is None or not numeric or not np.isfinite(array).all():
        raise InputError(where, key, value, allowed)
    if any(n not in (None, m) for n, m in zip(shape, array.shape, strict=True)):
        raise InputError(where, key, value, allowed)
    return array.astype(np.float64)


def _all_numbers(value: object) -> bool:
    if isinstance(value, list):
        return all(_all_numbers(v) for v in value)
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def toml_lines(values: Mapping[str, object]) -> list[str]:
    """Keys and values as lines of TOML; what is None is left out."""
    return [f"{key} = {toml_value(value)}" for key, value in values.items() if value is not None]


def toml_value(value: object) -> str:
    """A text, a number, an array or a list of these as TOML; every number with the digits that give it back."""
    if isinstance(value, (np.ndarray, np.number)):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(toml_value, value))}]"
    return repr(value) if isinstance(value, float) else json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
