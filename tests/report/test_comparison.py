"""Which runs' pictures stand beside each other."""

import json

import numpy as np

from sparsestreet.pictures.images import picture_path, write_png
from sparsestreet.report.arms import arms
from sparsestreet.report.comparison import comparison_data
from tests.evaluation.frames import make_summary
from tests.report.sweep_folder import record


def test_pictures_are_of_one_seed(tmp_path):
    """Seed 0 is the lowest; an arm that has seed 1 alone is not shown beside it."""
    runs = []
    for label, seed in (("plain", 0), ("plain", 1), ("plain+removal", 1)):
        folder = tmp_path / f"{label}_{seed}"
        for kind in ("truth", "render"):
            write_png(picture_path(folder / "pictures", 5, 0, kind), np.zeros((3, 4, 3), dtype=np.uint8))
        runs.append(record(make_summary(label, seed), str(folder)))
    (view,) = json.loads(comparison_data(arms(runs)))
    assert view["name"] == "street, seed 0, frame 5, camera 0"
    assert [image["name"] for image in view["images"]] == ["truth", "plain"]
