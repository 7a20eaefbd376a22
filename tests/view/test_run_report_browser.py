"""The report of a run in headless Chromium: it draws its models, its slider moves them, and names run nothing."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest

from browser import Page, chromium, find_chromium
from helpers.run_contents import make_run
from objectflow.view.run_report import write_run_report

RUN = "window.ran=1;document.title='ran';alert('ran')"
PAYLOADS = (
    f"</script><img src=x onerror={RUN}><script>{RUN}</script>",
    f"'\"><svg onload={RUN}><a href=javascript:{RUN} autofocus onfocus={RUN}>",
    f"<!--<script>{RUN}</script>-->{{{{script}}}}${{{RUN}}}`\u2028{RUN}",
    f"</title></style></textarea><iframe srcdoc='<script>parent.{RUN}</script>'></iframe>",
)
"""Names that run a script where a page inserts one of them unescaped."""


def pixels(canvas: str) -> str:
    """JavaScript that returns the colours of a small copy of a canvas."""
    return f"""(() => {{
      const copy = Object.assign(document.createElement('canvas'), {{width: 80, height: 60}});
      const context = copy.getContext('2d', {{willReadFrequently: true}});
      context.drawImage(document.querySelector('{canvas}'), 0, 0, 80, 60);
      return Array.from(context.getImageData(0, 0, 80, 60).data);
    }})()"""


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    program = find_chromium()
    if program is None:
        pytest.skip("no Chromium or Chrome is installed: the report is not opened")
    folder = tmp_path_factory.mktemp("browser")
    run = make_run(folder / "run", title=PAYLOADS[0], notes=PAYLOADS)
    write_run_report(folder / "report.html", replace(run, facts=PAYLOADS))
    with chromium(program, folder / "profile") as page:
        page.size(1280, 900)
        page.open(folder / "report.html")
        page.wait("document.getElementById('scene').dataset.ready")
        yield page


def count_like(values: list[int], color: tuple[int, int, int]) -> int:
    """Number of pixels within 30 levels of a colour."""
    triples = zip(values[::4], values[1::4], values[2::4], strict=True)
    return sum(max(abs(a - b) for a, b in zip(one, color, strict=True)) < 30 for one in triples)


def test_a_model_is_drawn_in_its_colours(page: Page) -> None:
    page.run("document.querySelector('canvas[data-model]').scrollIntoView()")
    page.wait("document.querySelector('canvas[data-model]').dataset.ready")
    assert count_like(list(page.run(pixels("canvas[data-model]"))), (200, 40, 90)) > 200


def test_the_slider_moves_the_objects(page: Page) -> None:
    page.run("document.getElementById('scene').scrollIntoView()")
    after = list(page.run(pixels("#scene")))
    assert count_like(after, (200, 40, 90)) > 4
    assert count_like(after, (90, 90, 90)) > 100  # the background
    assert page.run("document.getElementById('time-words').textContent") == "frame 5, 2.50 s"
    page.run(
        "(() => { const time = document.getElementById('time'); time.value = 0;"
        " time.dispatchEvent(new Event('input')); })()"
    )
    assert page.run("document.getElementById('time-words').textContent") == "frame 0, 0.00 s"
    before = list(page.run(pixels("#scene")))
    assert sum(a != b for a, b in zip(after, before, strict=True)) > 30
    page.click("#tint")
    assert count_like(list(page.run(pixels("#scene"))), (230, 57, 70)) > 4  # the colour of track 1


def test_pictures_are_decoded(page: Page) -> None:
    page.wait("[...document.images].every((image) => image.complete)")
    assert page.run("[...document.images].every((image) => image.naturalWidth > 0)")
    assert page.run("document.images.length") == 8  # 5 and 2 crops, and the last frame


def test_hostile_names_run_nothing(page: Page) -> None:
    page.click("#theme")
    page.click("#play")
    page.click("#play")
    shown = page.run("document.body.textContent")
    assert all(payload in shown for payload in PAYLOADS)
    assert page.run("document.title") == f"objectflow run: {PAYLOADS[0]}"
    assert page.run("document.querySelectorAll('iframe, a[href^=javascript], svg[onload], img[src=x]').length") == 0
    inline = "[...document.querySelectorAll('*')].some((n) => [...n.attributes].some((a) => /^on/.test(a.name)))"
    assert page.run(inline) is False
    assert page.run("window.ran === undefined")
    assert page.errors == []
    assert [one for one in page.requests if not one.startswith(("file:", "data:"))] == []
