"""What came of fuzzed inputs, as a CSV file that a later run goes on from."""

from __future__ import annotations

import csv
from pathlib import Path

from estimation.errors import InputError
from hardware.bench.fuzz_try import Block

COLUMNS = ("seed", "reader", "inputs", "refused", "seconds", "number", "wrong")


def append_log(file: Path, seed: int, block: Block) -> None:
    """Add a block to a log, with its header where it is new."""
    new = not file.exists()
    with file.open("a", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        if new:
            writer.writerow(COLUMNS)
        writer.writerow(
            [seed, block.name, block.count, block.refused, f"{block.seconds:.6f}", block.number, block.wrong]
        )


def read_log(file: Path, seed: int) -> list[Block]:
    """The blocks of a run with this seed; InputError where the file is none of ours."""
    found = []
    with file.open(newline="", encoding="utf-8") as stream:
        table = csv.DictReader(stream)
        if tuple(table.fieldnames or ()) != COLUMNS:
            raise InputError(file, "header", table.fieldnames, ",".join(COLUMNS))
        for row in table:
            try:
                own, count, refused, number = (int(row[name]) for name in ("seed", "inputs", "refused", "number"))
                block = Block(row["reader"], count, refused, float(row["seconds"]), row["wrong"], number)
            except (TypeError, ValueError):
                raise InputError(file, f"line {table.line_num}", row, f"{','.join(COLUMNS)}, in numbers") from None
            if own == seed:
                found.append(block)
    return found
