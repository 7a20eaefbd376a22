"""The settings of the methods: all are documented, and all can be set in the shell."""

from __future__ import annotations

import pytest

from objectflow.methods.registry import METHODS, find_class
from objectflow.settings import build, describe, parse_assignments


@pytest.mark.parametrize("method", ["rigidmatch", "consensus", "sceneflownet-c-vl", "pd-flow"])
def test_every_setting_of_a_method_is_documented(method: str) -> None:
    assert method in METHODS
    for info in describe(find_class(method)):
        assert info.documentation, info.path
        assert info.kind


@pytest.mark.parametrize("method", ["rigidmatch", "consensus", "homc", "pd-flow", "sr-flow", "vo-sf", "zero"])
def test_every_setting_can_be_set_in_the_shell(method: str) -> None:
    cls = find_class(method)
    defaults = {
        info.path: info.default
        for info in describe(cls)
        if info.path != "weights" and (info.kind != "text" or info.default)
    }
    words = [
        f"{path}={','.join(map(str, value)) if isinstance(value, list) else value}" for path, value in defaults.items()
    ]
    settings = build(cls, parse_assignments(words))
    found = {info.path: info.default for info in describe(cls, base=settings)}
    assert {path: found[path] for path in defaults} == defaults
