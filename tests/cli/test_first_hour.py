"""What a new user meets: suggestions, fast refusals, completion, exports, and the demo's pair."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib import resources
from pathlib import Path

import cv2
import numpy as np
import pytest

from objectflow import SceneMotion
from objectflow.cli import COMMANDS, main
from objectflow.cli.completion import option_names
from objectflow.cli.estimate import Estimate
from objectflow.cli.output import RESULT_FILES

PAIR = Path(str(resources.files("objectflow"))) / "demo" / "pair"


@pytest.mark.parametrize(
    ("words", "suggestion"),
    [
        (["estimat", "x"], "did you mean 'estimate'?"),
        (["estimate", str(PAIR), "--metod", "zero"], "did you mean --method?"),
        (["estimate", str(PAIR), "--method", "rigidmach"], "did you mean 'rigidmatch'?"),
        (["demo", "--method", "zeroo"], "did you mean 'zero'?"),
    ],
)
def test_misspelt_words_are_corrected(
    words: list[str],
    suggestion: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    assert suggestion in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_wrong_path_is_refused_before_anything_heavy_is_imported() -> None:
    code = (
        "import sys; from objectflow.cli import main; code = main(['estimate', 'nowhere']); "
        "print(code, sorted({'torch', 'scipy', 'pyarrow', 'rerun', 'rich'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split(" ", 1) == ["2", "[]\n"]
    assert done.stderr == "objectflow: nowhere: no such folder\n"


def test_a_method_is_loaded_without_the_compiler_of_torch() -> None:
    code = (
        "import sys, objectflow; objectflow.load('rigidmatch'); "
        "print(sorted({'torch._dynamo', 'torch.onnx', 'sympy', 'rerun', 'pyarrow'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


@pytest.mark.parametrize("typed", [["615,615,319.5,239.5"], ["615", "615", "319.5", "239.5"]])
def test_intrinsics_may_be_separated_by_commas(typed: list[str], tmp_path: Path) -> None:
    files = [str(PAIR / name) for name in ("color0.jpg", "depth0.png", "color1.jpg", "depth1.png")]
    words = [
        "estimate",
        *files,
        "--intrinsics",
        *typed,
        "--method",
        "zero",
        "--no-pictures",
        "--out",
        str(tmp_path / "out"),
    ]
    assert main(words) == 0
    motion = SceneMotion.load(tmp_path / "out")
    assert motion.frames["intrinsics"] == [615, 615, 319.5, 239.5]
    assert [Path(path).name for path in motion.frames["paths"]] == [Path(file).name for file in files]


def test_the_pair_of_the_demo_can_be_estimated_and_exported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["demo", "--pair", str(tmp_path / "pair")]) == 0
    names = {path.name for path in (tmp_path / "pair").iterdir()}
    assert names == {"camera.json", "color0.jpg", "color1.jpg", "depth0.png", "depth1.png"}
    out = tmp_path / "out"
    words = ["estimate", str(tmp_path / "pair"), "--method", "consensus", "--camera", "static"]
    words += ["--export", "coco", "--export", "ply", "--no-pictures", "--out", str(out)]
    assert main(words) == 0
    assert "; total " in capsys.readouterr().out
    motion = SceneMotion.load(out)
    points = {f"points_{obj.id:03d}.ply" for obj in motion}
    assert {path.name for path in out.iterdir()} == {
        "labels.png",
        "scene_flow.npy",
        "objects.json",
        "coco.json",
        *points,
    }
    coco = json.loads((out / "coco.json").read_text())
    assert [entry["id"] for entry in coco["annotations"]] == [obj.id for obj in motion]
    assert (coco["images"][0]["width"], coco["images"][0]["height"]) == (640, 480)
    depth = cv2.imread(str(PAIR / "depth1.png"), cv2.IMREAD_UNCHANGED)
    for obj in motion:
        header = (out / f"points_{obj.id:03d}.ply").read_bytes().split(b"end_header")[0].decode()
        assert f"element vertex {int((motion.mask(obj.id) & (depth > 0)).sum())}\n" in header
    # The same command replaces the result, with its exported files.
    assert main([*words[:6], "--out", str(out)]) == 0
    assert {path.name for path in out.iterdir()} == RESULT_FILES


def test_completion_lists_commands_options_and_methods(capsys: pytest.CaptureFixture[str]) -> None:
    names = option_names(Estimate)
    assert {"--method", "--no-pictures", "--intrinsics", "--help"} <= set(names)
    assert "--paths" not in names
    script = {}
    for shell in ("bash", "zsh", "fish"):
        assert main(["completion", shell]) == 0
        script[shell] = capsys.readouterr().out
        assert all(name in script[shell] for name in COMMANDS)
    assert script["zsh"].startswith("autoload")
    ask = (
        "COMP_WORDS=(objectflow estimate --meth); COMP_CWORD=2; _objectflow; echo ${COMPREPLY[@]}\n"
        "COMP_WORDS=(objectflow dem); COMP_CWORD=1; _objectflow; echo ${COMPREPLY[@]}\n"
        "COMP_WORDS=(objectflow run --method rig); COMP_CWORD=3; _objectflow; echo ${COMPREPLY[@]}\n"
    )
    done = subprocess.run(["bash", "-c", script["bash"] + ask], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["--method", "demo", "rigidmatch"]


def test_an_interrupted_run_says_how_to_continue(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("objectflow.cli.run.Run.run", stop)
    assert main(["run", "anything"]) == 130
    assert capsys.readouterr().err == "objectflow: interrupted: the same command continues\n"


def test_pictures_of_large_frames_are_limited(tmp_path: Path) -> None:
    import time

    from objectflow import Camera, ObjectMotion, RgbdFrame
    from objectflow.view import write_pictures

    random = np.random.default_rng(0)
    height, width = 2160, 3840
    color = cv2.resize(random.integers(0, 255, (135, 240, 3), dtype=np.uint8), (width, height))
    frame = RgbdFrame(
        color, np.ones((height, width), np.float32), Camera(width, height, 3000.0, 3000.0, 1920.0, 1080.0)
    )
    labels = np.zeros((height, width), np.int32)
    objects = []
    for number in range(1, 5):
        labels[500:1100, 700 * number : 700 * number + 500] = number
        shift = np.eye(4)
        shift[0, 3] = 0.03
        objects.append(ObjectMotion(number, 300_000, 0.9, True, np.array([0.1 * number, 0, 1.0]), shift))
    motion = SceneMotion(labels, np.zeros((height, width, 3), np.float32), tuple(objects))
    start = time.process_time()
    write_pictures(tmp_path, frame, motion)
    # About 0.6 s; the limit leaves room for slower processors.
    assert time.process_time() - start < 3
    overlay, flow = (cv2.imread(str(tmp_path / name)) for name in ("overlay.png", "flow.png"))
    assert overlay.shape == (1080, 1920, 3)
    assert flow.shape[1] < 2700
