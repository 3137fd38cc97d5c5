"""``data masks``: from the images of a log to masks that its reader takes."""

import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sparsestreet.cli.commands import masks as module
from sparsestreet.cli.commands.data import data
from sparsestreet.cli.commands.masks import COLORS as TINTS
from sparsestreet.cli.commands.masks import overlaid
from sparsestreet.cli.config.compose import composed
from sparsestreet.cli.config.log_from_options import reader_of
from sparsestreet.data.drivestudio import DriveStudioReader
from sparsestreet.data.rig_json import RigJsonReader
from sparsestreet.geometry.cameras import inverse
from sparsestreet.types import Frame
from tests.segmentation.models import COLORS, NAMES, nearest_color
from tests.segmentation.test_write import state, stopped

KINDS = ("sky", "human", "vehicle")
SIZES = {"front": (64, 32), "left": (32, 32)}
"""Parts of the street's images, that a model with open sides sees pixel by pixel."""


@pytest.fixture(scope="module")
def street(tiny_street, tmp_path_factory) -> tuple[Path, list[Frame]]:
    """Six frames of the street as a rig, painted in the colors of the classes, and the truth."""
    root = tmp_path_factory.mktemp("masks") / "street"
    root.mkdir()
    frames = list(reader_of(composed(tiny_street)).read().frames)[:12]
    entries: list[dict] = [{"images": {}} for _ in range(6)]
    for frame in frames:
        index, camera = frame.indices
        name = list(SIZES)[camera]
        width, height = SIZES[name]
        path = f"{name}_{index:02d}.png"
        Image.fromarray(COLORS[classes(frame)][:height, :width]).save(root / path)
        pose = inverse(frame.camera.camera_from_world.double())
        entries[index]["images"][name] = {"file": path, "world_from_camera": pose.tolist()}
    cameras = {}
    for frame, (name, (width, height)) in zip(frames, SIZES.items(), strict=False):
        (fx, _, cx), (_, fy, cy), _ = frame.camera.intrinsics.tolist()
        lens = {"model": "pinhole", "fx": fx, "fy": fy, "cx": cx, "cy": cy, "first_pixel": 0.5}
        cameras[name] = {"width": width, "height": height, "lens": lens}
    (root / "rig.json").write_text(json.dumps({"cameras": cameras, "frames": entries}))
    (root.parent / "names.txt").write_text(NAMES)
    nearest_color(root.parent / "m.onnx")
    return root, frames


def classes(frame: Frame) -> np.ndarray:
    found = np.zeros(frame.image.shape[:2], int)
    for number, kind in enumerate(KINDS, 1):
        found[getattr(frame, kind).numpy()] = number
    return found


def words_of(root: Path, out: Path) -> list[str]:
    return [str(root), f"model={root.parent / 'm.onnx'}", f"classes={root.parent / 'names.txt'}", f"to={out}"]


def masked(words: Sequence[str]) -> int:
    return data(["masks", *words])


def test_a_street_gets_its_own_masks_back(street, tmp_path, capsys):
    """By a segmenter that knows its colors; the reader then has the truth."""
    root, frames = street
    out = tmp_path / "out"
    assert masked([*words_of(root, out), "threads=1"]) == 0
    printed = capsys.readouterr().out
    assert "street: 12 images by m.onnx on CPU; sky: sky; human: person; vehicle: car\n" in printed
    shares = [
        np.concatenate([(classes(f)[:32, : (64, 32)[f.indices[1]]] == n).ravel() for f in frames]).mean()
        for n in (1, 2, 3)
    ]
    assert "12 images, of whose pixels are: sky {:.1%}, human {:.1%}, vehicle {:.1%}\n".format(*shares) in printed
    assert f"masks: {out}, which readers take as data.log.masks={out}\n" in printed
    assert data(["convert", f"from={root}", f"to={tmp_path / 'converted'}", f"data.log.masks={out}"]) == 0
    for reader in (RigJsonReader(root=root, masks=out), DriveStudioReader(tmp_path / "converted")):
        for found, true in zip(reader.read().frames, frames, strict=True):
            height, width = found.image.shape[:2]
            for number, kind in enumerate(KINDS, 1):
                assert np.array_equal(getattr(found, kind).numpy(), (classes(true) == number)[:height, :width])
    with Image.open(out / "masks.png") as sheet:
        assert sheet.width == 3 * 480 + 2 * 6 + 2 * 10
    before = state(out)
    assert masked(words_of(root, out)) == 0
    assert "12 images have their masks already" in capsys.readouterr().out
    assert state(out) == before


