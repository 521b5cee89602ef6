"""The documents are true: each command in them exists with its options, each link and file leads somewhere."""

from __future__ import annotations

import argparse
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

from hardware.bench.command import subject_parser
from hardware.bench.subjects import SUBJECTS
from hardware.cli import main, parser

ROOT = Path(__file__).parents[1]
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
COMMAND = re.compile(r"`((?:stillbed|make) [^`]+)`|^ {4}((?:stillbed|make) .+)$", re.MULTILINE)
LINK = re.compile(r"\]\(([^)#]+)(?:#[^)]*)?\)")
SHOWN = re.compile(r"^ {4}(stillbed .+)$", re.MULTILINE)


def commands() -> list[tuple[str, str]]:
    """(document, command) of everything that a reader may copy; comments and explanations are cut off."""
    found = []
    for file in DOCUMENTS:
        for quoted, shown in COMMAND.findall(file.read_text(encoding="utf-8")):
            text = re.split(r"\s{2,}|\s#", " ".join(quoted.split()) or shown.strip())[0]
            found.append((file.name, text))
    return sorted(set(found))


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


def options(text: str) -> Iterator[str]:
    yield from re.findall(r"(?<![\w/-])--?[a-zA-Z][\w-]*", text)


@pytest.mark.parametrize(("document", "text"), [c for c in commands() if c[1].startswith("stillbed")])
def test_each_command_and_its_options_exist(document: str, text: str) -> None:
    known = {name for action in leaf(text.split()[1:])._actions for name in action.option_strings}
    assert set(options(text)) <= known, f"{document}: {text}"


def test_each_command_that_is_shown_is_taken_with_its_values() -> None:
    """As it stands there, on a line of its own; the first page's list has placeholders for values."""
    shown = [text for file in DOCUMENTS[1:] for text in SHOWN.findall(file.read_text(encoding="utf-8"))]
    assert len(shown) > 30
    for text in shown:
        words = shlex.split(text, comments=True)[1:]
        if words[0] == "bench" and words[1] in SUBJECTS:
            subject_parser(words[1], SUBJECTS[words[1]]).parse_args(words[2:])
        else:
            parser().parse_args(words)


@pytest.mark.parametrize(("document", "text"), [c for c in commands() if c[1].startswith("make")])
def test_each_make_target_exists(document: str, text: str) -> None:
    targets = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert text.split()[1] in targets, document


@pytest.mark.parametrize("file", DOCUMENTS, ids=lambda file: file.name)
def test_each_link_and_each_file_of_ours_leads_somewhere(file: Path) -> None:
    text = file.read_text(encoding="utf-8")
    for target in LINK.findall(text):
        assert target.startswith("http") or (file.parent / target).exists(), target
    for named in re.findall(r"`((?:estimation|perception|planning|hardware|data|tests)/[\w/.-]+)`", text):
        assert (ROOT / named).exists() or "NAME" in named, named


def test_the_first_page_names_every_command() -> None:
    shown = "\n".join(SHOWN.findall((ROOT / "README.md").read_text(encoding="utf-8")))
    below = next(a for a in parser()._actions if isinstance(a, argparse._SubParsersAction))
    missing = [name for name in below.choices if f"stillbed {name}" not in shown and name != "bench"]
    assert not missing


def test_every_page_can_be_found_from_the_first() -> None:
    linked, left = set(), ["README.md"]
    while left:
        page = left.pop()
        if page in linked:
            continue
        linked.add(page)
        text = (ROOT / page).read_text(encoding="utf-8")
        near = [(ROOT / page).parent / target for target in LINK.findall(text) if target.endswith(".md")]
        named = [ROOT / target for target in re.findall(r"\bdocs/\w+\.md\b", text)]
        left += [target.resolve().relative_to(ROOT).as_posix() for target in near + named]
    assert {f"docs/{file.name}" for file in DOCUMENTS[1:]} <= linked


QUICK = {  # commands of the documents that need no device and no recording, each with a file that it leaves behind
    "stillbed init monday": "monday/session.toml",
    "stillbed calibrate board -o board.pdf": "board.pdf",
    "stillbed bench --list": "",
    "stillbed plan --help": "",
}


@pytest.mark.parametrize("text", QUICK)
def test_commands_that_need_nothing_run_as_they_stand_there(
    text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert text in {command for _, command in commands()}
    monkeypatch.chdir(tmp_path)
    try:
        code = main(shlex.split(text)[1:])
    except SystemExit as ended:
        code = int(ended.code or 0)
    assert code == 0 and (tmp_path / QUICK[text]).exists()
