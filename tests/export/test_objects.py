"""Objects in files of their own stand where the street has them once their poses are applied."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData

from sparsestreet.export.frame import turned
from sparsestreet.export.objects import write_objects
from sparsestreet.export.ply import scene_gaussians
from sparsestreet.export.spz import read_plain_ply
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.nodes import Smpl
from sparsestreet.scene.rendering import RenderOptions
from sparsestreet.scene.storage import StoredScene
from tests.export.street import CAR_ROWS, ROAD_ROWS, TRAM_ROWS, stored_street, street_views
from tests.scene.people import smpl, walker


def placed(folder: Path, one: dict, time: float):
    """An object's Gaussians in the world, from nothing but the files."""
    pose = torch.tensor(next(pose for pose in one["poses"] if pose["time"] == time)["world_from_object"])
    found = turned(read_plain_ply(folder / one["file"]), pose[:3, :3])
    found.means.add_(pose[:3, 3])
    return found


def test_objects_stand_where_they_were_once_their_poses_are_applied(tmp_path: Path):
    stored, folder = stored_street(), tmp_path / "objects"
    assert write_objects(folder, stored, street_views()) == ["car", "tram"]
    said = json.loads((folder / "poses.json").read_text())
    car, tram = said["objects"]
    assert (car["gaussians"], tram["gaussians"]) == (CAR_ROWS, TRAM_ROWS)
    assert [pose["time"] for pose in car["poses"]] == [0, 0.25, 0.5, 0.75, 1]
    assert 0.5 <= max(pose["time"] for pose in tram["poses"]) < 1
    assert len(read_plain_ply(folder / said["still"])) == ROAD_ROWS
    assert said["ground"] is None
    for one in said["objects"]:
        hull = PlyData.read(folder / one["hull"])
        corners = np.stack([hull["vertex"][axis] for axis in "xyz"], 1)
        assert np.abs(corners).max() <= 0.5  # half of the box
        assert len(hull["face"]) == 2 * len(corners) - 4  # closed
        assert not one["hull_is_box"]
    for one in said["objects"]:
        for time in (0.0, 0.5):
            found, expected = placed(folder, one, time), scene_gaussians(stored, time, instances=[one["name"]])
            # float32, turned there and back.
            assert torch.allclose(found.means, expected.means, atol=2e-5)
            assert torch.allclose(found.dense_sh(), expected.dense_sh(), atol=2e-5)
            assert torch.allclose(found.scales, expected.scales, rtol=1e-4)


def test_a_body_is_written_as_it_stands_in_the_middle_of_its_time(tmp_path: Path):
    node = smpl(walker())
    stored = StoredScene(SceneGraph({"people": node}), RenderOptions(), "x", 5)
    write_objects(tmp_path / "objects", stored, street_views())
    (one,) = json.loads((tmp_path / "objects" / "poses.json").read_text())["objects"]
    assert isinstance(node, Smpl)
    found = placed(tmp_path / "objects", one, one["shape_of"])
    expected = scene_gaussians(stored, one["shape_of"])
    assert np.allclose(found.means, expected.means[expected.opacities > 0], atol=2e-5)


def test_a_scene_without_objects_and_a_folder_that_is_not_empty(tmp_path: Path):
    stored = stored_street()
    with pytest.raises(ValueError, match="no objects of their own"):
        write_objects(
            tmp_path / "a", StoredScene(stored.scene.without("rigid"), stored.options, "x", 5), street_views()
        )
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "mine.txt").touch()
    with pytest.raises(OSError, match="no empty folder"):
        write_objects(tmp_path / "b", stored, street_views())
