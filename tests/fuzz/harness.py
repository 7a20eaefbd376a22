"""Fuzz every door with mutated inputs: `python tests/fuzz/harness.py --inputs 100000`.

A door may raise one of our errors, with a message of one line of at most 500 characters, and nothing else. It may take
10 seconds and 2 GB, neither print nor warn, and not end the process. Input number N of a door is the same in every run
with the same seed: `--door NAME --first N --inputs 1 --keep FOLDER` makes it again.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import json
import mmap
import os
import random
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from dataclasses import asdict, dataclass
from pathlib import Path
from types import FrameType

os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).parents[1])]

from fuzz.bag_doors import BAG_DOORS
from fuzz.doors import DOORS, Read, prepare, wipe
from objectflow.errors import MAX_MESSAGE, ObjectflowError
from objectflow.readers.sequence import CutOffWarning

ALL_DOORS = {**DOORS, **BAG_DOORS}
MAX_SECONDS = 10.0
"""Processor time of one input."""
MAX_WAIT = 60.0
"""Time of one input in which it may also wait."""
MAX_MEMORY = 2 << 30
"""Bytes that an input may add to the memory of the process."""
CHUNK = 400
"""Inputs of one child process."""


class Hang(BaseException):
    """The time of an input is over."""


@dataclass(frozen=True)
class Finding:
    """An input that broke a rule."""

    door: str
    number: int
    what: str
    where: str


def fuzz(door: str, numbers: range, seed: int, folder: Path) -> list[Finding]:
    """Run some inputs of a door in forked children; a child that dies is a finding, and the next one continues."""
    findings: list[Finding] = []
    first = numbers.start
    while first < numbers.stop:
        stop = min(first + CHUNK, numbers.stop)
        progress = mmap.mmap(-1, 8)
        report = folder / "findings.json"
        report.unlink(missing_ok=True)
        child = os.fork()
        if child == 0:
            _run_chunk(door, range(first, stop), seed, folder, progress, report)
        status = _waited(child, progress)
        if report.is_file():
            findings += [Finding(**entry) for entry in map(json.loads, report.read_text().splitlines())]
        if status == 0:
            first = stop
        else:
            reached = int.from_bytes(progress[:8], "little")
            findings.append(Finding(door, reached, f"the process ended with {os.waitstatus_to_exitcode(status)}", ""))
            first = reached + 1
    return findings


def _waited(child: int, progress: mmap.mmap) -> int:
    """Wait for a child; kill it when native code holds it at one input."""
    last, since = b"", time.monotonic()
    while True:
        found, status = os.waitpid(child, os.WNOHANG)
        if found:
            return status
        if progress[:8] != last:
            last, since = progress[:8], time.monotonic()
        if time.monotonic() - since > 2 * MAX_WAIT:
            os.kill(child, signal.SIGKILL)
        time.sleep(0.02)


def _run_chunk(door: str, numbers: range, seed: int, folder: Path, progress: mmap.mmap, report: Path) -> None:
    code = 1
    try:
        signal.signal(signal.SIGPROF, _over)
        signal.signal(signal.SIGALRM, _over)
        chatter = os.open(folder / "chatter", os.O_RDWR | os.O_CREAT | os.O_TRUNC)
        os.dup2(chatter, 1)
        # Decoders in native code report damage to standard error, which the commands silence.
        kept = os.dup(2)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        with open(report, "w") as out:
            for number in numbers:
                progress[:8] = number.to_bytes(8, "little")
                for finding in run_one(door, number, seed, folder / "input", chatter):
                    out.write(json.dumps(asdict(finding)) + "\n")
                    out.flush()
        code = 0
    except BaseException:
        os.dup2(kept, 2)
        traceback.print_exc()
    finally:
        os._exit(code)


def run_one(door: str, number: int, seed: int, folder: Path, chatter: int) -> list[Finding]:
    """Make and read one input."""
    rng = random.Random(f"{seed}/{door}/{number}")
    read = ALL_DOORS[door](rng, wipe(folder))
    if read is None:
        return []
    os.ftruncate(chatter, 0)
    os.lseek(chatter, 0, os.SEEK_SET)
    before = _reset_peak()
    reasons: list[tuple[str, str]] = []
    try:
        signal.setitimer(signal.ITIMER_PROF, MAX_SECONDS)
        signal.setitimer(signal.ITIMER_REAL, MAX_WAIT)
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            warnings.simplefilter("ignore", CutOffWarning)  # what is left of a bag is read, with this note
            reasons += judged(read)
        reasons += [(f"warns {str(one.message)[:100]}", f"{one.filename}:{one.lineno}") for one in warned[:1]]
    except Hang:
        reasons.append(("hangs", _place(sys.exc_info()[1])))
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.setitimer(signal.ITIMER_REAL, 0)
    added = _peak() - before
    if added > MAX_MEMORY:
        reasons.append((f"takes {added / 1e9:.1f} GB", ""))
    if os.fstat(chatter).st_size:
        reasons.append((f"prints {os.pread(chatter, 200, 0)!r}", ""))
    return [Finding(door, number, what, where) for what, where in reasons]


def judged(read: Read) -> list[tuple[str, str]]:
    """Read an input; what comes out that should not, and where."""
    try:
        read()
    except ObjectflowError as error:
        text = str(error)
        if len(text) > MAX_MESSAGE or len(text.splitlines()) != 1:
            return [("a message that is not one short line", text[:200])]
        if "not enough memory" in text:
            return [("asks for too much memory", text)]
    except Exception as error:
        return [(f"{type(error).__module__}.{type(error).__name__}: {str(error)[:150]}", _place(error))]
    return []


def _place(error: BaseException | None) -> str:
    """The innermost line of objectflow in a traceback."""
    lines = traceback.extract_tb(None if error is None else error.__traceback__)
    ours = [line for line in lines if "/objectflow/" in line.filename]
    return f"{ours[-1].filename.split('/objectflow/')[-1]}:{ours[-1].lineno}" if ours else str(lines[-1:])


def _reset_peak() -> int:
    """Make the peak of this process's memory the present amount, and return it, bytes."""
    with contextlib.suppress(OSError):  # Some containers forbid it: peaks of earlier inputs then count too.
        Path("/proc/self/clear_refs").write_text("5")
    return _peak()


