"""The report of an evaluation: numbers, escaping, pair data, and atomic writing."""

from __future__ import annotations

import base64
import json
import math
import zlib
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.report_set import MemorySource, estimate_noisy, make_set
from objectflow.errors import ResultError, StorageError
from objectflow.evaluation.tables.tables import make_tables
from objectflow.storage import files
from objectflow.view.report import write_report
from objectflow.view.report_page.choice import choose_pairs, rank_pairs
from objectflow.view.report_page.packing import NO_FLOW, millimetres, pack_words
from objectflow.view.report_page.pair_block import MAX_POINTS

VOID = {"meta", "link", "input", "br", "img"}
NASTY = "</script><script>alert(1)</script><!-- <b>&amp; \"quoted\" 'name'"


class Reader(HTMLParser):
    """Collects addresses, table cells and JSON blocks of a page; fails on tags that are not closed in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.addresses: list[str] = []
        self.cells: dict[tuple[str, str, str], tuple[dict[str, float], str]] = {}
        self.blocks: dict[str, Any] = {}
        self.tags: list[str] = []
        self.text = ""
        self._table = self._method = self._script = ""
        self._cell: tuple[str, str, str] | None = None
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        self.tags.append(tag)
        if tag not in VOID:
            self.open.append(tag)
        self.addresses += [values[name] for name in ("src", "href", "srcset", "data", "action") if name in values]
        if tag == "table":
            self._table = values.get("id", "").removeprefix("table-")
        elif tag == "tr":
            self._method = values.get("data-method", "") if values.get("class") != "paper" else ""
        elif tag == "td" and self._method:
            self._cell = (self._table, self._method, values["data-column"])
            exact = {name[5:]: float(value) for name, value in values.items() if name[5:] in ("value", "low", "high")}
            self.cells[self._cell] = (exact, "")
        elif tag == "script":
            self._script = values.get("id", "") if values.get("type") == "application/json" else ""

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag
        if tag == "td":
            self._cell = None

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "script":
            if self._script:
                self.blocks[self._script] = json.loads(data)
            return
        self.text += data
        if self._cell is not None:
            exact, shown = self.cells[self._cell]
            self.cells[self._cell] = (exact, shown + data)


@pytest.fixture(scope="module")
def small() -> tuple[Any, MemorySource]:
    return make_set(4, fail=("noisy", "analytic-0002"), failure=NASTY)


@pytest.fixture(scope="module")
def page(small: tuple[Any, MemorySource], tmp_path_factory: pytest.TempPathFactory) -> Reader:
    path = tmp_path_factory.mktemp("report") / "report.html"
    write_report(path, *small)
    return Reader(path.read_text(encoding="utf-8"))


def test_every_number_of_the_tables_is_in_the_page(small: tuple[Any, MemorySource], page: Reader) -> None:
    tables = [table for table in make_tables(small[0]).tables if "-by-" not in table.name]
    assert {"scene-flow", "segmentation", "motions"} <= {table.name for table in tables}
    summary = small[0].method("zero").summary
    exact, shown = page.cells["scene-flow", "zero", "epe_masked"]
    assert exact["value"] == summary.flow_masked.epe_cm.value
    assert (exact["low"], exact["high"]) == summary.flow_masked.epe_cm[1:]
    assert shown.startswith(f"{exact['value']:.2f} ±")
    assert page.cells["segmentation", "noisy", "f"][0]["value"] == small[0].method("noisy").summary.mean_f.f.value
    count = 0
    for table in tables:
        for row in table.rows:
            if row.origin == "paper":
                continue
            for column in table.columns:
                cell = row.cells[column.name]
                known = {part: getattr(cell, part) for part in ("value", "low", "high")}
                finite = {part: value for part, value in known.items() if math.isfinite(value)}
                assert page.cells[table.name, row.label, column.name][0] == finite
                count += 1
    assert count > 40


def test_scores_of_pairs_and_breakdowns_are_the_evaluations(small: tuple[Any, MemorySource], page: Reader) -> None:
    report = page.blocks["report-data"]
    ids = [metric["id"] for metric in report["metrics"]]
    assert [method["name"] for method in report["methods"]] == ["zero", "noisy"]
    for pair in report["pairs"]:
        for method, scores in zip(small[0].methods, pair["scores"], strict=True):
            score = method.score(pair["key"])
            if score is None:
                assert scores is None
                continue
            assert scores[ids.index("mean_f")] == score.segmentation.mean_f.f
            assert scores[ids.index("epe_masked")] == score.flow.masked.epe_cm
    by_number = next(entry for entry in report["breakdowns"] if entry["name"] == "objects in the image")
    seen = [sum(obj.in_both for obj in pair.objects) for pair in small[0].pairs]
    few = sum(count for count, pair in zip(seen, small[0].pairs, strict=True) if pair.number < 4)
    assert by_number["counts"][:2] == [f"n={few}", f"n={sum(seen) - few}"]
    assert set(by_number["values"]) == {plot["id"] for plot in report["plots"]} == {"f", "epe"}


def test_the_page_loads_nothing(page: Reader) -> None:
    assert [address for address in page.addresses if not address.startswith(("#", "data:"))] == []
    assert "alert" not in page.tags
    assert "3D views: three.js" in page.text


def test_texts_are_escaped(small: tuple[Any, MemorySource], tmp_path: Path) -> None:
    plain = tmp_path / "plain.html"
    write_report(plain, *small)
    nasty = make_set(2, methods={NASTY: estimate_noisy}, name=NASTY, fail=(NASTY, f"{NASTY}-0001"), failure=NASTY)
    path = tmp_path / "nasty.html"
    write_report(path, *nasty)
    reader = Reader(path.read_text(encoding="utf-8"))
    # Two scripts less because of two pairs less; no name was parsed as an element.
    assert reader.tags.count("script") == Reader(plain.read_text(encoding="utf-8")).tags.count("script") - 2
    assert reader.tags.count("b") == 0
    assert reader.blocks["report-data"]["methods"][0]["name"] == NASTY
    assert reader.blocks["report-data"]["pairs"][0]["key"] == f"{NASTY}-0000"
    assert f"{NASTY}-0001: {NASTY}" in reader.text
    assert ("scene-flow", NASTY, "epe_all") in reader.cells


def unpack(text: str) -> np.ndarray[Any, np.dtype[np.int16]]:
    """The inverse of `pack_words`, implemented as in the page's script."""
    data = zlib.decompress(base64.b64decode(text))
    half, last, values = len(data) // 2, 0, []
    for low, high in zip(data[:half], data[half:], strict=True):
        last = (last + low + 256 * high) % 65536
        values.append(last - 65536 if last >= 32768 else last)
    return np.array(values, dtype=np.int16)


