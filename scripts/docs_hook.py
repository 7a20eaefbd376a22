"""MkDocs hook that generates the documentation of commands and methods from the program.

MkDocs calls `on_page_markdown` for every page (see `hooks` in mkdocs.yml); two comments are placeholders.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import os
from typing import Any

from objectflow.cli import COMMANDS, main
from objectflow.methods.registry import DEFAULT_METHOD, METHODS

COLUMNS = "92"
"""Width of the help texts, which fits a code block of the site, characters."""


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replace the placeholders of a page."""
    for placeholder, make in (("<!-- commands -->", commands), ("<!-- methods -->", methods)):
        if placeholder in markdown:
            markdown = markdown.replace(placeholder, make())
    return markdown


def commands() -> str:
    """One section per command: its summary, its examples, and its collapsed help."""
    parts = []
    for name, entry in COMMANDS.items():
        examples = importlib.import_module(entry.module).EXAMPLES
        lines = "\n".join(line.removeprefix("  ") for line in examples.splitlines())
        options = "\n".join(f"    {line}".rstrip() for line in help_of(name).splitlines())
        parts += [
            f"## `objectflow {name}`\n\n{entry.summary[0].upper()}{entry.summary[1:]}.\n",
            f"```bash\n{lines}\n```\n",
            f'??? info "All options of `objectflow {name}`"\n\n    ```text\n{options}\n    ```\n',
        ]
    return "\n".join(parts)


def help_of(command: str) -> str:
    """The output of `objectflow COMMAND --help` below its examples."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = COLUMNS
    out = io.StringIO()
    try:
        with contextlib.redirect_stdout(out):
            main([command, "--help"])
    finally:
        if before is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = before
    text = out.getvalue()
    return text[text.index("usage:") :].strip()


def methods() -> str:
    """A table of the methods, with the default first."""
    names = [DEFAULT_METHOD, *(name for name in METHODS if name != DEFAULT_METHOD)]
    rows = [f"| `{name}`{' (default)' * (name == DEFAULT_METHOD)} | {METHODS[name].summary} |" for name in names]
    return "\n".join(["| `--method` | |", "|---|---|", *rows])
