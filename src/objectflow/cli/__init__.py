"""The command line: one module per command, imported only when the command is used."""

from __future__ import annotations

import contextlib
import difflib
import importlib
import io
import os
import re
import signal
import sys
from collections.abc import Sequence
from typing import NamedTuple, Protocol

from objectflow.errors import ObjectflowError, one_line
from objectflow.runtime.memory import keep_freed_memory

EXIT_BAD_INPUT = 2
EXIT_FAILED = 1
EXIT_INTERRUPTED = 130
DEBUG = "OBJECTFLOW_DEBUG"
"""Environment variable that makes internal errors show their traceback."""


class Command(Protocol):
    """A dataclass whose fields are the command's arguments."""

    def run(self) -> None:
        """Execute the command. Raises ObjectflowError for errors that the user can correct."""


class CommandEntry(NamedTuple):
    """Location of a command: a module with `EXAMPLES` (lines to paste) and the dataclass of its arguments.

    `resumes`: the same command continues an interrupted one.
    """

    summary: str
    module: str
    dataclass: str
    resumes: bool = False


COMMANDS: dict[str, CommandEntry] = {
    "estimate": CommandEntry(
        "moving objects and scene flow of one pair of frames", "objectflow.cli.estimate", "Estimate"
    ),
    "run": CommandEntry("the same for all consecutive pairs of a sequence", "objectflow.cli.run", "Run", resumes=True),
    "reconstruct": CommandEntry(
        "the shapes of a run's objects as meshes", "objectflow.cli.reconstruct", "Reconstruct", resumes=True
    ),
    "live": CommandEntry("track objects live, from a camera or a recording", "objectflow.cli.live", "Live"),
    "demo": CommandEntry("the packaged pair, compared with its ground truth", "objectflow.cli.demo", "Demo"),
    "generate": CommandEntry(
        "a simulated data set as Parquet shards", "objectflow.cli.generate", "Generate", resumes=True
    ),
    "check": CommandEntry("check a recording for input errors, or verify a data set", "objectflow.cli.check", "Check"),
    "show": CommandEntry("one row of a data set as a picture", "objectflow.cli.show", "Show"),
    "view": CommandEntry("a result, a run or a data set in the rerun viewer", "objectflow.cli.view", "View"),
    "check-pair": CommandEntry("check two frames for common input errors", "objectflow.cli.check_pair", "CheckPair"),
    "evaluate": CommandEntry(
        "score methods on pairs with ground truth: tables and a report",
        "objectflow.cli.evaluate",
        "Evaluate",
        resumes=True,
    ),
    "export": CommandEntry("a network as an ONNX file", "objectflow.cli.export", "Export"),
    "train": CommandEntry("train a network with a recipe", "objectflow.cli.train", "Train"),
    "methods": CommandEntry("list the methods, one line each", "objectflow.cli.methods", "Methods"),
    "info": CommandEntry("versions, devices and weights", "objectflow.cli.info", "Info"),
    "completion": CommandEntry("tab completion for bash, zsh or fish", "objectflow.cli.completion", "Completion"),
}