def test_packed_words_round_trip() -> None:
    rng = np.random.default_rng(0)
    values = rng.integers(-32768, 32768, (3, 7), dtype=np.int16)
    np.testing.assert_array_equal(unpack(pack_words(values)), values.ravel())
    smooth = np.arange(20_000, dtype=np.int16)
    assert len(pack_words(smooth)) < 200


def test_millimetres_mark_missing_flow() -> None:
    flow = np.array([[[0.001, -0.0026, 0.1], [np.nan, 0, 0], [1e9, -1e9, 0]]], dtype=np.float32)
    packed = millimetres(flow, np.array([[True, True, True]]))
    assert packed[:, 0].T.tolist() == [[1, -3, 100], [NO_FLOW] * 3, [32767, -32767, 0]]
    hidden = millimetres(flow, np.array([[True, False, True]]))
    assert hidden[:, 0, 1].tolist() == [1, -3, 100]  # Never shown, so the preceding value is repeated.


def test_a_pair_block_holds_points_flow_and_masks(small: tuple[Any, MemorySource], page: Reader) -> None:
    evaluation, source = small
    block = page.blocks["pair-data-1"]
    pair = source.pair(evaluation.pairs[1].key)
    columns, rows = block["grid"]
    stride, offset = block["stride"], block["offset"]
    assert columns * rows <= MAX_POINTS
    depth = unpack(block["depth"]).view(np.uint16).reshape(rows, columns) * block["depth_step"]
    np.testing.assert_allclose(depth, pair.curr.depth[offset::stride, offset::stride], atol=block["depth_step"])
    truth, zero, noisy = block["layers"]
    assert [layer["method"] for layer in block["layers"]] == [-1, 0, 1]
    flow = unpack(truth["flow"]).reshape(3, rows, columns) / 1000
    valid = depth > 0
    exact = np.nan_to_num(pair.truth.scene_flow[offset::stride, offset::stride]).transpose(2, 0, 1)
    np.testing.assert_allclose(flow[:, valid], exact[:, valid], atol=0.00051)
    assert not unpack(zero["flow"]).any()
    labels = np.frombuffer(zlib.decompress(base64.b64decode(truth["labels"])), np.uint8)
    np.testing.assert_array_equal(np.bincount(labels) > 0, True)
    np.testing.assert_array_equal(labels.reshape(pair.truth.labels.shape) > 0, pair.truth.labels > 0)
    # The noisy method numbers objects in reverse order; on the page each has its true object's colour.
    colors = {obj["name"]: obj["color"] for obj in truth["objects"]}
    for obj in noisy["objects"]:
        name, f = obj["name"].split(", F ")
        assert obj["color"] == colors[name]
        assert float(f) > 0.99
    first = pair.truth.objects[0]
    # The displacement is that of the centre of the visible surface.
    v, u = np.nonzero((pair.truth.labels == first.label) & pair.curr.valid)
    z, camera = pair.curr.depth[v, u].astype(np.float64), pair.curr.camera
    surface = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=1).mean(axis=0)
    moved = first.prev_T_curr[:3, :3] @ surface + first.prev_T_curr[:3, 3] - surface
    np.testing.assert_allclose(truth["objects"][0]["translation"], moved, atol=1e-5)


