"""Sweeps beside pictures: ratios by hand, where the lidar is, and the record of a run."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks import sweeps
from sparsestreet.bench.records import read_records
from sparsestreet.data.lidar_models import lidar_model
from sparsestreet.scene.storage import load_scene, views_of
from tests.bench.test_streets import made_street


def small_lidar(folder: Path) -> str:
    """Three rows of 40 columns, once around."""
    tables = {
        "row_elevations_rad": [0.1, 0.0, -0.1],
        "row_azimuth_offsets_rad": [0.0, 0.0, 0.0],
        "column_azimuths_rad": [3.0 - 0.15 * column for column in range(40)],
        "spinning_direction": "cw",
        "spinning_frequency_hz": 10.0,
    }
    (folder / "small.json").write_text(json.dumps(tables))
    return str(folder / "small.json")


def test_ratios_are_of_pairs_and_the_first_pair_does_not_count(tmp_path, monkeypatch):
    """Ratios of 6, 10, 12, 14 and 8, while pictures take three times as long at the end; the medians are 12 apart."""
    run, taken = made_street(tmp_path / "run"), iter([0.001, 5.0, 0.1, 0.6, 0.1, 1.0, 0.2, 2.4, 0.3, 4.2, 0.3, 2.4])

    def seconds(draw):
        return next(taken), draw()

    monkeypatch.setattr(sweeps, "seconds", seconds)
    front = [view for view in views_of(run).all if view.camera_index == 0]
    way = sweeps.along_camera(lidar_model(small_lidar(tmp_path)), front, 1.0)
    found = sweeps.timed("street", load_scene(run), way, front, 5)
    assert found.ratio == pytest.approx(10)
    assert found.ratio_quartiles == pytest.approx((8, 12))
    assert (found.sweep_ms.median, found.sweep_ms.minimum) == pytest.approx((2400, 600))
    assert (found.picture_ms.median, found.picture_ms.repeats) == (200, 5)
    assert (found.rays, found.gaussians, found.picture) == (120, 37, "48x32")
    assert found.returns == found.rays


def test_the_lidar_looks_where_its_camera_looks(tmp_path):
    views = sorted(views_of(made_street(tmp_path / "run")).all, key=lambda view: view.indices)
    front = [view for view in views if view.camera_index == 0]
    pose = sweeps.along_camera(lidar_model("hdl32"), front, 1.0).at(front[2].time)(0.0).numpy()
    world_from_camera = np.linalg.inv(front[2].camera.camera_from_world.double().numpy())
    right, down, ahead, place = world_from_camera[:3].T
    np.testing.assert_allclose(pose[:3], np.stack((ahead, -right, -down, place), 1), atol=1e-6)


def test_every_lidar_of_every_scene_has_a_line(tmp_path, capsys):
    run = made_street(tmp_path / "run")
    lidar = small_lidar(tmp_path)
    assert sweeps.main([f"scenes={run},{run}", f"lidars={lidar}", "repeats=2", f"out={tmp_path}"]) == 0
    records = read_records(tmp_path / "sweeps.jsonl")
    assert [(one["scene"], one["lidar"]) for one in records] == [("run", "small")] * 2
    assert records[0]["provenance"]["command"].startswith("python -m benchmarks.sweeps scenes=")
    assert "of 120 rays return" in capsys.readouterr().out
    assert sweeps.main([f"scenes={run}", "repeats=1", f"out={tmp_path}"]) == 2
    assert sweeps.main([f"scenes={run}", "lidars=none", f"out={tmp_path}"]) == 1
