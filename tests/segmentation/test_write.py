"""Masks of a whole log: which images, which files, and what is done where some are there already."""

import json
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from sparsestreet.data.drivestudio import DriveStudioReader
from sparsestreet.data.problems import LogError
from sparsestreet.data.rig_json import RigJsonReader
from sparsestreet.data.waymo import WaymoReader
from sparsestreet.segmentation.classes import segmentation_classes
from sparsestreet.segmentation.model import Preparation, Segmenter
from sparsestreet.segmentation.write import RECORD, LogImages, write_masks
from tests.data.plan import Plan, PlannedCamera
from tests.data.rig_json.write import write_json, write_rig
from tests.data.waymo.drive import Drive
from tests.data.waymo.records import write_drive
from tests.segmentation.models import COLORS, NAMES, nearest_color, random_classes

KINDS = ("sky", "human", "vehicle")


class ColoredPlan(Plan):
    """Images of the classes' colors; the left camera is smaller, and odd."""

    @property
    def cameras(self) -> tuple[PlannedCamera, ...]:
        front, left = super().cameras
        return front, replace(left, width=29, height=17)

    def image(self, frame: int, camera: PlannedCamera) -> np.ndarray:
        return COLORS[random_classes(camera.height, camera.width, seed=100 * frame + camera.width)]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    (tmp_path / "log").mkdir()
    write_rig(tmp_path / "log", ColoredPlan())
    return tmp_path / "log"


@pytest.fixture
def segmenter(tmp_path: Path) -> Segmenter:
    (tmp_path / "names.txt").write_text(NAMES)
    return opened(nearest_color(tmp_path / "m.onnx"), tmp_path / "names.txt")


def opened(path: Path, names: Path | str, preparation: Preparation | None = None) -> Segmenter:
    return Segmenter(path, segmentation_classes(str(names)), preparation or Preparation(), threads=1)