def test_a_failed_pair_has_no_layer_of_the_failed_method(page: Reader) -> None:
    assert [layer["method"] for layer in page.blocks["pair-data-2"]["layers"]] == [-1, 0]


def test_large_images_are_downscaled(tmp_path: Path) -> None:
    write_report(tmp_path / "report.html", *make_set(1, size=(643, 482)))
    block = Reader((tmp_path / "report.html").read_text(encoding="utf-8")).blocks["pair-data-0"]
    assert block["image"] == [321, 241]
    assert 15_000 < block["grid"][0] * block["grid"][1] <= MAX_POINTS
    for layer in block["layers"]:
        assert len(zlib.decompress(base64.b64decode(layer["labels"]))) == 321 * 241


def test_the_gallery_shows_the_worst_the_best_and_some_between(tmp_path: Path) -> None:
    evaluation, source = make_set(10, size=(64, 48), methods={"noisy": estimate_noisy})
    assert choose_pairs(evaluation, 10) == list(range(10))
    f = [score.segmentation.mean_f.f for score in evaluation.methods[0].scores]
    order = rank_pairs(evaluation)
    assert [f[index] for index in order] == sorted(f)
    chosen = choose_pairs(evaluation, 5)
    assert chosen == sorted(chosen)
    assert set(order[:2]) | set(order[-1:]) < set(chosen)
    assert len(set(chosen)) == 5
    assert choose_pairs(evaluation, 0) == []
    write_report(tmp_path / "report.html", evaluation, source, max_pairs=5)
    reader = Reader((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert [pair["key"] for pair in reader.blocks["report-data"]["pairs"]] == [evaluation.pairs[i].key for i in chosen]
    assert "5 of 10 pairs" in reader.text
    with pytest.raises(ResultError, match="-1"):
        write_report(tmp_path / "other.html", evaluation, source, max_pairs=-1)


def test_the_same_evaluation_gives_the_same_bytes(small: tuple[Any, MemorySource], tmp_path: Path) -> None:
    for name in ("a.html", "b.html"):
        write_report(tmp_path / name, *small)
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


def test_an_old_report_is_kept_after_a_write_error(
    small: tuple[Any, MemorySource], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "report.html"
    path.write_text("old")

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(StorageError, match="No space left"):
        write_report(path, *small)
    assert path.read_text() == "old"
    assert [file.name for file in tmp_path.iterdir()] == ["report.html"]
