"""``sparsestreet render lidar=``: files of sweeps as others read them, where the lidar stood, and what moved."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sparsestreet.cli.commands.render import render
from sparsestreet.data.lidar_models import LidarModel, lidar_model
from sparsestreet.records.run import RIG, RigRecord
from sparsestreet.scene.sweeps import Returns, render_sweep
from tests.export.street import stored_street, write_street

COLUMNS = 90


@pytest.fixture
def run(tmp_path) -> Path:
    """Frames 0.1 s apart, in which the car drives 1 m ahead, 0.1 m to the left, and turns 3 degrees."""
    return write_street(tmp_path / "run", frame_rate=10.0)


@pytest.fixture
def model(tmp_path) -> LidarModel:
    """Rays all around, few enough to be drawn at once."""
    path = tmp_path / "mine.json"
    azimuths = [3.0 - 2 * math.pi * one / COLUMNS for one in range(COLUMNS)]
    said = {"spinning_direction": "cw", "spinning_frequency_hz": 10, "column_azimuths_rad": azimuths, "reach_m": 40}
    said |= {"row_elevations_rad": [0.1, 0.0, -0.1], "row_azimuth_offsets_rad": [0.0, 0.01, -0.01]}
    path.write_text(json.dumps(said))
    return lidar_model(str(path))


def lidar_at(frame: float, mount: tuple[float, float, float] = (1.0, 0.0, 1.9), right: float = 0.0) -> np.ndarray:
    """By hand: the first camera is 1.5 m ahead of the car's origin, 1.6 m over it, 1.5 m over the world's ground."""
    yaw = math.radians(3.0 * frame)
    ahead, left = np.array([math.cos(yaw), math.sin(yaw), 0]), np.array([-math.sin(yaw), math.cos(yaw), 0])
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1] = ahead, left
    pose[:3, 3] = np.array([frame, 0.1 * frame, -0.1 + mount[2]]) + (mount[0] - 1.5) * ahead + (mount[1] - right) * left
    return pose


def drawn(model: LidarModel, frame: int, **more: Any) -> Returns:
    """The turn around a frame of the log; before the first frame and after the last the car stands."""
    stored = stored_street()

    def pose(seconds: float) -> torch.Tensor:
        return torch.from_numpy(lidar_at(min(max(frame + 10 * seconds, 0.0), 4.0), **more))

    return render_sweep(stored.scene, model, pose, frame / 4, stored.options, duration=0.4)


def table(found: Returns) -> np.ndarray:
    columns = (found.points, found.intensities[:, None], found.seconds[:, None])
    return torch.cat(columns, 1).float().numpy()


def read(path: Path) -> np.ndarray:
    """A file's rows, by its header alone."""
    data = path.read_bytes()
    if path.suffix == ".bin":
        return np.frombuffer(data, "<f4").reshape(-1, 4)
    end = b"end_header\n" if path.suffix == ".ply" else b"DATA binary\n"
    head, body = data.split(end, 1)
    lines = [line.split() for line in head.decode().splitlines()]
    if path.suffix == ".ply":
        assert lines[:2] == [["ply"], ["format", "binary_little_endian", "1.0"]]
        names = [line[2] for line in lines if line[0] == "property"]
        assert {line[1] for line in lines if line[0] == "property"} == {"float"}
        count = next(int(line[2]) for line in lines if line[:2] == ["element", "vertex"])
    else:
        said = {line[0]: line[1:] for line in lines}
        names, count = said["FIELDS"], int(said["POINTS"][0])
        assert (said["VERSION"], said["SIZE"], said["TYPE"], said["COUNT"]) == (
            ["0.7"],
            ["4"] * 5,
            ["F"] * 5,
            ["1"] * 5,
        )
        assert (said["WIDTH"], said["HEIGHT"], said["VIEWPOINT"]) == ([str(count)], ["1"], list("0001000"))
    assert names == ["x", "y", "z", "intensity", "time"]
    return np.frombuffer(body, "<f4").reshape(count, 5)


def test_a_folder_has_a_sweep_a_frame_and_their_poses(run, model, tmp_path, capsys):
    assert render([f"scene={run}", f"out={tmp_path / 'sweeps'}", f"lidar={model.source}"]) == 0
    said = json.loads((tmp_path / "sweeps" / "poses.json").read_text())
    assert (said["lidar"], said["rays"], said["turn_seconds"]) == ("mine", 3 * COLUMNS, 0.1)
    assert len(said["sweeps"]) == len(list((tmp_path / "sweeps").iterdir())) - 1 == 5
    for frame, one in enumerate(said["sweeps"]):
        assert (one["file"], one["frame"]) == (f"{frame:05d}.ply", frame)
        assert one["seconds"] == pytest.approx(0.1 * frame)
        np.testing.assert_allclose(one["world_from_lidar"], lidar_at(frame), rtol=0, atol=1e-5)
        rows, expected = read(tmp_path / "sweeps" / one["file"]), table(drawn(model, frame))
        assert len(rows) == one["returns"] == len(expected) > 20
        np.testing.assert_allclose(rows, expected, rtol=0, atol=2e-3)
    printed = capsys.readouterr().out
    assert "the lidar is 1.00 m ahead, 0.00 m left, 1.90 m up of the car's origin, as roofs carry one" in printed
    assert "intensities are 0" in printed
    assert "5 sweeps of mine" in printed


