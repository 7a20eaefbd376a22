"""Fill the page's template: all content is inlined and escaped."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any

_SCRIPTS = (
    *("data.js", "theme.js", "colors.js", "pictures.js", "plots.js"),
    *("gallery.js", "scene.js", "pair.js", "main.js"),
)


def escape(text: object) -> str:
    """Escape text for an element or a quoted attribute; control characters, which HTML forbids, become U+FFFD."""
    return html.escape(re.sub(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f\ud800-\udfff]", "\ufffd", str(text)))


def json_block(name: str, values: Mapping[str, Any]) -> str:
    """A `<script>` element with JSON, which the browser does not execute.

    `<` is escaped, so no text can close the element or open a comment.

    Raises:
        ValueError: a number is not finite.
    """
    text = json.dumps(values, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    return f'<script type="application/json" id="{escape(name)}">{text}</script>'


def assemble(
    parts: Mapping[str, str],
    *,
    template: str = "page.html",
    scripts: Sequence[str] = _SCRIPTS,
    styles: Sequence[str] = ("page.css",),
) -> str:
    """Assemble a page from its HTML parts.

    Args:
        parts: escaped HTML by the name of its placeholder in the template.
        template: file of the page.
        scripts, styles: files that are inlined, in order.
    """
    folder = resources.files(__package__)
    values = {
        **parts,
        "css": "\n".join(_asset(name) for name in styles),
        "three": f"/*\n{licence()}*/\n{_asset('three.min.js')}",
        "script": "\n".join(_asset(name) for name in scripts),
    }
    text = folder.joinpath(template).read_text(encoding="utf-8")
    # A single pass, so that inserted text is not searched for placeholders.
    return re.sub(r"\{\{(\w+)\}\}", lambda match: values[match[1]], text)


def licence() -> str:
    """Licence text of three.js."""
    return _asset("three.LICENSE.txt")


def _asset(name: str) -> str:
    return resources.files(__package__).joinpath(name).read_text(encoding="utf-8")
