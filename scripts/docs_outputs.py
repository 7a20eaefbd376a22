"""Run the commands that the documentation shows with their output, and update the output in the pages.

    python scripts/docs_inputs.py FOLDER           # once: the inputs of the commands
    python scripts/docs_outputs.py FOLDER

Blocks that start with `$ ` are run line by line in FOLDER. A command followed by `# all but what is fine` shows the
table of `check-pair` without the rows of that level.
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
"""Exit status of a shell for a missing command."""


def main() -> None:
    """Refresh all pages, or the given ones."""
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
    """Replace the output of a block's commands by their current output."""
    lines = []
    for line in commands(block):
        lines.append(f"$ {line}")
        lines += output(line, folder)
    return "\n".join(lines) + "\n"


def commands(block: str) -> list[str]:
    """The commands of a block."""
    return [line[2:] for line in block.splitlines() if line.startswith("$ ")]


def output(line: str, folder: Path) -> list[str]:
    """The output of a command as lines without trailing blanks."""
    environment = os.environ | {"COLUMNS": COLUMNS}
    pipe, both = subprocess.PIPE, subprocess.STDOUT
    # Some pages show the output of failing commands.
    done = subprocess.run(["bash", "-c", line], check=False, cwd=folder, env=environment, stdout=pipe, stderr=both)
    if done.returncode == NOT_FOUND:
        raise SystemExit(f"{line!r} cannot be run: activate the environment in which objectflow is installed")
    lines = [printed.rstrip() for printed in done.stdout.decode().strip("\n").splitlines()]
    return without_fine(lines) if line.endswith(SHORT) else lines


def without_fine(lines: list[str]) -> list[str]:
    """Remove the head of a table and its rows of level `fine`; lines outside the table are kept."""
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
