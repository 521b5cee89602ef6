"""Code decides by codes: no word of a reason, a hold or an error is looked for in the product."""

from __future__ import annotations

import ast
import pickle
from collections.abc import Iterator

import pytest

from hardware.arm.device import DONE, LinkCode, Reason
from tests.test_floors import ours

PROSE = {"reason", "reasons", "words", "text", "answer", "message", "said", "trouble", "doubt", "hold", "held", "error"}
SEARCHES = {"startswith", "endswith", "find", "rfind", "index", "count", "partition", "rpartition", "removeprefix"}
MATCHES = {"match", "fullmatch", "search"}
ATTRIBUTES = {"reason", "answer", "said", "allowed"}  # prose, whatever holds it
EXCEPTIONS = {
    "tests/campaigns/detection.py": "measures whether a person is told which camera was knocked, and how",
    "tests/campaigns/mapping.py": "measures whether a person is told which directions a scan leaves open",
    "hardware/bench/live.py": "reads what a run prints, as its user does",
    "hardware/bench/whole.py": "reads what a run prints, as its user does",
    "hardware/live/view.py": "joins a stage's name to its reason, and decides nothing",
}


def is_prose(node: ast.expr) -> bool:
    """Whether an expression is words for a person: the attribute of one, `str` of an error, a reason's own name."""
    if isinstance(node, ast.Attribute):
        return node.attr in ATTRIBUTES or ast.unparse(node) == "error.what"
    if isinstance(node, ast.Call):
        if isinstance(node.func, ast.Attribute) and node.func.attr in ("lower", "upper", "strip", "casefold"):
            return is_prose(node.func.value)
        return isinstance(node.func, ast.Name) and node.func.id == "str" and is_error(node.args)
    return isinstance(node, ast.Name) and node.id in ("reason", "answer", "said", "doubt", "trouble")


def is_error(arguments: list[ast.expr]) -> bool:
    names = [each.id if isinstance(each, ast.Name) else getattr(each, "attr", "") for each in arguments]
    return any(name in PROSE for name in names)


def searched_words(tree: ast.AST) -> Iterator[str]:
    """Tests of what a text of prose says: a word in it, its beginning, a part of it, or a text it equals."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Compare):
            for kind, right in zip(node.ops, node.comparators, strict=True):
                said = isinstance(node.left, (ast.Constant, ast.JoinedStr, ast.Attribute, ast.Name)) and is_prose(right)
                same = is_prose(node.left) and isinstance(right, ast.Constant) and isinstance(right.value or 0, str)
                if (isinstance(kind, ast.In | ast.NotIn) and said) or (isinstance(kind, ast.Eq | ast.NotEq) and same):
                    yield f"line {node.lineno}: {ast.unparse(node)}"
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            of_words = node.func.attr in SEARCHES and is_prose(node.func.value)
            if of_words or (
                node.func.attr in MATCHES and ast.unparse(node.func.value) == "re" and any(map(is_prose, node.args[1:]))
            ):
                yield f"line {node.lineno}: {ast.unparse(node)}"


def test_the_product_decides_nothing_by_words() -> None:
    found = {}
    for module in ours().modules.values():
        if tests := list(searched_words(module.tree)):
            found[module.file] = tests
    assert {file: tests for file, tests in found.items() if file not in EXCEPTIONS} == {}


@pytest.mark.parametrize(
    "bad",
    [
        'if "lock" in str(error): pass',
        'x = tick.command.reason.startswith("the arm is stopped")',
        'x = HOME if "from where" in report.tick.answer else ARM',
        'x = "operator" not in event.reason.lower()',
        'line, _, value = error.what.rpartition(": ")',
        'if reason == "paused": pass',
        'x = re.search("stopped", said)',
    ],
)
def test_the_rule_can_fail(bad: str) -> None:
    assert len(list(searched_words(ast.parse(bad)))) == 1


def test_a_reason_keeps_its_code_on_the_way_to_another_process_and_none_where_nothing_is_said() -> None:
    reason = Reason("enough is under way", LinkCode.FLOW_CONTROL)
    back = pickle.loads(pickle.dumps(reason))
    assert back == reason and back.code is LinkCode.FLOW_CONTROL
    assert not DONE and DONE.code is None and Reason("", LinkCode.FEEDBACK).code is None
    assert type(str(reason)) is str
