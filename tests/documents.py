"""What the documents show: the pages, and the commands in them as a reader would copy them."""

from __future__ import annotations

import argparse
import re
from functools import cache
from pathlib import Path

from hardware.bench.subjects import SUBJECTS
from hardware.cli import main

ROOT = Path(__file__).parents[1]
parser, subject_parser = cache(main.parser), cache(main.subject_parser)  # made once for all that is shown
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
PROGRAM = r"(?:stillbed|make|python -m|pip install) "
QUOTED = re.compile(rf"`({PROGRAM}[^`]+)`")
SHOWN = re.compile(rf"^ {{4}}({PROGRAM}.+)$", re.MULTILINE)  # on a line of its own
FENCED = re.compile(r"^```sh\n(.*?)^```$", re.MULTILINE | re.DOTALL)
PADDED = re.compile(r"^(stillbed [a-z]+) {2,7}(?=\S)")  # a list's column of sub-commands


def commands() -> list[tuple[str, str]]:
    """(document, command) of everything that a reader may copy."""
    found = set()
    for file in DOCUMENTS:
        text = file.read_text(encoding="utf-8")
        quoted = [" ".join(words.split()) for words in QUOTED.findall(text)]
        found |= {(file.name, command) for command in [*quoted, *shown(file)]}
    return sorted(found)


def shown(file: Path) -> list[str]:
    """The commands on lines of their own; comments and explanations beside them are cut off."""
    text = file.read_text(encoding="utf-8")
    lines = SHOWN.findall(text) + [line for block in FENCED.findall(text) for line in block.splitlines()]
    return [re.split(r"\s{2,}|\s#", PADDED.sub(r"\1 ", line))[0] for line in lines]


def leaf(words: list[str]) -> argparse.ArgumentParser:
    """The parser of the sub-command that words begin with; a benched subject has its own."""
    if words[:1] == ["bench"] and len(words) > 1 and words[1] in SUBJECTS:
        return subject_parser(words[1], SUBJECTS[words[1]])
    here = parser()
    for word in words:
        below = [a for a in here._actions if isinstance(a, argparse._SubParsersAction)]
        if not below:
            break
        assert word in below[0].choices or word.isupper() or word.startswith("-"), f"no sub-command {word}"
        if word not in below[0].choices:
            break
        here = below[0].choices[word]
    return here
