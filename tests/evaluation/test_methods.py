"""Names and options of methods on the command line."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest

from objectflow.errors import MethodError
from objectflow.evaluation.methods import parse_method, parse_methods, recorded


def test_a_name() -> None:
    spec = parse_method("consensus")
    assert (spec.label, spec.name, spec.options, spec.oracle, spec.folder) == (
        "consensus", "consensus", {}, False, "consensus",
    )  # fmt: skip
    # Defaults are recorded too, since a version with other defaults makes other predictions.
    assert spec.settings["rounds"] == 3
    assert spec.settings["camera"] == "auto"


def test_options_and_labels() -> None:
    spec = parse_method("consensus:rounds=1,min_object_share=0.01,camera=static")
    assert spec.label == "consensus:rounds=1,min_object_share=0.01,camera=static"
    assert spec.options == {"rounds": 1, "min_object_share": 0.01, "camera": "static"}
    assert spec.folder == "consensus_rounds=1,min_object_share=0.01,camera=static"
    named = parse_method("one round=consensus:rounds=1", camera="moving")
    assert (named.label, named.folder) == ("one round", "one_round")
    assert named.options == {"rounds": 1, "camera": "moving"}
    assert named.settings["camera"] == "moving"


def test_oracles_have_options_too() -> None:
    masks, motion = parse_methods(["oracle-masks", "oracle-motion"], camera="static")
    assert masks.oracle
    assert motion.oracle
    assert masks.settings == {"camera": "static", "match_width": 640, "seed": 0}
    assert motion.settings == {}
    assert parse_method("oracle-masks:seed=3").settings["seed"] == 3


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        ([], "no methods to evaluate"),
        (["magic"], "unknown method 'magic': choose of .*consensus.*oracle-masks"),
        (["zero", "zero"], "two methods are called 'zero'"),
        (["a b=zero", "a_b=dense-flow"], "two methods are called 'a b'"),
        (["=zero"], "no label"),
        (["zero:camera"], "NAME:OPTION=VALUE"),
        (["zero:magic=1"], "unknown setting magic"),
        (["oracle-motion:labels=1"], "has no option 'labels'"),
        (["consensus:camera=flying"], "camera must be one of auto, static, moving"),
        (["zero:camera=static"], "unknown setting camera"),
        (["consensus:rounds=many"], "rounds must be a whole number"),
        (["consensus:rounds=0"], "rounds must be at least 1"),
    ],
)
def test_what_is_no_method(texts: list[str], message: str) -> None:
    with pytest.raises(MethodError, match=message):
        parse_methods(texts)


def test_files_are_recorded_by_their_hash(tmp_path: Path) -> None:
    (tmp_path / "w.safetensors").write_bytes(b"weights")
    expected = {"file": "w.safetensors", "sha256": hashlib.sha256(b"weights").hexdigest()}
    assert recorded(tmp_path / "w.safetensors") == expected
    assert recorded(str(tmp_path / "w.safetensors")) == expected
    assert recorded(Path("nowhere")) == "PosixPath('nowhere')"
    assert recorded((1, np.float32(0.5))) == [1, 0.5]


def test_estimators_are_made_with_the_options() -> None:
    made = parse_method("consensus:rounds=2,seed=7").make()
    assert (made.rounds, made.seed) == (2, 7)  # type: ignore[attr-defined]
