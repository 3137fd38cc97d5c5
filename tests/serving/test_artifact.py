"""The file that AlpaSim loads, read back with the modules of Python alone."""

import io
import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
import yaml
from scipy.spatial.transform import Rotation

from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.nodes import Background, Rigid
from sparsestreet.scene.views import RecordedViews
from sparsestreet.serving.artifact import Provenance, write_artifact
from sparsestreet.serving.renderer import ServedScene, edits_of, picture, view_of
from sparsestreet.serving.rig import rig_of
from sparsestreet.types import Shutter
from tests.export.street import stored_street, street_views
from tests.scene.street import background, random_rows
from tests.serving.street import START_US, STEP_US, place, request_for, served, timed_views

FROM = Provenance("1234", "abcd", 0)
VIEWS = RecordedViews(tuple(timed_views()), (), 4.0)


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    made = served(tmp_path_factory.mktemp("runs") / "street")
    node = made.stored.scene.nodes["rigid"]
    assert isinstance(node, Rigid)
    # A car of four annotated instants, which turns; the tram has two.
    node.keyframe_times = torch.tensor([[0.0, 0.25, 0.5, 1.0], [0.0, 0.5, 0.5, 0.5]])
    node.keyframe_valid = torch.tensor([[True] * 4, [True, True, False, False]])
    node.keyframe_translations = torch.tensor([[[8.0, 1, 1], [9, 1, 1], [10, 1.5, 1], [12, 2, 1]]] * 2)
    turns = torch.tensor([0.0, 0.1, 0.2, 0.4])
    zero = torch.zeros(4)
    node.keyframe_quaternions = torch.stack((turns.cos(), zero, zero, turns.sin()), -1).repeat(2, 1, 1)
    for name in ("rotation_deltas", "translation_deltas"):
        setattr(node, name, torch.nn.Parameter(torch.zeros(2, 4, 3)))
    node.sizes[0] = torch.tensor([4.0, 2.0, 1.5])
    return made


@pytest.fixture(scope="module")
def archive(street, tmp_path_factory):
    path = tmp_path_factory.mktemp("out") / "street.usdz"
    assert write_artifact(path, street, VIEWS, FROM) == {"poses": 5, "cameras": 4, "objects": 1, "ground vertices": 0}
    return path


def test_the_zip_is_not_compressed_and_has_three_texts(archive):
    with zipfile.ZipFile(archive) as found:
        assert found.testzip() is None
        assert found.namelist() == ["metadata.yaml", "rig_trajectories.json", "sequence_tracks.json"]
        assert {entry.compress_type for entry in found.infolist()} == {zipfile.ZIP_STORED}
        assert {entry.date_time for entry in found.infolist()} == {(1980, 1, 1, 0, 0, 0)}  # equal bytes on any day


def test_the_ground_is_a_mesh_below_the_drive(tmp_path):
    """Under the names and in the layout that AlpaSim reads: float32, triangles, in the world of the drive."""
    made = served(tmp_path / "street")
    flat = SceneGraph({"ground": level_road(), **dict(made.stored.scene.nodes.items())})
    rich = replace(made, stored=replace(made.stored, scene=flat))
    counts = write_artifact(tmp_path / "a.usdz", rich, VIEWS, FROM)
    with zipfile.ZipFile(tmp_path / "a.usdz") as found:
        assert found.namelist()[3:] == ["mesh.ply", "mesh_ground.ply"]
        data = found.read("mesh_ground.ply")
        assert found.read("mesh.ply") == data
        (drive,) = json.loads(found.read("rig_trajectories.json"))["rig_trajectories"]
    read = trimesh.load_mesh(io.BytesIO(data), file_type="ply", process=False)
    assert len(read.vertices) == counts["ground vertices"] > 1000
    for pose in drive["T_rig_worlds"]:
        away = np.linalg.norm(read.vertices[:, :2] - np.array(pose)[:2, 3], axis=1)
        assert away.min() < 0.36  # half of the diagonal of a square
        assert read.vertices[away < 2, 2] == pytest.approx(-0.25, abs=0.02)


