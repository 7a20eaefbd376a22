"""The command line: one file a verb, imported only when the verb is used."""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import re
import signal
import sys
from collections.abc import Sequence
from typing import NamedTuple, Protocol

from objectflow.errors import ObjectflowError

EXIT_BAD_INPUT = 2
EXIT_FAILED = 1
EXIT_INTERRUPTED = 130
EXIT_TERMINATED = 143
DEBUG = "OBJECTFLOW_DEBUG"
"""An environment variable: a mistake of objectflow's own shows its traceback."""


class Verb(Protocol):
    """A dataclass whose fields are the verb's arguments; `run` does the work."""

    def run(self) -> None:
        """Do it. Raises ObjectflowError for anything the user can put right."""


class VerbEntry(NamedTuple):
    """Where a verb lives: a module with `EXAMPLES` (lines to paste) and the dataclass of its arguments."""

    summary: str
    module: str
    dataclass: str


VERBS: dict[str, VerbEntry] = {
    "estimate": VerbEntry(
        "moving objects and scene flow of one pair of frames", "objectflow.cli.estimate", "Estimate"
    ),
    "run": VerbEntry("the same for every consecutive pair of a sequence", "objectflow.cli.run", "Run"),
    "live": VerbEntry("follow objects while frames come in", "objectflow.cli.live", "Live"),
    "demo": VerbEntry("the pair that comes with the package, compared with its truth", "objectflow.cli.demo", "Demo"),
    "generate": VerbEntry("a simulated data set as Parquet shards", "objectflow.cli.generate", "Generate"),
    "check": VerbEntry("verify a data set and say what is in it", "objectflow.cli.check", "Check"),
    "show": VerbEntry("one row of a data set as a picture", "objectflow.cli.show", "Show"),
    "view": VerbEntry("a result, a run or a data set in the rerun viewer", "objectflow.cli.view", "View"),
    "check-pair": VerbEntry(
        "what may be wrong with two frames, in plain words", "objectflow.cli.check_pair", "CheckPair"
    ),
    "evaluate": VerbEntry("methods on pairs with truth: tables and a report", "objectflow.cli.evaluate", "Evaluate"),
    "export": VerbEntry("a network as an ONNX file", "objectflow.cli.export", "Export"),
    "train": VerbEntry("train a network by a recipe", "objectflow.cli.train", "Train"),
    "methods": VerbEntry("every method with one line each", "objectflow.cli.methods", "Methods"),
    "info": VerbEntry("versions, devices and weights", "objectflow.cli.info", "Info"),
}

EXAMPLES = """\
  objectflow demo
  objectflow estimate PAIR_DIR --out result
  objectflow estimate color0.png depth0.png color1.png depth1.png --intrinsics 615 615 320 240
  objectflow run rgbd_dataset_freiburg1_desk --camera-file fr1 --every 5
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code: 0, 2 for bad input, 1 for the disk, 130 if interrupted."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if arguments is None:
        # A batch system's polite end: unfinished folders are removed on the way out, as for Ctrl-C.
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(EXIT_TERMINATED))
    try:
        return _dispatch(words)
    except ObjectflowError as error:
        return _fail(str(error), error.exit_code)
    except KeyboardInterrupt:
        return _fail("interrupted", EXIT_INTERRUPTED)
    except BrokenPipeError:
        # The reader of our output (`head`, a pager) has gone. Nothing more can be said, not even at exit.
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
        return _fail(f"internal error: {type(error).__name__}: {error} ({DEBUG}=1 shows where)", EXIT_FAILED)


def _dispatch(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help", "help"):
        print(_overview(), end="")
        return 0 if words else EXIT_BAD_INPUT
    if words[0] in ("-V", "--version"):
        from objectflow import __version__

        print(f"objectflow {__version__}")
        return 0
    if words[0] not in VERBS:
        return _fail(f"unknown command {words[0]!r}: choose one of {', '.join(VERBS)}", EXIT_BAD_INPUT)
    entry = VERBS[words[0]]
    module = importlib.import_module(entry.module)
    import tyro

    if any(word in ("-h", "--help") for word in words[1:]):
        print(f"Examples:\n{module.EXAMPLES}")
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            # A verb may choose its options' defaults by what is typed.
            default = module.default(words[1:]) if hasattr(module, "default") else None
            verb: Verb = tyro.cli(
                getattr(module, entry.dataclass), args=words[1:], prog=f"objectflow {words[0]}", default=default
            )
    except SystemExit as error:
        if not error.code:
            return 0
        return _fail(f"{_unboxed(complaint.getvalue())} (see objectflow {words[0]} --help)", EXIT_BAD_INPUT)
    verb.run()
    return 0


def _unboxed(text: str) -> str:
    """The sentence inside the box that the argument parser draws, up to its first rule."""
    lines = []
    for line in text.splitlines()[1:]:
        inner = line.strip("│ ")
        if inner.startswith(("──", "╰")):
            break
        lines.append(inner)
    # An option that may be left out is a union with None for the parser; nobody who types one means that.
    noise = r"\[/?bold\]|\{None\}\||- <class 'NoneType'>: .*? \('None',\) "
    return re.sub(noise, "", " ".join(lines)) or "arguments that cannot be understood"


def _overview() -> str:
    width = max(map(len, VERBS))
    verbs = "".join(f"  {name:<{width}}  {entry.summary}\n" for name, entry in VERBS.items())
    return (
        f"Examples:\n{EXAMPLES}\n"
        "Moving objects, their rigid motions and dense 3D scene flow from two RGB-D frames.\n\n"
        f"Commands (each has --help):\n{verbs}"
    )


def _fail(message: str, code: int) -> int:
    """One line on stderr, whatever line breaks a message brings from elsewhere."""
    print(f"objectflow: {' '.join(message.split())}", file=sys.stderr)
    return code
