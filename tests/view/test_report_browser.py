"""The report in headless Chromium: it opens without errors, shows a pair, and draws it in 3D."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from browser import Page, chromium, find_chromium
from helpers.report_set import estimate_noisy, estimate_zero, make_set
from objectflow.evaluation.results import Evaluation, PairSource
from objectflow.view.report import write_report

PIXELS = """(() => {
  const scene = document.getElementById('scene');
  const copy = Object.assign(document.createElement('canvas'), {width: 80, height: 60});
  const context = copy.getContext('2d', {willReadFrequently: true});
  context.drawImage(scene, 0, 0, 80, 60);
  return Array.from(context.getImageData(0, 0, 80, 60).data);
})()"""


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    program = find_chromium()
    if program is None:
        pytest.skip("no Chromium or Chrome is installed: the report is not opened")
    folder = tmp_path_factory.mktemp("browser")
    write_report(folder / "report.html", *make_set(3))
    with chromium(program, folder / "profile") as page:
        page.size(1280, 900)
        page.open(folder / "report.html")
        yield page


def keys(page: Page) -> list[str]:
    return list(page.run("[...document.querySelectorAll('.card-head button')].map((node) => node.textContent)"))


def choose(page: Page, selector: str, value: str) -> None:
    page.run(
        f"(() => {{ const node = document.querySelector('{selector}'); node.value = '{value}';"
        " node.dispatchEvent(new Event('input')); node.dispatchEvent(new Event('change')); })()"
    )


def test_plots_and_pictures_are_drawn(page: Page) -> None:
    page.run("document.getElementById('gallery').scrollIntoView()")  # Cards are drawn when they scroll into view.
    page.wait("document.querySelectorAll('#cards canvas').length >= 8")
    assert page.run("document.querySelectorAll('#plots svg').length") == 5
    assert page.run("document.querySelectorAll('#plots svg g').length") > 10


def test_pairs_are_sorted_and_filtered(page: Page) -> None:
    both = []
    for order in ("worst", "best"):
        choose(page, "#sort-order", order)
        both.append(keys(page))
    assert sorted(both[0]) == [f"analytic-000{k}" for k in range(3)]
    assert both[0] == both[1][::-1]
    choose(page, "#filter", "0002")
    assert keys(page) == ["analytic-0002"]
    choose(page, "#filter", "")


def test_a_click_shows_a_pair_in_3d_and_switching_changes_the_picture(page: Page) -> None:
    first = keys(page)[0]
    page.click(".card-head button")
    page.wait("document.getElementById('pair').open && document.querySelector('#pair-scores table')")
    assert page.run("document.getElementById('pair-title').textContent") == first
    page.wait(f"new Set({PIXELS}).size > 20")
    truth = page.run(PIXELS)
    # "2" is the first method, which finds nothing: the objects' colours go.
    page.press("2")
    page.wait("document.querySelector('#layer-choice input[value=\"0\"]').checked")
    zero = page.run(PIXELS)
    assert sum(a != b for a, b in zip(truth, zero, strict=True)) > 100
    assert max(abs(a - b) for a, b in zip(zero[::4], zero[1::4], strict=True)) < 30  # grey
    page.press("n")
    page.wait(f"document.getElementById('pair-title').textContent !== '{first}'")
    page.press("Escape", 27)
    page.wait("!document.getElementById('pair').open")


def test_nothing_complained_and_nothing_was_fetched(page: Page) -> None:
    assert page.errors == []
    assert [one for one in page.requests if not one.startswith(("file:", "data:"))] == []


RUN = "window.ran=1;document.title='ran';alert('ran')"
PAYLOADS = (
    f"</script><img src=x onerror={RUN}><script>{RUN}</script>",
    f"'\"><svg onload={RUN}><a href=javascript:{RUN} autofocus onfocus={RUN}>",
    f"javascript:{RUN}//",
    f"<!--<script>{RUN}</script>-->{{{{script}}}}${{{RUN}}}`\u2028{RUN}",
    f"</title></style></textarea><iframe srcdoc='<script>parent.{RUN}</script>'></iframe>",
    "__proto__",
)
"""Names that run a script where a page inserts one of them unescaped; and one that is special in JavaScript."""
WALK = """(async () => {
  const pause = () => new Promise((done) => setTimeout(done, 30));
  for (const node of document.querySelectorAll('details')) node.open = true;
  for (const node of document.querySelectorAll('select'))
    for (const option of node.options) { node.value = option.value; node.dispatchEvent(new Event('change')); }
  for (const node of document.querySelectorAll('*'))
    for (const kind of ['mouseover', 'focus', 'mouseenter']) node.dispatchEvent(new Event(kind, {bubbles: true}));
  for (const node of document.querySelectorAll('#pair input, #method-boxes input, nav a, #cards a')) {
    node.click();
    await pause();
  }
})()"""
"""Uses every control of the page; a link or a handler that a name brought in would run here."""


def hostile_set() -> tuple[Evaluation, PairSource]:
    """An evaluation in which every text that comes from files, folders or options is a payload."""
    methods = {payload: estimate_zero if number % 2 else estimate_noisy for number, payload in enumerate(PAYLOADS)}
    data, reason = PAYLOADS[0], " ".join(PAYLOADS)
    found, source = make_set(2, name=data, methods=methods, failure=reason, fail=(data, f"{data}-0001"))
    facts = tuple(replace(pair, scene=PAYLOADS[1 + k]) for k, pair in enumerate(found.pairs))
    changes = {"split": PAYLOADS[1], "sha256": PAYLOADS[3], "machine": PAYLOADS[2], "version": PAYLOADS[4]}
    return replace(found, pairs=facts, **changes), source


def test_hostile_names_run_nothing(tmp_path: Path) -> None:
    program = find_chromium()
    if program is None:
        pytest.skip("no Chromium or Chrome is installed: the report is not opened")
    found, source = hostile_set()
    write_report(tmp_path / "report.html", found, source)
    with chromium(program, tmp_path / "profile") as page:
        page.size(1280, 900)
        page.open(tmp_path / "report.html")
        page.run("document.getElementById('gallery').scrollIntoView()")
        page.wait("document.querySelectorAll('.card-head button').length == 2")
        page.click(".card-head button")
        page.wait("document.getElementById('pair').open && document.querySelector('#pair-scores table')")
        page.run(WALK)
        # The names are shown as they are.
        assert PAYLOADS[0] in page.run("document.getElementById('pair-title').textContent")
        shown = page.run("document.body.textContent")
        assert all(payload in shown for payload in PAYLOADS)
        assert page.run("document.title") == f"objectflow evaluation: {PAYLOADS[0]}"
        # Nothing of them became an element, a link or a handler.
        assert page.run("document.querySelectorAll('img, iframe, a[href^=javascript], svg[onload]').length") == 0
        inline = "[...document.querySelectorAll('*')].some((n) => [...n.attributes].some((a) => /^on/.test(a.name)))"
        assert page.run(inline) is False
        assert page.run("window.ran === undefined")
        assert page.errors == []
        assert [one for one in page.requests if not one.startswith(("file:", "data:"))] == []
        # The page's policy permits inline handlers, so an unescaped name would have run.
        page.run(f"document.body.insertAdjacentHTML('beforeend', {json.dumps(PAYLOADS[0])})")
        page.wait("window.ran === 1 && document.title === 'ran'")
        assert any("alert dialog: ran" in error for error in page.errors)