def level_road() -> Background:
    """A level road 0.25 m below zero, 24 m long and 16 m wide, which begins 3 m behind the first camera."""
    places = np.random.default_rng(0).uniform([-6.0, -8.0], [18.0, 8.0], (4000, 2))
    rows = random_rows(len(places), 0)
    with torch.no_grad():
        rows.means[:] = torch.from_numpy(np.column_stack([places, np.full(len(places), -0.25)])).float()
        rows.log_scales[:] = torch.tensor([0.3, 0.3, 0.01]).log()
        rows.quaternions[:] = torch.tensor([1.0, 0.0, 0.0, 0.0])
        rows.opacity_logits.fill_(2.0)
    return background(rows)


def test_metadata_has_every_key_that_is_asked_for(archive):
    with zipfile.ZipFile(archive) as found:
        metadata = yaml.safe_load(found.read("metadata.yaml"))
    assert metadata["scene_id"] == "street"
    texts = ("scene_id", "version_string", "training_date", "dataset_hash", "uuid")
    assert all(isinstance(metadata[key], str) for key in texts)
    assert metadata["is_resumable"] is False
    assert metadata["sensors"] == {"camera_ids": ["0", "1", "2", "3"], "lidar_ids": []}
    assert metadata["logger"] == {"name": None, "run_id": None, "run_url": None}
    assert metadata["time_range"] == {"start": START_US / 1e6, "end": (START_US + 4 * STEP_US) / 1e6}


def test_the_drive_is_that_of_the_rig(archive, street):
    with zipfile.ZipFile(archive) as found:
        said = json.loads(found.read("rig_trajectories.json"))
    (drive,) = said["rig_trajectories"]
    assert drive["sequence_id"] == "street"
    assert drive["T_rig_world_timestamps_us"] == [START_US + STEP_US * frame for frame in range(5)]
    assert np.array_equal(drive["T_rig_worlds"], street.rig.poses)
    assert np.array_equal(said["world_to_nre"]["matrix"], np.eye(4))
    assert [one["logical_sensor_name"] for one in said["camera_calibrations"].values()] == ["0", "1", "2", "3"]
    assert drive["cameras_frame_timestamps_us"].keys() == said["camera_calibrations"].keys()
    for frames in drive["cameras_frame_timestamps_us"].values():
        assert [end for _, end in frames] == [START_US + STEP_US * frame for frame in range(1, 5)]
        assert all(end > start for start, end in frames)
    assert drive["rig_bbox"]["dim"] == [4.8, 1.9, 1.6]
    assert drive["rig_bbox"]["centroid"] == pytest.approx([1.4, 0.0, 0.8])


def test_the_map_is_where_the_scene_is(street, tmp_path):
    """A point of a data set far from its origin goes to its place in the scene; images last as long as readouts."""
    served, views = apart(5, 10.0, True, 0.03)
    dataset_from_world = np.array([[0.0, -1, 0, 1000], [1, 0, 0, 2000], [0, 0, 1, 30], [0, 0, 0, 1]])
    moved = replace(served, rig=replace(served.rig, dataset_from_world=dataset_from_world))
    write_artifact(tmp_path / "a.usdz", moved, views, FROM)
    with zipfile.ZipFile(tmp_path / "a.usdz") as found:
        said = json.loads(found.read("rig_trajectories.json"))
    # Five meters along x of the scene is along y of the data set.
    assert np.allclose(said["world_to_nre"]["matrix"] @ np.array([1000, 2005, 30, 1]), [5, 0, 0, 1])
    (drive,) = said["rig_trajectories"]
    for frames in drive["cameras_frame_timestamps_us"].values():
        assert [end - start for start, end in frames[1:]] == [30_000] * len(frames[1:])
        assert len(frames) > 1


def test_a_track_sent_back_leaves_its_object_where_it_is(archive, street):
    with zipfile.ZipFile(archive) as found:
        tracks = json.loads(found.read("sequence_tracks.json"))["street"]
    data = tracks["tracks_data"]
    assert (data["tracks_id"], data["tracks_flags"]) == (["car"], ["CONTROLLABLE"])
    assert tracks["cuboidtracks_data"]["cuboids_dims"] == [[4.0, 2.0, 1.5]]
    assert data["tracks_timestamps_us"][0] == [START_US + STEP_US * frame for frame in (0, 1, 2, 4)]
    pose = np.eye(4)
    x, y, z, *turn = data["tracks_poses"][0][2]
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat(turn).as_matrix(), (x, y, z)
    assert np.allclose(pose[:3, 3], [10, 1.5, 1])
    assert np.allclose(pose[:3, 0], [np.cos(0.4), np.sin(0.4), 0])
    asked, placed = request_for(timed_views()[8]), request_for(timed_views()[8])
    place(placed, "car", pose)
    pictures = [picture(street, view_of(one, street.rig), edits_of(one, street)).astype(int) for one in (asked, placed)]
    assert np.abs(pictures[0] - pictures[1]).max() <= 1  # float32 of the message


