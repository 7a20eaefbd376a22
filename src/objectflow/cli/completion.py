"""`objectflow completion`: tab completion of commands, options and methods for a shell."""

from __future__ import annotations

import dataclasses
import importlib
import typing
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import tyro
from tyro.conf import Positional

from objectflow.cli.arguments import option
from objectflow.methods.registry import METHODS

EXAMPLES = """\
  objectflow completion bash
  objectflow completion zsh
  objectflow completion fish
"""

BASH = """\
_objectflow() {
  local word="${COMP_WORDS[COMP_CWORD]}" before="${COMP_WORDS[COMP_CWORD-1]}" words
  if [ "$COMP_CWORD" -eq 1 ]; then
    COMPREPLY=($(compgen -W "@commands@" -- "$word")); return
  fi
  case "$before" in --method|--methods) COMPREPLY=($(compgen -W "@methods@" -- "$word")); return ;; esac
  case "${COMP_WORDS[1]}" in
@options@  esac
  case "$word" in -*) COMPREPLY=($(compgen -W "$words" -- "$word")) ;; *) COMPREPLY=($(compgen -f -- "$word")) ;; esac
}
complete -o filenames -o bashdefault -F _objectflow objectflow
"""


@dataclass(frozen=True)
class Completion:
    """Print the script that makes a shell complete commands, options and methods of objectflow with the Tab key.

    Append it to ~/.bashrc or ~/.zshrc, or write it to ~/.config/fish/completions/objectflow.fish.
    """

    shell: Annotated[Positional[Literal["bash", "zsh", "fish"]], option("bash|zsh|fish")]
    """The shell."""

    def run(self) -> None:
        """Print the script."""
        # Imported here, since the table of commands lists this one.
        from objectflow.cli import COMMANDS

        options = {name: option_names(_command_class(name)) for name in COMMANDS}
        if self.shell == "fish":
            print(_fish(options), end="")
            return
        cases = "".join(f'    {name}) words="{" ".join(words)}" ;;\n' for name, words in options.items())
        script = BASH.replace("@commands@", " ".join(options)).replace("@methods@", " ".join(METHODS))
        script = script.replace("@options@", cases)
        start = "autoload -U +X bashcompinit && bashcompinit\n" if self.shell == "zsh" else ""
        print(start + script, end="")


def option_names(command: type[Any]) -> list[str]:
    """The options of a command's dataclass, as typed."""
    hints = typing.get_type_hints(command, include_extras=True)
    out = ["--help"]
    for field in dataclasses.fields(command):
        if tyro.conf.Positional in typing.get_args(hints[field.name]) or dataclasses.is_dataclass(field.default):
            continue
        name = field.name.replace("_", "-")
        out += [f"--{name}", f"--no-{name}"] if field.default is True else [f"--{name}"]
    return out


def _command_class(name: str) -> type[Any]:
    from objectflow.cli import COMMANDS

    entry = COMMANDS[name]
    found: type[Any] = getattr(importlib.import_module(entry.module), entry.dataclass)
    return found


def _fish(options: dict[str, list[str]]) -> str:
    lines = [f"complete -c objectflow -n __fish_use_subcommand -a {name}" for name in options]
    for name, words in options.items():
        here = f"complete -c objectflow -n '__fish_seen_subcommand_from {name}'"
        for word in words:
            values = f" -x -a '{' '.join(METHODS)}'" if word in ("--method", "--methods") else ""
            lines.append(f"{here} -l {word.removeprefix('--')}{values}")
    return "\n".join(lines) + "\n"
