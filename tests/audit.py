"""`make audit`: asks a public database (PyPI's, by pip-audit) for known vulnerabilities of the pinned versions.

python -m tests.audit PIP_AUDIT    exit code 0: none is known; 1: some are, and listed; 3: nobody could be asked
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

PINS = Path(__file__).parents[1] / "constraints.txt"
OPTIONS = ("--no-deps", "--disable-pip", "--progress-spinner", "off", "--format", "json")  # the pins as they are
NONE, SOME, NOBODY = 0, 1, 3


def told(answer: str, trouble: str) -> tuple[int, str]:
    """Exit code and words of what pip-audit said. answer: its JSON, if it came so far. trouble: its other words."""
    try:
        found = json.loads(answer)["dependencies"]
    except (ValueError, KeyError, TypeError):
        last = trouble.strip().splitlines()[-1:] or ["it said nothing"]
        return NOBODY, f"nothing was checked: the database cannot be asked; is there a network? ({last[0][:200]})"
    skipped = [f"{each['name']}: not checked: {each['skip_reason']}" for each in found if "skip_reason" in each]
    known = [
        f"{each['name']} {each['version']}: {one['id']}, mended in {', '.join(one['fix_versions']) or 'no version yet'}"
        for each in found
        for one in each.get("vulns", [])
    ]
    checked = len(found) - len(skipped)
    if not checked:
        return NOBODY, "\n".join(["nothing was checked:", *skipped])
    head = f"{len(known)} known vulnerabilities" if known else "no known vulnerability"
    return SOME if known else NONE, "\n".join([*known, *skipped, f"{head} in {checked} pins of {PINS.name}"])


def main(program: str) -> int:
    """Ask; the exit code."""
    asked = [program, "--requirement", str(PINS), *OPTIONS]
    try:
        done = subprocess.run(asked, capture_output=True, text=True, check=False)
    except OSError as error:
        code, words = NOBODY, f"nothing was checked: {program}: {error.strerror}"
    else:
        code, words = told(done.stdout, done.stderr)
    print(words)
    return code


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:2]))
