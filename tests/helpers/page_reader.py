"""Reads a report page: its elements, addresses, texts, table rows and JSON blocks."""

from __future__ import annotations

import json
from html.parser import HTMLParser
from typing import Any

VOID = {"meta", "link", "input", "br", "img"}


class PageReader(HTMLParser):
    """Collects what a page holds; fails on tags that are not closed in order.

    Attributes:
        tags: of all elements.
        addresses: values of attributes that load or link.
        text: outside scripts.
        blocks: JSON by the id of its element.
        rows: text of each cell with `data-column`, by the row's `data-track`.
    """

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self.text = ""
        self.blocks: dict[str, Any] = {}
        self.rows: dict[str, dict[str, str]] = {}
        self._open: list[str] = []
        self._script = self._row = self._column = ""
        self.feed(text)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        self.tags.append(tag)
        if tag not in VOID:
            self._open.append(tag)
        self.addresses += [values[name] for name in ("src", "href", "srcset", "data", "action") if name in values]
        if tag == "tr":
            self._row = values.get("data-track", "")
        if tag == "td":
            self._column = values.get("data-column", "")
        if tag == "script":
            self._script = values.get("id", "") if values.get("type") == "application/json" else ""

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag
        if tag == "td":
            self._column = ""

    def handle_data(self, data: str) -> None:
        if self._open and self._open[-1] == "script":
            if self._script:
                self.blocks[self._script] = json.loads(data)
            return
        self.text += data
        if self._row and self._column:
            cells = self.rows.setdefault(self._row, {})
            cells[self._column] = cells.get(self._column, "") + data
