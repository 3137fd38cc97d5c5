"""A whole evaluation on fake renders: numbers, files, chosen pictures."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from sparsestreet.evaluation.quality import FrameQuality, RegionQuality
from sparsestreet.evaluation.records import RunDescription, quality_path, read_quality, read_summary, summary_path
from sparsestreet.evaluation.run import choose_pictures, evaluate_run
from sparsestreet.ops import Guards
from tests.evaluation.frames import make_frame

RUN = RunDescription("plain", "street", 3, "every 10th frame from 0", 12.5, "sparsestreet train")


def darker(frame):
    return SimpleNamespace(rgb=frame.image.float() / 255 * 0.9)


def dots(frame):
    image = torch.zeros(frame.image.shape)
    image[0, 0] = torch.tensor([0.2, 0.4, 1.0])
    return image


def evaluate(out, frames, pictures=2):
    return evaluate_run(
        frames,
        render=darker,
        centers=dots,
        guards=lambda frame: Guards(
            drawn=frame.frame_index, near=frame.camera_index, vanished=int(frame.frame_index == 20)
        ),
        gaussians={"background": 30, "rigid": 12},
        bytes_by_part={"background": 300, "rigid": 120, "sky": 5},
        run=RUN,
        out=out,
        pictures=pictures,
        warmup=1,
        repeats=4,
    )


def make_frames(count: int = 5):
    frames = []
    for index in range(count):
        vehicle = torch.zeros(9, 12, dtype=torch.bool)
        vehicle[:, : 2 * index] = True
        frames.append(make_frame(10 * index, index % 2, vehicle=vehicle))
    return frames


def test_a_run_leaves_its_records(tmp_path):
    frames = make_frames()
    summary = evaluate(tmp_path, frames)
    on_disk = read_summary(summary_path(tmp_path))
    assert on_disk.run == RUN
    assert on_disk.gaussians == {"background": 30, "rigid": 12}
    assert (on_disk.gaussians_total, on_disk.bytes_total, on_disk.images) == (42, 425, 5)
    assert on_disk.resolutions == ("12x9",)
    assert (on_disk.latency.repeats, on_disk.latency.views) == (4, 5)
    assert set(on_disk.quality) == set(on_disk.definitions)
    counted = {name: count for name, count in on_disk.guards.rows.items() if count}
    assert counted == {"drawn": 0 + 10 + 20 + 30 + 40, "near": 2, "vanished": 1}
    assert set(on_disk.guards.rows) == set(vars(Guards()))
    assert on_disk.guards.alarms == {"vanished": 1}
    assert on_disk.quality["psnr_full"].mean == pytest.approx(summary.quality["psnr_full"].mean, rel=1e-5)

    rows = read_quality(quality_path(tmp_path))
    assert [(row.frame, row.camera) for row in rows] == [(0, 0), (10, 1), (20, 0), (30, 1), (40, 0)]
    truths = [frame.image.double().numpy() / 255 for frame in frames]
    expected = np.mean([-10 * np.log10(np.mean((0.1 * truth) ** 2)) for truth in truths])
    assert summary.quality["psnr_full"].mean == pytest.approx(expected, abs=1e-4)  # float32 renders
    assert summary.quality["psnr_vehicle"].images == 4
    assert summary.quality["psnr_human"].images == 0


def test_a_run_leaves_pictures_in_full_resolution(tmp_path):
    frames = make_frames()
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures" / "099_0_truth.png").write_bytes(b"of an earlier evaluation")
    (tmp_path / "pictures" / "mine.png").write_bytes(b"not ours")
    evaluate(tmp_path, frames)
    found = sorted(path.name for path in (tmp_path / "pictures").iterdir())
    kinds = ("centers", "error", "render", "truth")
    views = ("020_0", "040_0")  # the middle of the others, and the one with most vehicle pixels
    assert found == sorted([f"{view}_{kind}.png" for view in views for kind in kinds] + ["mine.png", "sheet.png"])
    with Image.open(tmp_path / "pictures" / "040_0_truth.png") as image:
        assert (np.asarray(image) == frames[4].image.numpy()).all()
    with Image.open(tmp_path / "pictures" / "040_0_render.png") as image:
        rounded = (frames[4].image.double() * 0.9).numpy()
        assert np.abs(np.asarray(image) - rounded).max() <= 0.5 + 1e-4  # rounded, not truncated
    with Image.open(tmp_path / "pictures" / "040_0_centers.png") as image:
        assert tuple(np.asarray(image)[0, 0]) == (51, 102, 255)


def test_no_frames_is_an_error(tmp_path):
    with pytest.raises(ValueError, match="no held-out frames"):
        evaluate(tmp_path, [])
    assert list(tmp_path.iterdir()) == []


def test_a_run_without_pictures(tmp_path):
    evaluate(tmp_path, make_frames(2), pictures=0)
    assert list((tmp_path / "pictures").glob("*")) == []


def quality_with_vehicles(*pixels):
    return [
        FrameQuality(
            index // 2, index % 2, 8, 8, RegionQuality(64, 0.1, 10.0, 0.5), None, RegionQuality(n, 0.1, 10.0, 0.5)
        )
        for index, n in enumerate(pixels)
    ]


@pytest.mark.parametrize(
    ("pixels", "count", "expected"),
    [
        ((0, 0, 0, 0), 2, [1, 3]),
        ((0, 5, 0, 0, 0, 0, 0), 2, [1, 4]),
        ((9, 8, 1, 0, 0, 7, 0, 0), 4, [0, 2, 5, 6]),  # 8 shares its instant with 9
        ((1, 2), 4, [0, 1]),
        ((3, 3, 3, 3), 1, [0]),
        ((1, 2, 3), 0, []),
    ],
)
def test_pictures_are_chosen_by_vehicles_and_spacing(pixels, count, expected):
    assert choose_pictures(quality_with_vehicles(*pixels), count) == expected


def test_choice_does_without_masks():
    quality = [FrameQuality(index, 0, 8, 8, RegionQuality(64, 0.1, 10.0, 0.5)) for index in range(11)]
    assert len(set(choose_pictures(quality, 4))) == 4
