"""The pictures that an evaluated run leaves, and which views they are of."""

import numpy as np
import pytest
import torch
from PIL import Image

from sparsestreet.evaluation import run as run_module
from sparsestreet.evaluation.run import choose_pictures
from sparsestreet.pictures.images import LIDAR_END, read_pictures
from sparsestreet.records.summary import HELD_OUT, RegionQuality
from sparsestreet.scene.rendering import node_legend
from tests.evaluation.dark import MADE, evaluate, make_frames
from tests.evaluation.frames import make_frame, make_image

pytestmark = pytest.mark.lengthy


@pytest.mark.usefixtures("dark")
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


@pytest.mark.usefixtures("dark")
def test_errors_show_where_the_lidar_ends(tmp_path):
    """0.04 of 12 columns is less than a pixel: near are the pixels with a return, here the lower four rows."""
    depth = torch.zeros(9, 12)
    depth[5:] = 3.0
    summary = evaluate(tmp_path, [make_frame(0, depth=depth), make_frame(10, 1)])
    lidar, none = read_pictures(tmp_path / "pictures")
    assert np.argwhere((lidar.error == LIDAR_END).all(-1)).tolist() == [[5, column] for column in range(12)]
    assert not none.shows_lidar_end
    assert summary.by_camera[HELD_OUT]["0"]["psnr_near_lidar"] == summary.mean("psnr_near_lidar")
    assert summary.by_camera[HELD_OUT]["1"]["psnr_near_lidar"] is None


@pytest.mark.usefixtures("dark")
def test_a_run_without_pictures(tmp_path):
    evaluate(tmp_path, make_frames(2), pictures=0)
    assert list((tmp_path / "pictures").glob("*")) == []


def quality_with_vehicles(*pixels):
    return [
        make_image(index // 2, index % 2, vehicle=RegionQuality(n, 0.1, 10.0, 0.5)) for index, n in enumerate(pixels)
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
    quality = [make_image(index) for index in range(11)]
    assert len(set(choose_pictures(quality, 4))) == 4


@pytest.mark.usefixtures("dark")
@pytest.mark.parametrize(("splits", "views"), [(("held", "trained"), "2 held-out"), (("trained",), "3 training")])
def test_the_sheet_says_what_it_shows(tmp_path, monkeypatch, splits, views):
    drawn = []
    blank = np.zeros((4, 4, 3), dtype=np.uint8)
    monkeypatch.setattr(run_module, "picture_sheet", lambda chosen, **how: drawn.append((chosen, how)) or blank)
    summary = evaluate(
        tmp_path, make_frames(2) if "held" in splits else (), make_frames(3, first=1), run=MADE, pictures=1
    )  # fmt: skip
    (((picture,), how),) = drawn
    psnr = summary.mean("psnr_full")
    assert how["title"] == f"street, streetgs+paper, seed 3: {psnr:.2f} dB over {views} images, 4 Gaussians"
    assert how["legend"] == node_legend({"road": 2, "cars": 2})
    assert (picture.frame, picture.camera) == ((10, 1) if "held" in splits else (21, 0))
