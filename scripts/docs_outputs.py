"""Run the commands that pages show with their output, and write what they print into the pages.

    python scripts/docs_inputs.py FOLDER           # once: what the commands work on
    python scripts/docs_outputs.py FOLDER

A block of a page that starts with `$ ` is run line by line in FOLDER. With `# all but what is fine` after it, a table
of `check-pair` is shown without its rows of that level.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
from pathlib import Path

DOCS = Path(__file__).resolve().parents[1] / "docs"
BLOCK = re.compile(r"(?<=^```text\n)(\$ .*?)(?=^```$)", flags=re.DOTALL | re.MULTILINE)
SHORT = "# all but what is fine"
COLUMNS = "88"
NOT_FOUND = 127
"""What a shell returns for a command that it cannot find."""


def main() -> None:
    """Refresh every page, or those that are named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("pages", nargs="*", type=Path)
    arguments = parser.parse_args()
    for page in arguments.pages or sorted(DOCS.glob("*.md")):
        text = page.read_text()
        fresh = BLOCK.sub(lambda match: refresh(match[0], arguments.folder), text)
        if fresh != text:
            page.write_text(fresh)
            print(f"{page.name} has changed")


def refresh(block: str, folder: Path) -> str:
    """The block with what its commands print now."""
    lines = []
    for line in commands(block):
        lines.append(f"$ {line}")
        lines += output(line, folder)
    return "\n".join(lines) + "\n"


def commands(block: str) -> list[str]:
    """The lines of a block that are typed."""
    return [line[2:] for line in block.splitlines() if line.startswith("$ ")]


def output(line: str, folder: Path) -> list[str]:
    """What a command prints, line by line, without blanks at the ends."""
    environment = os.environ | {"COLUMNS": COLUMNS}
    pipe, both = subprocess.PIPE, subprocess.STDOUT
    # Commands that fail are shown as they fail.
    done = subprocess.run(["bash", "-c", line], check=False, cwd=folder, env=environment, stdout=pipe, stderr=both)
    if done.returncode == NOT_FOUND:
        raise SystemExit(f"{line!r} cannot be run: activate the environment that objectflow is installed in")
    lines = [one.rstrip() for one in done.stdout.decode().strip("\n").splitlines()]
    return without_fine(lines) if line.endswith(SHORT) else lines


def without_fine(lines: list[str]) -> list[str]:
    """A table without its head and without rows of the level `fine`; what is no table stays."""
    kept, keeping = [], True
    for line in lines:
        if "┃" in line or "━" in line:
            continue
        cells = [cell.strip() for cell in line.split("│")]
        if len(cells) == 3 and cells[0]:
            keeping = cells[1] != "fine"
        if keeping or len(cells) != 3:
            kept.append(line)
    return kept


if __name__ == "__main__":
    main()