def test_after_ctrl_c_the_same_command_goes_on(street, tmp_path, capsys, monkeypatch):
    words = words_of(street[0], tmp_path / "out")
    with monkeypatch.context() as patch:
        patch.setattr(module, "shown", stopped)
        assert masked(words) == 130
    assert capsys.readouterr().err == (
        "sparsestreet data masks: stopped, what is written stays: give the same command to go on\n"
    )
    assert masked([*words, "size=64"]) == 2
    assert (
        "has other masks, which differ in size: remove it, or name another folder with to=..."
        in capsys.readouterr().err
    )
    assert masked([*words, "data.log.last_frame=3"]) == 0
    assert "5 images, of whose pixels are: " in (said := capsys.readouterr().out)
    assert "3 images have their masks already" in said


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["{log}", "classes=cityscapes"], "model=... is missing"),
        (["{log}", "model={model}"], "classes=... is missing"),
        (["{log}", "model={model}", "classes=kitti"], "classes=kitti is none of cityscapes, ade20k, coco, coco80"),
        (["{log}", "model={model}", "classes=coco"], "float32, (1, 4, 32, 64), and coco wants scores [1, 133, h, w]"),
        (["{log}", "model={names}", "classes=coco"], "is no model that onnxruntime opens"),
        (["{log}", "model={model}", "classes=coco", "size=100"], "size must be a positive multiple of 32"),
        (["{log}", "model={model}", "classes=coco", "std=1"], "mean and std must be 3 numbers each"),
        (["{log}", "model={model}", "classes=coco", "threads=-1"], "threads must be 0 or more"),
        (["{log}", "model={model}", "classes=coco", "layers=3"], "no key 'layers'"),
        (["{log}", "out=there", "model={model}", "classes=coco"], "out= is of trainings: say to=there for the folder"),
        (["{log}", "{log}", "model={model}", "classes=coco"], "masks are of one recorded log at a time"),
        (["model={model}", "classes=coco"], "say sparsestreet data masks DIR model=FILE classes=cityscapes"),
        (["data=synthetic", "model={model}", "classes=coco"], "StreetReader takes no folder of masks"),
    ],
)
def test_a_wrong_command_is_answered_and_no_mask_is_written(words, said, street, tmp_path, capsys):
    root, _ = street
    places = {"log": root, "model": root.parent / "m.onnx", "names": root.parent / "names.txt"}
    assert masked([*(word.format(**places) for word in words), f"to={tmp_path / 'out'}"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("sparsestreet data masks: ")
    assert said in error
    assert not list(tmp_path.rglob("*.png"))


def test_a_command_that_failed_binds_nothing(street, tmp_path):
    words = words_of(street[0], tmp_path / "out")
    assert masked([words[0], words[1], "classes=coco", words[3]]) == 2
    assert masked(words) == 0


def test_without_onnxruntime_the_remedy_is_said(street, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    assert masked(words_of(street[0], tmp_path / "out")) == 2
    assert (
        "sparsestreet data masks: masks need onnxruntime: pip install 'sparsestreet[masks]'" in capsys.readouterr().err
    )


def test_each_kind_has_its_color():
    image = np.full((2, 2, 3), 100, np.uint8)
    places = {kind: np.arange(4).reshape(2, 2) == place for place, kind in enumerate(KINDS)}
    shown = overlaid(image, places).reshape(4, 3)
    for place, kind in enumerate(KINDS):
        assert np.abs(shown[place] - (100 + np.array(TINTS[kind])) / 2).max() <= 0.5  # half of it, as a whole number
    assert shown[3].tolist() == [100, 100, 100]
    assert len({tuple(color) for color in shown.tolist()}) == 4
