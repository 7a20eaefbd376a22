"""What the site says about commands and methods comes from the program itself, so that it cannot go stale.

MkDocs calls `on_page_markdown` for every page (see `hooks` in mkdocs.yml); two comments are places to fill.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import os
from typing import Any

from objectflow.cli import VERBS, main
from objectflow.methods.registry import DEFAULT_METHOD, METHODS

COLUMNS = "92"
"""Characters: a line of help fits a page's code block."""


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Fill the places of a page."""
    for mark, make in (("<!-- commands -->", commands), ("<!-- methods -->", methods)):
        if mark in markdown:
            markdown = markdown.replace(mark, make())
    return markdown


def commands() -> str:
    """A section a verb: its summary, its examples, and its help folded away."""
    parts = []
    for name, entry in VERBS.items():
        examples = importlib.import_module(entry.module).EXAMPLES
        lines = "\n".join(line.removeprefix("  ") for line in examples.splitlines())
        options = "\n".join(f"    {line}".rstrip() for line in help_of(name).splitlines())
        parts += [
            f"## `objectflow {name}`\n\n{entry.summary[0].upper()}{entry.summary[1:]}.\n",
            f"```bash\n{lines}\n```\n",
            f'??? info "Every option of `objectflow {name}`"\n\n    ```text\n{options}\n    ```\n',
        ]
    return "\n".join(parts)


def help_of(verb: str) -> str:
    """What `objectflow VERB --help` prints below its examples."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = COLUMNS
    out = io.StringIO()
    try:
        with contextlib.redirect_stdout(out):
            main([verb, "--help"])
    finally:
        if before is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = before
    text = out.getvalue()
    return text[text.index("usage:") :].strip()


def methods() -> str:
    """A table of the methods, the default first."""
    names = [DEFAULT_METHOD, *(name for name in METHODS if name != DEFAULT_METHOD)]
    rows = [f"| `{name}`{' (default)' * (name == DEFAULT_METHOD)} | {METHODS[name].summary} |" for name in names]
    return "\n".join(["| `--method` | |", "|---|---|", *rows])