def white(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        pixels = np.asarray(image)
    assert set(np.unique(pixels)) <= {0, 255}
    return pixels == 255


def test_every_image_gets_its_masks_at_its_own_size(root, segmenter, tmp_path):
    log = LogImages.of(RigJsonReader(root=root, width=16), KINDS)
    written = write_masks(log, segmenter, tmp_path / "out")
    assert (len(log), written.made, written.found) == (8, 8, 0)
    total = dict.fromkeys(KINDS, 0)
    for camera in ("front", "left"):
        for frame in range(4):
            pixels = np.asarray(Image.open(root / camera / f"{frame:03d}.png"))
            for kind, mask in segmenter(pixels).items():
                assert np.array_equal(white(tmp_path / f"out/{kind}/{camera}/{frame:03d}.png"), mask)
                total[kind] += int(mask.sum())
    pixels = 4 * (32 * 24 + 29 * 17)
    assert written.shares == pytest.approx({kind: count / pixels for kind, count in total.items()}, rel=1e-12)
    frame = RigJsonReader(root=root, masks=tmp_path / "out").read().frames[1]
    assert frame.sky is not None
    assert np.array_equal(frame.sky.numpy(), white(tmp_path / "out/sky/left/000.png"))


def test_images_are_seen_through_their_lens(root, segmenter, tmp_path):
    content = json.loads((root / "rig.json").read_text())
    content["cameras"]["front"]["lens"] = {"model": "fisheye", "fx": 20, "fy": 20, "cx": 16, "cy": 12, "k1": 0.05}
    write_json(root, content)
    log = LogImages.of(RigJsonReader(root=root, cameras=["front"]), KINDS)
    assert log.recording.rig[0].undistortion is not None
    recorded = np.asarray(Image.open(root / "front/002.png"))
    assert np.array_equal(log.image(2), recorded)
    write_masks(log, segmenter, tmp_path / "out")
    assert np.array_equal(white(tmp_path / "out/vehicle/front/002.png"), segmenter(recorded)["vehicle"])


def test_images_without_a_file_of_their_own(segmenter, tmp_path):
    write_drive(tmp_path, Drive(num_frames=3))
    part = {"root": tmp_path, "first_frame": 1}
    plain, small = WaymoReader(**part, cameras=["FRONT"]), WaymoReader(**part, width=16)
    log = LogImages.of(small, KINDS)
    assert np.array_equal(log.image(0), plain.read().frames[0].image.numpy())
    write_masks(log, segmenter, tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out/sky/FRONT_LEFT").iterdir()) == ["001.png", "002.png"]
    frame = replace(plain, masks=tmp_path / "out").read().frames[0]
    assert torch.equal(torch.from_numpy(segmenter(log.image(0))["human"]), frame.human)


def stopped(places: Iterable[int], total: int, what: str) -> Iterator[int]:
    yield from list(places)[:3]
    raise KeyboardInterrupt


def state(folder: Path) -> dict[str, tuple[int, bytes]]:
    return {str(path): (path.stat().st_mtime_ns, path.read_bytes()) for path in folder.rglob("*") if path.is_file()}


def test_an_interrupted_call_goes_on_with_what_is_missing(root, segmenter, tmp_path):
    out, log = tmp_path / "out", LogImages.of(RigJsonReader(root=root), KINDS)
    with pytest.raises(KeyboardInterrupt):
        write_masks(log, segmenter, out, stopped)
    before = state(out)
    assert len(before) == 1 + 3 * 3
    half = out / "human/front/001.png"
    half.unlink()
    written = write_masks(log, segmenter, out)
    assert (written.made, written.found) == (6, 2)
    after = state(out)
    assert len(after) == 1 + 8 * 3
    untouched = {path: one for path, one in before.items() if "front/001" not in path}
    assert {path: after[path] for path in untouched} == untouched
    assert write_masks(log, segmenter, out).made == 0
    assert state(out) == after
    # The masks of a part are those of the whole.
    other = tmp_path / "other"
    for part in (RigJsonReader(root=root, last_frame=1), RigJsonReader(root=root, masks=other, cameras=["left"])):
        write_masks(LogImages.of(part, KINDS), segmenter, other)
    assert len(state(other)) == 1 + 6 * 3


def test_masks_of_something_else_are_left_alone(root, segmenter, tmp_path):
    out, log = tmp_path / "out", LogImages.of(RigJsonReader(root=root), KINDS)
    (out / "ego/front").mkdir(parents=True)
    write_masks(log, segmenter, out)
    before = state(out)
    (tmp_path / "others.txt").write_text("road\nsky\ncar\nperson\n")
    others = {
        "model": opened(nearest_color(tmp_path / "other.onnx", stride=2), tmp_path / "names.txt"),
        "classes": opened(segmenter.path, tmp_path / "others.txt"),
        "size": opened(segmenter.path, tmp_path / "names.txt", Preparation(size=64)),
        "std": opened(segmenter.path, tmp_path / "names.txt", Preparation(std=(1.0, 1.0, 1.0))),
    }
    for what, other in others.items():
        with pytest.raises(ValueError, match=rf"has other masks, which differ in {what}: remove it, or name another"):
            write_masks(log, other, out)
    with pytest.raises(ValueError, match="which differ in log: remove it"):
        write_masks(replace(log, recording=replace(log.recording, name="another")), segmenter, out)
    record = json.loads((out / RECORD).read_text())
    for damaged in ('{"format": 1', "[]", json.dumps({**record, "version": "0"}), json.dumps({**record, "more": 1})):
        (out / RECORD).write_text(damaged)
        with pytest.raises(ValueError, match=r"is no record of masks|which differ in version: |which differ in more: "):
            write_masks(log, segmenter, out)
    (out / RECORD).unlink()
    with pytest.raises(ValueError, match=r"sky is there, and no masks\.json says by which segmenter: remove it"):
        write_masks(log, segmenter, out)
    (out / RECORD).write_bytes(before[str(out / RECORD)][1])
    assert {path: one[1] for path, one in state(out).items()} == {path: one[1] for path, one in before.items()}


def test_a_broken_image_ends_it_and_the_rest_stays(root, segmenter, tmp_path):
    broken = root / "left/001.png"
    content = bytearray(broken.read_bytes())
    content[len(content) // 2] ^= 255  # of the pixels: headers and ends are looked at before
    broken.write_bytes(content)
    with pytest.raises(LogError, match=r"left/001\.png: the image cannot be decoded"):
        write_masks(LogImages.of(RigJsonReader(root=root), KINDS), segmenter, tmp_path / "out")
    assert len(state(tmp_path / "out")) == 1 + 3 * 3


def test_a_reader_without_such_a_folder_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"DriveStudioReader takes no folder of masks: .* data\.log\.masks=DIR"):
        LogImages.of(DriveStudioReader(tmp_path), KINDS)
