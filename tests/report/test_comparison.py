"""Which runs' pictures stand beside each other."""

import json

import numpy as np
import pytest

from sparsestreet.pictures.images import picture_path, write_png
from sparsestreet.records.quality import HELD_OUT, QUALITY
from sparsestreet.report.arms import arms
from sparsestreet.report.comparison import comparison_data
from tests.evaluation.frames import make_image, make_summary
from tests.report.sweep_folder import record
from tests.typed import there


@pytest.mark.parametrize(
    ("had", "seed", "shown"),
    [
        # Seed 0 is the lowest, and half of the arms lack it.
        ([("plain", 0), ("plain", 1), ("plain+removal", 1)], 1, ["plain", "plain+removal"]),
        # No seed is in two arms: the lowest, and no picture of another seed beside it.
        ([("plain", 0), ("plain+removal", 1)], 0, ["plain"]),
        ([("plain", 1), ("plain", 2), ("plain+removal", 2), ("plain+removal", 1)], 1, ["plain", "plain+removal"]),
    ],
)
def test_pictures_are_of_one_seed_that_most_arms_have(tmp_path, had, seed, shown):
    runs = []
    for label, number in had:
        folder = tmp_path / f"{label}_{number}"
        for kind in ("truth", "render"):
            write_png(picture_path(folder / "pictures", 5, 0, kind), np.zeros((3, 4, 3), dtype=np.uint8))
        runs.append(record(make_summary(label, number), str(folder)))
    (view,) = json.loads(there(comparison_data(arms(runs))))
    assert view["name"] == f"street, seed {seed}, frame 5, camera 0"
    assert [image["name"].partition(" (")[0] for image in view["images"]] == ["truth", *shown]


def test_the_psnr_below_a_picture_is_of_its_view(tmp_path):
    """Frame 5 has 31 dB in camera 0; other views of the run have other numbers."""
    for kind in ("truth", "render"):
        write_png(picture_path(tmp_path / "pictures", 5, 0, kind), np.zeros((3, 4, 3), dtype=np.uint8))
    QUALITY[HELD_OUT].write(tmp_path, [make_image(0, psnr=20.0), make_image(5, 1, psnr=25.0), make_image(5, psnr=31.0)])
    (view,) = json.loads(there(comparison_data(arms([record(make_summary("plain"), str(tmp_path))]))))
    assert view["images"][1]["label"] == "plain, 31.00 dB, 1,200 Gaussians"
