"""Settings: building them by paths, their types and bounds, and messages that name the field."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import pytest

from objectflow.errors import MethodError, SettingsError
from objectflow.settings import Settings, build, converted, describe, flat, parse_assignments, read_toml, setting


class Callback(Protocol):
    """Any callable."""

    def __call__(self) -> None: ...


@dataclass(frozen=True)
class Inner(Settings):
    loss: float = setting(0.2, minimum=0, below=1)
    """Nats: the largest
    loss."""
    count: int = setting(3, minimum=1, maximum=9)


@dataclass(frozen=True)
class Middle(Settings):
    inner: Inner = Inner()
    other: Inner = Inner(loss=0.5)
    width: int = setting(320, above=15)


@dataclass(frozen=True)
class Outer(Settings):
    mode: Literal["auto", "static", "moving"] = "auto"
    middle: Middle = Middle()
    steps: tuple[str, ...] = ("refine", "merge")
    size: tuple[int, int] | None = None
    scales: tuple[float, ...] = setting((1.0, 2.0), above=0)
    weights: str | Path | None = None
    folder: Path = Path("out")
    limit: float | None = setting(None, minimum=0)
    explain: bool = False
    seed: int = setting(0, minimum=0)
    name: str = "x"
    callback: Callback | None = None
    made: int = field(init=False, default=0)


# --- paths ---


def test_nothing_given_is_the_default() -> None:
    assert build(Outer, {}) == Outer()


@pytest.mark.parametrize(
    "values",
    [
        {"middle.inner.loss": 0.1, "middle.width": 64},
        {"middle": {"inner": {"loss": 0.1}, "width": 64}},
        {"middle": {"inner.loss": 0.1, "width": 64}},
        {"middle.inner": {"loss": 0.1}, "middle": {"width": 64}},
        {"middle.inner": Inner(loss=0.1), "middle.width": 64},
        {"middle": Middle(inner=Inner(loss=0.1)), "middle.width": 64},
        {"middle.width": 64, "middle": Middle(inner=Inner(loss=0.1))},
        {"middle": Middle(inner=Inner(loss=0.1), width=64)},
    ],
)
def test_paths_mappings_and_settings_are_equivalent(values: dict[str, Any]) -> None:
    found = build(Outer, values)
    assert found == Outer(middle=Middle(inner=Inner(loss=0.1), width=64))
    # Fields that are not named keep the default of their place, not that of their class.
    assert found.middle.other == Inner(loss=0.5)


def test_a_changed_group_keeps_the_other_fields_of_its_place() -> None:
    assert build(Outer, {"middle.other.count": 5}).middle.other == Inner(loss=0.5, count=5)
    given = Middle(inner=Inner(count=7))
    assert build(Outer, {"middle": given, "middle.inner.loss": 0.3}).middle.inner == Inner(loss=0.3, count=7)
    assert given == Middle(inner=Inner(count=7))


def test_settings_are_frozen() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        Outer().mode = "static"  # type: ignore[misc]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"midle.width": 3}, "unknown setting midle: did you mean middle? choose one of mode, middle, steps, "),
        ({"xyz": 3}, "unknown setting xyz: choose one of mode, middle, steps, size, "),
        (
            {"middle.inner.los": 3},
            "unknown setting middle.inner.los: did you mean middle.inner.loss? "
            "choose one of middle.inner.loss, middle.inner.count",
        ),
        ({"middle": {"inner": {"zzz": 3}}}, "unknown setting middle.inner.zzz: choose one of middle.inner.loss, "),
        ({"made": 3}, "unknown setting made: did you mean "),
        ({"mode.x": 3}, "setting mode.x: mode is a value and has no fields"),
        ({"middle.width.x": 3}, "setting middle.width.x: middle.width is a value and has no fields"),
        ({"middle": 3}, "setting middle is a group, not a value: choose one of its fields (inner, other, width)"),
        ({"middle.inner": "a"}, "setting middle.inner is a group, not a value: choose one of its fields (loss, "),
        ({"": 3}, "unknown setting : choose one of mode, "),
        ({"middle.": 3}, "setting middle is a group, not a value: "),
        ({"middle..width": 3}, "unknown setting middle.: choose one of middle.inner, "),
    ],
)
def test_wrong_paths_are_named_with_the_choices(values: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingsError) as caught:
        build(Outer, values)
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)


def test_a_class_without_settings_says_so() -> None:
    assert build(Settings, {}) == Settings()
    with pytest.raises(SettingsError, match=r"^unknown setting camera: Settings has no settings$"):
        build(Settings, {"camera": "static"})


def test_a_settings_error_is_a_method_error() -> None:
    assert issubclass(SettingsError, MethodError)


def test_nested_mappings_become_paths() -> None:
    values = {"a": 1, "b": {"c": 2, "d": {"e": [3, 4]}}, "f.g": {"h": None}, "empty": {}}
    assert flat(values) == {"a": 1, "b.c": 2, "b.d.e": [3, 4], "f.g.h": None}
    nested = {"middle": {"inner": {"loss": 0.1}, "width": 64}, "mode": "static"}
    assert build(Outer, flat(nested)) == build(Outer, nested)


# --- types ---


@pytest.mark.parametrize(
    ("path", "value", "expected"),
    [
        ("limit", 1, 1.0),
        ("limit", "0.25", 0.25),
        ("limit", "1e-3", 0.001),
        ("limit", np.float32(0.5), 0.5),
        ("limit", None, None),
        ("limit", "none", None),
        ("limit", "None", None),
        ("seed", 7.0, 7),
        ("seed", "7", 7),
        ("seed", np.int64(7), 7),
        ("seed", 2**53 + 1, 2**53 + 1),  # not representable as a float
        ("seed", str(2**53 + 1), 2**53 + 1),
        ("explain", True, True),
        ("explain", "true", True),
        ("explain", "No", False),
        ("explain", "0", False),
        ("mode", "moving", "moving"),
        ("name", "12", "12"),
        ("steps", ["merge"], ("merge",)),
        ("steps", "merge,refine", ("merge", "refine")),
        ("steps", "merge, refine", ("merge", "refine")),
        ("steps", '["merge", "refine"]', ("merge", "refine")),
        ("steps", "", ()),
        ("size", [48, "64"], (48, 64)),
        ("size", "48,64", (48, 64)),
        ("size", "(48, 64)", (48, 64)),
        ("size", "none", None),
        ("scales", "1,2.5,4", (1.0, 2.5, 4.0)),
        ("folder", "a/b", Path("a/b")),
        ("folder", Path("a"), Path("a")),
        ("weights", "hf://owner/name", "hf://owner/name"),  # a path would lose a slash
        ("weights", Path("a/b"), Path("a/b")),
        ("weights", None, None),
        ("callback", print, print),
    ],
)
def test_values_become_their_fields_type(path: str, value: Any, expected: Any) -> None:
    found = getattr(build(Outer, {path: value}), path)
    assert found == expected
    assert type(found) is type(expected)
    assert getattr(Outer(**{path: value}), path) == expected


@pytest.mark.parametrize(
    ("path", "value", "wanted"),
    [
        ("limit", "much", "a finite number or none"),
        ("limit", float("nan"), "a finite number or none"),
        ("limit", "inf", "a finite number or none"),
        ("limit", True, "a finite number or none"),
        ("limit", {"a": 1}, "a finite number or none"),
        ("limit", [1.0], "a finite number or none"),
        ("seed", 1.5, "a whole number"),
        ("seed", "1.5", "a whole number"),
        ("seed", "", "a whole number"),
        ("seed", None, "a whole number"),
        ("seed", False, "a whole number"),
        ("seed", 1e400, "a whole number"),
        ("explain", "perhaps", "true or false"),
        ("explain", 1, "true or false"),
        ("explain", None, "true or false"),
        ("mode", "flying", "one of auto, static, moving"),
        ("mode", "Auto", "one of auto, static, moving"),
        ("mode", 3, "one of auto, static, moving"),
        ("name", 3, "text"),
        ("steps", 3, "values"),
        ("steps", {"a": 1}, "values"),
        ("size", "48", "2 values or none"),
        ("size", [1, 2, 3], "2 values or none"),
        ("size", ["a", 2], "2 values or none"),
        ("scales", "1,b", "a finite number"),
        ("folder", 3, "a path"),
        ("weights", 3, "text or a path or none"),
    ],
)
def test_values_of_a_wrong_type_are_rejected(path: str, value: Any, wanted: str) -> None:
    with pytest.raises(SettingsError) as caught:
        build(Outer, {path: value})
    assert str(caught.value).startswith(f"setting {path} must be {wanted}, not ")
    with pytest.raises(SettingsError, match=f"setting {path} must be"):
        Outer(**{path: value})


def test_an_enormous_whole_number_is_kept() -> None:
    assert build(Outer, {"seed": 10**400}).seed == 10**400
    with pytest.raises(SettingsError, match="setting limit must be a finite number or none"):
        build(Outer, {"limit": 10**400})


def test_a_nested_path_is_named_in_full() -> None:
    with pytest.raises(SettingsError, match=r"^setting middle\.inner\.loss must be a finite number, not 'x'$"):
        build(Outer, {"middle": {"inner": {"loss": "x"}}})


def test_a_group_of_another_class_is_rejected() -> None:
    with pytest.raises(SettingsError, match="setting middle must be a Middle, not Inner"):
        Outer(middle=Inner())  # type: ignore[arg-type]
    with pytest.raises(SettingsError, match="setting middle is a group, not a value"):
        build(Outer, {"middle": Inner()})


def test_converted_alone() -> None:
    assert converted("3", int, "x.y") == 3
    with pytest.raises(SettingsError, match=r"setting x\.y must be a whole number, not 'z'"):
        converted("z", int, "x.y")


# --- bounds ---


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("middle.inner.loss", -0.1, "must be at least 0 and below 1, not -0.1"),
        ("middle.inner.loss", 1, "must be at least 0 and below 1, not 1"),
        ("middle.inner.count", 0, "must be at least 1 and at most 9, not 0"),
        ("middle.inner.count", "10", "must be at least 1 and at most 9, not 10"),
        ("middle.width", 15, "must be above 15, not 15"),
        ("limit", -1, "must be at least 0, not -1"),
        ("scales", [1, 0, 2], "must be above 0, not 0"),
    ],
)
def test_values_out_of_bounds_are_rejected(path: str, value: Any, message: str) -> None:
    with pytest.raises(SettingsError) as caught:
        build(Outer, {path: value})
    assert str(caught.value) == f"setting {path} {message}"


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("middle.inner.loss", 0),
        ("middle.inner.loss", 0.999),
        ("middle.inner.count", 1),
        ("middle.inner.count", 9),
        ("middle.width", 16),
        ("limit", 0),
        ("scales", []),
    ],
)
def test_values_at_their_bounds_are_accepted(path: str, value: Any) -> None:
    build(Outer, {path: value})


def test_an_instance_checks_its_own_fields() -> None:
    with pytest.raises(SettingsError, match="setting loss must be at least 0 and below 1, not 2"):
        Inner(loss=2)
    with pytest.raises(SettingsError, match="setting count must be a whole number, not 'x'"):
        dataclasses.replace(Inner(), count="x")  # type: ignore[arg-type]


# --- descriptions ---


def test_settings_are_described_by_path() -> None:
    found = {info.path: info for info in describe(Outer)}
    assert "made" not in found
    assert found["middle.inner.loss"] == ("middle.inner.loss", "a finite number", 0.2, "Nats: the largest loss.")
    assert found["middle.other.loss"].default == 0.5  # the default of its place
    assert found["size"][1:3] == ("2 values or none", None)
    assert found["steps"].default == ["refine", "merge"]
    assert found["middle.inner.count"].documentation == ""


# --- as JSON, from the command line, from a file ---


def test_settings_as_json_and_back() -> None:
    settings = build(Outer, {"middle.inner.loss": 0.1, "size": (48, 64), "weights": Path("/home/me/w.safetensors")})
    values = json.loads(json.dumps(settings.to_dict()))
    assert values["middle"] == {
        "inner": {"loss": 0.1, "count": 3},
        "other": {"loss": 0.5, "count": 3},
        "width": 320,
    }
    assert (values["size"], values["steps"], values["limit"]) == ([48, 64], ["refine", "merge"], None)
    assert values["weights"] == "w.safetensors"  # folders of one machine do not belong into results
    assert "made" not in values
    again = build(Outer, values)
    assert dataclasses.replace(again, weights=None, folder=Path("out")) == dataclasses.replace(
        settings, weights=None, folder=Path("out")
    )


def test_assignments() -> None:
    words = ["a.b=1", " c = x y ", "d=", "a.b=2", "e=f=g"]
    assert parse_assignments(words) == {"a.b": "2", "c": "x y", "d": "", "e": "f=g"}
    assert parse_assignments([]) == {}
    found = build(Outer, parse_assignments(["middle.inner.loss=0.1", "size=48,64", "explain=yes", "limit=none"]))
    assert found == Outer(middle=Middle(inner=Inner(loss=0.1)), size=(48, 64), explain=True)


@pytest.mark.parametrize("word", ["threshold", "=3", "  = 3", ""])
def test_words_that_assign_nothing_are_rejected(word: str) -> None:
    with pytest.raises(SettingsError, match=r"--set takes PATH=VALUE, such as threshold=0\.2, not '"):
        parse_assignments([word])


def test_a_toml_file(tmp_path: Path) -> None:
    path = tmp_path / "settings.toml"
    path.write_text(
        'mode = "static"\nsteps = ["merge"]\nsize = [48, 64]\n[middle]\nwidth = 64\n[middle.inner]\nloss = 0.1\n',
        encoding="utf-8",
    )
    expected = Outer(mode="static", steps=("merge",), size=(48, 64), middle=Middle(inner=Inner(loss=0.1), width=64))
    assert build(Outer, read_toml(path)) == expected
    # The command line comes last.
    overridden = build(Outer, flat(read_toml(path)) | {"middle.width": "32"})
    assert overridden.middle == Middle(inner=Inner(loss=0.1), width=32)
    (tmp_path / "empty.toml").write_text("", encoding="utf-8")
    assert build(Outer, read_toml(tmp_path / "empty.toml")) == Outer()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"a = ", "not valid TOML: "),
        (b"a = 1\na = 2\n", "not valid TOML: "),
        (b"a = " + b"[" * 100_000, "not valid TOML: "),
        (b"a = '\xff'", "cannot be read: not UTF-8 text"),
    ],
)
def test_files_that_are_no_toml_are_named(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "bad.toml"
    path.write_bytes(content)
    with pytest.raises(SettingsError) as caught:
        read_toml(path)
    assert str(caught.value).startswith(f"{path}: {message}")
    assert "\n" not in str(caught.value)


def test_files_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"none\.toml: no such settings file$"):
        read_toml(tmp_path / "none.toml")
    with pytest.raises(SettingsError, match="cannot be read: "):
        read_toml(tmp_path)