def _peak() -> int:
    """Peak of the resident memory of this process since it was reset, bytes."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:"))


def _over(number: int, frame: FrameType | None) -> None:
    raise Hang


def _print_kinds(findings: list[Finding]) -> None:
    """Print one line for each kind of finding of a door, the most frequent first."""
    kinds = collections.defaultdict(list)
    for finding in findings:
        kinds[finding.what[:70], finding.where].append(finding)
    for (what, where), same in sorted(kinds.items(), key=lambda entry: -len(entry[1])):
        print(f"{len(same):5d}  #{same[0].number}  {what}  {where}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=int, default=3000, help="of all doors together")
    parser.add_argument("--door", action="append", choices=sorted(ALL_DOORS), help="only these doors")
    parser.add_argument("--first", type=int, default=0, help="number of the first input of each door")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="folder in which the last input stays")
    options = parser.parse_args()
    doors = options.door or sorted(ALL_DOORS)
    share = -(-options.inputs // len(doors))
    findings: list[Finding] = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        prepare(wipe(folder / "valid"))
        for door in doors:
            start = resource.getrusage(resource.RUSAGE_CHILDREN)
            found = fuzz(door, range(options.first, options.first + share), options.seed, folder)
            findings += found
            used = resource.getrusage(resource.RUSAGE_CHILDREN)
            seconds = used.ru_utime + used.ru_stime - start.ru_utime - start.ru_stime
            print(f"{door}: {share} inputs, {len(found)} findings, {seconds:.1f} s of processor time")
            _print_kinds(found)
            sys.stdout.flush()
    print(f"{share * len(doors)} inputs, {len(findings)} findings")
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main())
