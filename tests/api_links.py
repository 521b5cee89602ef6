"""`make docs`: the reference of all names from their docstrings, by pdoc, and a look where each of its links leads.

python -m tests.api_links out/api
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from pkgutil import iter_modules
from urllib.parse import unquote, urlsplit

ROOT = Path(__file__).parents[1]
LINK = re.compile(r'<a\b[^>]*\bhref="([^"]*)"')
NAME = re.compile(r'\bid="([^"]*)"')
SCRIPT = re.compile(r"<script\b.*?</script>", re.DOTALL)


def broken_links(folder: Path) -> Iterator[str]:
    """Each link of the pages in a folder that leads to no file of it, or to no place in that file."""
    files = sorted(folder.rglob("*.html"))
    pages = {file.resolve(): SCRIPT.sub("", file.read_text(encoding="utf-8")) for file in files}
    names = {page: set(NAME.findall(text)) for page, text in pages.items()}
    for page, text in pages.items():
        for link in dict.fromkeys(LINK.findall(text)):
            parts = urlsplit(unquote(link))
            if parts.scheme:
                continue
            target = (page.parent / parts.path).resolve() if parts.path else page
            where = page.relative_to(folder.resolve())
            if not target.is_file():
                yield f"{where}: {link}: no such file"
            elif parts.fragment and target in names and parts.fragment not in names[target]:
                yield f"{where}: {link}: no such place"


def build(folder: Path) -> None:
    """Write the pages: all packages and modules but those that need torch, or the system's Python.

    pdoc is looked for in PYTHONPATH.
    """
    own = [f"estimation.{each.name}" for each in iter_modules([str(ROOT / "estimation")])]  # beyond its __all__
    names = [
        "estimation",
        *own,
        "perception",
        "!perception.training",
        "planning",
        "hardware",
        "!hardware.cameras.aravis_process",
    ]
    command = [sys.executable, "-m", "pdoc", "--output-directory", str(folder)]
    subprocess.run([*command, *names], cwd=ROOT, check=True)


def main(folder: Path) -> int:
    """Write the pages and print what is broken; 1 where anything is, or where there are no pages."""
    build(folder)
    count, broken = len(list(folder.rglob("*.html"))), list(broken_links(folder))
    print("\n".join([*broken, f"{count} pages in {folder}, {len(broken)} broken links"]))
    return int(bool(broken) or not count)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
