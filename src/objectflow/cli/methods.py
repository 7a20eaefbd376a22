"""`objectflow methods`: what `--method` can be."""

from __future__ import annotations

from dataclasses import dataclass

from rich.console import Console
from rich.table import Table

from objectflow.methods.registry import DEFAULT_METHOD, METHODS

EXAMPLES = "  objectflow methods\n"


@dataclass(frozen=True)
class Methods:
    """List every method with one line each; the default is marked with a star."""

    def run(self) -> None:
        """Print the table."""
        table = Table(box=None, pad_edge=False, show_header=False)
        for name, entry in METHODS.items():
            table.add_row("*" if name == DEFAULT_METHOD else "", name, entry.summary)
        Console(highlight=False).print(table)