@pytest.mark.parametrize("ending", ["ply", "pcd", "bin"])
def test_a_frame_alone_is_drawn_from_a_car_that_drives_on(run, model, tmp_path, ending):
    out, mount = tmp_path / f"one.{ending}", (0.5, -0.3, 2.0)
    assert render([str(run), str(out), f"lidar={model.source}", "frames=1:2", "mount=0.5,-0.3,2"]) == 0
    rows, expected = read(out), table(drawn(model, 1, mount=mount))
    np.testing.assert_allclose(rows, expected[:, : rows.shape[1]], rtol=0, atol=2e-3)
    assert json.loads((tmp_path / "one_poses.json").read_text())["sweeps"][0]["file"] == f"one.{ending}"
    assert render([str(run), str(tmp_path / "many"), f"lidar={model.source}", "frames=1:2", f"format={ending}"]) == 0
    assert [path.name for path in sorted((tmp_path / "many").iterdir())] == [f"00000.{ending}", "poses.json"]


def test_a_lidar_stands_where_that_of_the_log_stood(run, model, tmp_path, capsys):
    place = tuple(lidar_at(3, mount=(0.7, 0.2, 2.1))[:3, 3].tolist())
    unmoved = tuple(tuple(row) for row in np.eye(4).tolist())
    record = RigRecord(
        camera_names=(), dataset_from_world=unmoved, world_from_vehicle=None, vehicle_stamps=None, lidar=(*place, 0.75)
    )
    RIG.write(run, record)
    assert render([str(run), str(tmp_path / "one.ply"), f"lidar={model.source}", "frames=1:2"]) == 0
    assert "0.70 m ahead, 0.20 m left, 2.10 m up of the car's origin, as the log's" in capsys.readouterr().out
    one = json.loads((tmp_path / "one_poses.json").read_text())["sweeps"][0]
    np.testing.assert_allclose(one["world_from_lidar"], lidar_at(1, mount=(0.7, 0.2, 2.1)), rtol=0, atol=1e-5)


def test_a_car_beside_the_path_without_an_object(run, model, tmp_path):
    (tmp_path / "edits.yaml").write_text("remove: [car, tram]")
    words = ["path=shifted", "offset=1.5", "frames=2:3", f"edits={tmp_path / 'edits.yaml'}", f"lidar={model.source}"]
    assert render([str(run), str(tmp_path / "right.ply"), *words]) == 0
    one = json.loads((tmp_path / "right_poses.json").read_text())["sweeps"][0]
    assert one["frame"] is None
    np.testing.assert_allclose(one["world_from_lidar"], lidar_at(2, right=1.5), rtol=0, atol=1e-5)
    expected = drawn(model, 2, right=1.5)
    assert 0 < one["returns"] < len(expected)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["sweeps", "lidar=hdl46"], "there is no lidar 'hdl46': name waymo_top"),
        (["one.ply", "lidar=hdl64"], "one.ply holds one sweep, and 5 are wanted"),
        (["drive.mp4", "lidar=hdl64"], "a sweep ends in .ply, .pcd, .bin"),
        (["one.ply"], "a video ends in .mp4"),
        (["sweeps", "lidar=hdl64", "format=las"], "format is ply, pcd, bin"),
        (["one.ply", "lidar=hdl64", "format=ply"], "format is ply, pcd, bin, of the files of a folder"),
        (["sweeps", "lidar=hdl64", "mount=1,2"], "mount is three numbers"),
        (["sweeps", "lidar=hdl64", "width=40"], "width= is of pictures"),
        (["sweeps", "lidar=hdl64", "layers=[rgb,depth]"], "layers= is of pictures"),
        (["stills", "mount=1,0,2"], "mount= is of sweeps: say which lidar= draws them"),
        (["sweeps", "lidar=none.json"], "none.json: the file is missing"),
    ],
)
def test_what_does_not_go_together_is_said_and_nothing_is_written(run, tmp_path, monkeypatch, capsys, words, said):
    monkeypatch.chdir(tmp_path)
    assert render([str(run), *words]) != 0
    assert said in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
