"""Take the screenshot of the web viewer for the documentation: `python scripts/viewer_picture.py`.

Writes docs/images/viewer.png with the result of the default method on the demo pair. Needs Chromium, rerun (extra
`view`) and the extra `test`.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from browser import chromium, find_chromium

ROOT = Path(__file__).resolve().parents[1]

PAIR = ROOT / "src" / "objectflow" / "demo" / "pair"
PICTURE = ROOT / "docs" / "images" / "viewer.png"
SIZE = (1100, 660)
TIMEOUT = 120.0
"""Longest wait for the page to be drawn, seconds."""


def main() -> None:
    """Estimate, serve, open, take the screenshot."""
    program = find_chromium()
    if program is None:
        raise SystemExit("no Chromium or Chrome is installed")
    program_words = [sys.executable, "-m", "objectflow"]
    with tempfile.TemporaryDirectory() as folder:
        result = Path(folder) / "result"
        subprocess.run([*program_words, "estimate", str(PAIR), "--out", str(result)], check=True)
        command = [*program_words, "view", str(result), "--frames", str(PAIR), "--web"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
            try:
                assert server.stdout is not None
                address = server.stdout.readline().split()[1]
                with chromium(program, Path(folder) / "profile") as page:
                    page.size(*SIZE)
                    page.call("Page.navigate", url=address)
                    page.wait("document.readyState === 'complete' && document.querySelector('canvas')")
                    picture, end = page.picture(), time.monotonic() + TIMEOUT
                    # The page is complete when the screenshot is large and does not change any more.
                    while time.monotonic() < end:
                        time.sleep(5)
                        last, picture = picture, page.picture()
                        if last == picture and len(picture) > 200_000:
                            break
            finally:
                server.send_signal(signal.SIGINT)
    write_small(picture)
    print(f"{PICTURE.relative_to(ROOT)}: {os.path.getsize(PICTURE)} bytes")


def write_small(picture: bytes) -> None:
    """Write the screenshot as a PNG with 5 bits per channel, which halves its size without visible loss."""
    image = np.asarray(cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR), dtype=np.uint8) & 0xF8
    cv2.imwrite(str(PICTURE), image | image >> 5, [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    main()