def test_equal_scenes_give_equal_bytes(archive, street, tmp_path):
    write_artifact(tmp_path / "again.usdz", street, VIEWS, FROM)
    assert (tmp_path / "again.usdz").read_bytes() == archive.read_bytes()


def test_a_car_that_is_none(street, tmp_path):
    with pytest.raises(ValueError, match="length, width and height"):
        write_artifact(tmp_path / "a.usdz", street, VIEWS, FROM, car=(1.0, 2.0))
    assert not list(tmp_path.iterdir())


def apart(
    frames: int, rate: float, stamped: bool, readout: float, later: float = 0.04
) -> tuple[ServedScene, RecordedViews]:
    """A log whose second camera fires ``later`` seconds after the first; rows are read in ``readout`` seconds."""
    whole = (frames - 1) / rate + abs(later)
    views = []
    for view in street_views(cameras=(0, 1))[: 2 * frames]:
        seconds = view.indices[0] / rate + later * view.indices[1] - min(later, 0.0)
        shutter = Shutter(torch.zeros(3), torch.zeros(3), seconds=readout) if readout else None
        camera = replace(view.camera, shutter=shutter)
        clock = {"seconds": seconds, "stamp": 1000 * START_US + round(1e9 * seconds)} if stamped else {}
        views.append(replace(view, time=seconds / whole, camera=camera, **clock))
    recorded = RecordedViews(tuple(views), (), None if stamped else rate)
    return ServedScene("apart", stored_street(), rig_of(recorded, None, frame_rate=rate)), recorded


@pytest.mark.parametrize("stamped", [True, False], ids=["clock", "no clock"])
@pytest.mark.parametrize(
    ("frames", "rate", "readout", "later"),
    [(3, 10.0, 0.0, 0.04), (2, 2.0, 0.0, 0.0), (4, 30.0, 0.0, 0.04), (5, 10.0, 0.03, 0.04), (3, 2.0, 0.03, -0.04)],
)
def test_a_rollout_may_start_at_any_frame_with_any_shutter(stamped, frames, rate, readout, later, tmp_path):
    """AlpaSim asks for the pose at the end of a frame, and up to a shutter's duration before."""
    served, views = apart(frames, rate, stamped, readout, later)
    write_artifact(tmp_path / "a.usdz", served, views, FROM)
    with zipfile.ZipFile(tmp_path / "a.usdz") as found:
        (drive,) = json.loads(found.read("rig_trajectories.json"))["rig_trajectories"]
    stamps = drive["T_rig_world_timestamps_us"]
    assert stamps == sorted(set(stamps))
    assert len(drive["cameras_frame_timestamps_us"]) == 2
    for number, listed in enumerate(drive["cameras_frame_timestamps_us"].values()):
        assert listed == sorted(listed)
        for start, end in listed:
            assert start < end
            assert all(stamps[0] <= end - shutter <= stamps[-1] for shutter in range(0, 50_001, 10_000))
        # Every image but those at both ends is one to start with.
        ends = [end for _, end in listed]
        for frame in range(frames):
            middle = stamps[0] + round(1e6 * (frame / rate + later * number))
            inside = stamps[0] + 50_000 <= middle + 5e5 * readout <= stamps[-1]
            assert inside == any(abs(end - middle - 5e5 * readout) <= 1 for end in ends)


@pytest.mark.parametrize(("rate", "readout", "camera"), [(30.0, 0.0, 0), (10.0, 0.0, 1), (2.0, 0.03, 0)])
def test_a_log_that_is_too_short_to_start_in_says_so(rate, readout, camera, tmp_path):
    served, views = apart(2, rate, True, readout)
    with pytest.raises(ValueError, match=f"50 ms or more behind the first pose.*camera {camera} has none, train on"):
        write_artifact(tmp_path / "a.usdz", served, views, FROM)
    assert not list(tmp_path.iterdir())
