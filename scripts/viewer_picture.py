"""Take the picture of the web viewer for the pages: `python scripts/viewer_picture.py` writes docs/images/viewer.png.

It needs Chromium, rerun (extra `view`) and what the tests need. The demo's pair is estimated with `consensus`.
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
PATIENCE = 120.0
"""Seconds for a page that takes long to draw."""


def main() -> None:
    """Estimate, serve, open, take the picture."""
    program = find_chromium()
    if program is None:
        raise SystemExit("no Chromium or Chrome is installed")
    verb = [sys.executable, "-m", "objectflow"]
    with tempfile.TemporaryDirectory() as folder:
        result = Path(folder) / "result"
        subprocess.run([*verb, "estimate", str(PAIR), "--out", str(result)], check=True)
        command = [*verb, "view", str(result), "--frames", str(PAIR), "--web"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
            try:
                assert server.stdout is not None
                address = server.stdout.readline().split()[1]
                with chromium(program, Path(folder) / "profile") as page:
                    page.size(*SIZE)
                    page.call("Page.navigate", url=address)
                    page.wait("document.readyState === 'complete' && document.querySelector('canvas')")
                    picture, end = page.picture(), time.monotonic() + PATIENCE
                    # Drawn when it is rich, and stays the same.
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
    """As a PNG with fewer steps a channel: half as large, and nobody sees it."""
    image = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR) & 0xF8
    cv2.imwrite(str(PICTURE), image | image >> 5, [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    main()
