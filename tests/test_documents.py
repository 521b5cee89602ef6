"""The documents are true: each command in them exists with its options, each link and file leads somewhere."""

from __future__ import annotations

import argparse
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

from hardware.bench.subjects import SUBJECTS
from hardware.cli.main import main
from tests.api_links import broken_links
from tests.campaigns.__main__ import CAMPAIGNS
from tests.documents import DOCUMENTS, ROOT, commands, leaf, parser, shown, subject_parser
from tests.shown_commands import COMPLETED, INSTEAD, LONG_KINDS, MADE, NAMES, NOT_RUN, SHORT, to_run

LINK = re.compile(r"\]\(([^)#]+)(?:#[^)]*)?\)")


def options(text: str) -> Iterator[str]:
    yield from re.findall(r"(?<![\w/-])--?[a-zA-Z][\w-]*", text)


@pytest.mark.parametrize(("document", "text"), [c for c in commands() if c[1].startswith("stillbed")])
def test_each_command_and_its_options_exist(document: str, text: str) -> None:
    known = {name for action in leaf(text.split()[1:])._actions for name in action.option_strings}
    assert set(options(text)) <= known, f"{document}: {text}"


def test_each_command_that_is_shown_is_taken_with_its_values() -> None:
    """As it stands there, on a line of its own; the first page's list has placeholders for values."""
    texts = [text for file in DOCUMENTS[1:] for text in shown(file) if text.startswith("stillbed")]
    assert len(texts) > 30
    for text in texts:
        take(shlex.split(text)[1:])


def test_each_campaign_that_is_named_is_taken_with_its_values() -> None:
    made = re.findall(r"(-m tests\.campaigns \w[^#\n]*)", (ROOT / "Makefile").read_text("utf-8"))
    named = [text for _, text in commands() if "-m tests.campaigns " in text] + made
    words = [shlex.split(text.partition("-m tests.campaigns ")[2]) for text in named]
    assert len(words) > 30 and ["--all"] in words
    for subject, *rest in words:
        if subject != "--all":
            subject_parser(subject, CAMPAIGNS[subject]).parse_args(rest)


def take(words: list[str]) -> None:
    """Read a command's words; SystemExit where one of them is not taken."""
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
    listed = "\n".join(shown(ROOT / "README.md"))
    below = next(a for a in parser()._actions if isinstance(a, argparse._SubParsersAction))
    missing = [name for name in below.choices if f"stillbed {name}" not in listed and name != "bench"]
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


def test_each_command_is_run_as_it_stands_or_in_another_way_that_is_told() -> None:
    """By tests/test_examples.py: a new one is run as it stands, with values for its placeholders."""
    texts = {text for _, text in commands()}
    tables = [NAMES, COMPLETED, INSTEAD, NOT_RUN, SHORT]
    told = [text for table in tables for text in table]
    assert len(told) == len(set(told)) and set(told) <= texts
    assert {text for text in texts if text.startswith(LONG_KINDS)} <= set(told), "in what size are these run?"
    runs = {text: run for text in texts if (run := to_run(text)) is not None}
    asked = {word for run in runs.values() for word in run.split() if re.fullmatch(r"[A-Z_]+(\.\w+)?", word)}
    assert not asked, "a placeholder without a value"
    assert set(MADE) <= set(runs.values())
    for name in NAMES:
        assert not leaf(name.split()[1:]).prog.removeprefix(name), name
        assert any(run.startswith(name + " ") for run in runs.values()) or name == "stillbed train", name
    for why in NOT_RUN.values():
        assert all((ROOT / named).is_file() for named in re.findall(r"tests/\w+\.py", why)), why


def test_what_is_run_has_values_that_are_taken() -> None:
    for run in sorted({run for _, text in commands() if (run := to_run(text)) is not None}):
        words = shlex.split(run)
        if words[0] == "stillbed" and "--help" not in words:
            take(words[1:])


QUICK = {  # commands of the documents that need no device and no recording, each with a file that it leaves behind
    "stillbed init monday": "monday/session.toml",
    "stillbed calibrate board -o board.pdf": "board.pdf",
    "stillbed bench --list": "",
    "stillbed plan --help": "",
}


@pytest.mark.parametrize("text", QUICK)
def test_commands_that_need_nothing_run_as_shown(text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert text in {command for _, command in commands()}
    monkeypatch.chdir(tmp_path)
    try:
        code = main(shlex.split(text)[1:])
    except SystemExit as ended:
        code = int(ended.code or 0)
    assert code == 0 and (tmp_path / QUICK[text]).exists()


def test_a_link_of_the_reference_that_leads_nowhere_is_found(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "a.html").write_text('<p id="x"></p><a href="sub/b.html#y">b</a><a href="https://elsewhere">c</a>')
    (tmp_path / "sub" / "b.html").write_text(
        '<p id="y"></p><a href="../a.html#x">a</a><script>"<a href=${u}>"</script>'
    )
    assert list(broken_links(tmp_path)) == []
    (tmp_path / "sub" / "b.html").write_text('<a href="../a.html#z">a</a><a href="c.html">c</a>')
    assert list(broken_links(tmp_path)) == [
        "a.html: sub/b.html#y: no such place", "sub/b.html: ../a.html#z: no such place",
        "sub/b.html: c.html: no such file",
    ]  # fmt: skip
