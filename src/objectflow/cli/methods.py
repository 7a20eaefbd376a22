"""`objectflow methods`: the methods, or the settings of one."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Annotated

from rich.console import Console
from rich.table import Table
from tyro.conf import Positional

from objectflow.cli.arguments import option
from objectflow.methods.registry import DEFAULT_METHOD, METHODS, find_class
from objectflow.settings import describe

EXAMPLES = """\
  objectflow methods
  objectflow methods rigidmatch
"""


@dataclass(frozen=True)
class Methods:
    """List the methods (the default is marked with a star), or the settings of one with their defaults."""

    name: Annotated[Positional[str | None], option("NAME", "list the methods")] = None
    """A method whose settings are listed; `--set PATH=VALUE` and TOML files change them."""

    def run(self) -> None:
        """Print the table."""
        if self.name is None:
            table = Table(box=None, pad_edge=False, show_header=False)
            for name, entry in METHODS.items():
                table.add_row("*" if name == DEFAULT_METHOD else "", name, entry.summary)
        else:
            table = Table("setting", "default", "takes", "meaning", box=None, pad_edge=False)
            for one in describe(find_class(self.name)):
                default = one.default if isinstance(one.default, str) else json.dumps(one.default)
                table.add_row(one.path, default, one.kind, one.documentation)
        Console(highlight=False).print(table)