EXAMPLES = """\
  objectflow demo
  objectflow estimate PAIR_DIR --out result
  objectflow estimate color0.png depth0.png color1.png depth1.png --intrinsics 615,615,320,240
  objectflow run rgbd_dataset_freiburg1_desk --camera-file fr1 --every 5
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code: 0, 2 for bad input, 1 for other errors, 130 if interrupted."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if arguments is None:
        _exit_on_signals()
    try:
        return _dispatch(words)
    except ObjectflowError as error:
        return _fail(str(error), error.exit_code)
    except KeyboardInterrupt:
        entry = COMMANDS.get(words[0]) if words else None
        again = ": the same command continues" if entry is not None and entry.resumes else ""
        return _fail(f"interrupted{again}", EXIT_INTERRUPTED)
    except BrokenPipeError:
        # The reader of the output (`head`, a pager) has exited; the redirection avoids a second error at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_FAILED
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _fail(f"{where}{error.strerror or error}", EXIT_FAILED)
    except MemoryError:
        return _fail("out of memory: use smaller images", EXIT_FAILED)
    except Exception as error:
        if os.environ.get(DEBUG):
            raise
        return _fail(f"internal error: {type(error).__name__}: {error} ({DEBUG}=1 shows the traceback)", EXIT_FAILED)


def _exit_on_signals() -> None:
    """Remove unfinished folders on SIGTERM, which batch systems send first, and on SIGHUP, as on Ctrl-C."""
    for number in (signal.SIGTERM, signal.SIGHUP):
        # nohup starts a command with SIGHUP ignored, which stays so.
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, lambda received, _: sys.exit(128 + received))


def _dispatch(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help", "help"):
        print(_overview(), end="")
        return 0 if words else EXIT_BAD_INPUT
    if words[0] in ("-V", "--version"):
        from objectflow import __version__

        print(f"objectflow {__version__}")
        return 0
    if words[0] not in COMMANDS:
        near = difflib.get_close_matches(words[0], COMMANDS, n=1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        return _fail(f"unknown command {words[0]!r}: {hint}choose one of {', '.join(COMMANDS)}", EXIT_BAD_INPUT)
    words = split_intrinsics(words)
    entry = COMMANDS[words[0]]
    module = importlib.import_module(entry.module)
    import tyro

    if any(word in ("-h", "--help") for word in words[1:]):
        print(f"Examples:\n{module.EXAMPLES}")
    parser_error = io.StringIO()
    try:
        with contextlib.redirect_stderr(parser_error):
            # The defaults of a command's options may depend on other options.
            default = module.default(words[1:]) if hasattr(module, "default") else None
            command: Command = tyro.cli(
                getattr(module, entry.dataclass), args=words[1:], prog=f"objectflow {words[0]}", default=default
            )
    except SystemExit as error:
        if not error.code:
            return 0
        return _fail(f"{_unboxed(parser_error.getvalue())} (see objectflow {words[0]} --help)", EXIT_BAD_INPUT)
    keep_freed_memory()
    command.run()
    return 0


def split_intrinsics(words: list[str]) -> list[str]:
    """Four intrinsics that are separated by commas, `--intrinsics 615,615,320,240`, as four words."""
    out: list[str] = []
    for word in words:
        name, equals, value = word.partition("=")
        if name == "--intrinsics" and equals:
            out += [name, *value.replace(",", " ").split()]
        elif out and out[-1] == "--intrinsics" and "," in word:
            out += word.replace(",", " ").split()
        else:
            out.append(word)
    return out


def _unboxed(text: str) -> str:
    """The message inside the box drawn by the argument parser, and the first option that it suggests instead."""
    similar = re.search(r"(?:similar to|Perhaps you meant)[^\n]*\n[│\s]*(--[\w.-]+)", text)
    hint = f": did you mean {similar[1]}?" if similar else ""
    lines: list[str] = []
    for line in text.splitlines()[1:]:
        inner = line.strip("│ ")
        if inner.startswith(("──", "╰", "-----")):
            if lines:
                break
            continue
        lines.append(inner)
    # The parser lists None as an alternative of optional arguments; it cannot be typed.
    markup = r"\[/?bold\]|\{None\}\||- <class 'NoneType'>: .*? \('None',\) "
    return re.sub(markup, "", " ".join(lines)) + hint if lines else "invalid arguments"


def _overview() -> str:
    width = max(map(len, COMMANDS))
    commands = "".join(f"  {name:<{width}}  {entry.summary}\n" for name, entry in COMMANDS.items())
    return (
        f"Examples:\n{EXAMPLES}\n"
        "Moving objects, their rigid motions and dense 3D scene flow from two RGB-D frames.\n\n"
        f"Commands (each has --help):\n{commands}"
    )


def _fail(message: str, code: int) -> int:
    """Print a message as one line on stderr, without line breaks, and return the exit code."""
    print(f"objectflow: {one_line(message)}", file=sys.stderr)
    return code
