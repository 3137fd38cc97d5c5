"""A sequence that was written in PandaSet's layout is read as it was planned."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from PIL import Image

from sparsestreet.data.pandaset import PandaSetReader
from sparsestreet.data.pandaset.tables import CAMERA_FROM_LIDAR
from tests.data.pandaset.pickles import table, write
from tests.data.pandaset.write import CAMERAS, PARKED, TWIN, UUID, PandaPlan, cuboids, sweep, write_sequence
from tests.typed import there

PLAN = PandaPlan()


@pytest.fixture
def sequence(tmp_path) -> Path:
    return write_sequence(tmp_path)


@pytest.mark.parametrize(("era", "ending"), [("old", ".pkl.gz"), ("new", ".pkl")])
def test_images_have_poses_and_stamps_of_their_own(era, ending, tmp_path):
    root = write_sequence(tmp_path, era=era, ending=ending)
    recording = PandaSetReader(root=root, cameras=list(CAMERAS)).recording()
    assert [(shot.frame, shot.camera) for shot in recording.shots] == [(f, c) for f in range(4) for c in range(2)]
    assert there(recording.frame_stamps) == tuple(PLAN.stamps.tolist())
    for shot in recording.shots:
        camera = PLAN.cameras[shot.camera]
        assert (shot.stamp, shot.stem) == (PLAN.image_stamp(shot.frame, camera), f"{shot.frame:02d}")
        assert (shot.shutter, shot.exposure) == (None, None)
        expected = PLAN.world_from_camera(shot.frame, camera)
        np.testing.assert_allclose(shot.world_from_camera.numpy(), expected, atol=1e-12)
        error = recording.read_image(shot).numpy().astype(int) - PLAN.image(shot.frame, camera)
        assert np.abs(error).mean() < 2  # JPEG
        # Where pixel centers lie is not documented: as written.
        intrinsics = recording.rig[shot.camera].intrinsics.numpy()
        np.testing.assert_allclose(intrinsics, camera.intrinsics, rtol=1e-6)


@pytest.mark.parametrize(("era", "ending"), [("old", ".pkl.gz"), ("new", ".pkl")])
def test_returns_stand_where_they_were_less_those_of_the_own_car(era, ending, tmp_path):
    sweeps = there(PandaSetReader(root=write_sequence(tmp_path, era=era, ending=ending)).recording().sweeps)
    for frame, one in sweeps.items():
        columns = sweep(PLAN, frame)
        points = one.read().numpy()
        np.testing.assert_array_equal(points, np.stack([columns[axis] for axis in "xyz"], -1)[:-1])
        np.testing.assert_array_equal(points[:-1], PLAN.world_points(frame))
        assert one.stamp == PLAN.stamps[frame]
        stood = PLAN.world_from_vehicle(PLAN.stamps[frame]) @ PLAN.vehicle_from_lidar
        # What the publisher says of where the front camera is on the lidar is rounded.
        np.testing.assert_allclose(there(one.origin).numpy(), stood[:3, 3], rtol=0, atol=1e-3)


def test_a_box_has_the_stamp_at_which_the_beam_passed_it(sequence):
    boxes = {one.name: one for one in there(PandaSetReader(root=sequence).recording().boxes)}
    assert set(boxes) == {UUID, PARKED}
    car = boxes[UUID]
    assert (car.class_name, car.frames.tolist()) == ("Car", [0, 1, 2, 3])
    passed = [PLAN.passing(frame) for frame in range(4)]
    # The turn is fitted to 60 columns from a lidar that itself moves 1 m: the car does 2 cm in 2 ms.
    np.testing.assert_allclose(np.array(there(car.stamps)) - passed, 0, atol=2e6)
    np.testing.assert_allclose(car.poses, PLAN.world_from_box(np.array(passed)), atol=1e-9)
    np.testing.assert_allclose(car.sizes, np.tile(PLAN.box_size, (4, 1)))


def test_a_lidar_that_turns_the_other_way_is_told_by_its_returns(tmp_path):
    """Mirrored in time about the middle of the sweep: a box on the left is then passed late."""
    root, late = write_sequence(tmp_path), write_sequence(tmp_path / "mirrored")
    for frame in range(4):
        columns = sweep(PLAN, frame)
        columns["t"] = 2 * PLAN.stamps[frame] / 1e9 - columns["t"]
        write(late / "lidar" / f"{frame:02d}.pkl.gz", table(columns))
        aside = cuboids(PLAN, frame)
        lidar = PLAN.world_from_vehicle(PLAN.stamps[frame]) @ PLAN.vehicle_from_lidar
        for name, place in zip("xyz", lidar @ [10.0, -1.0, 0.0, 1.0], strict=False):
            aside[f"position.{name}"][1] = place
        for one in (root, late):
            write(one / "annotations/cuboids" / f"{frame:02d}.pkl.gz", table(aside))
    delays = []
    for one in (root, late):
        (car,) = (box for box in there(PandaSetReader(root=one).recording().boxes) if box.name == UUID)
        delays.append((np.array(there(car.stamps)) - PLAN.stamps) / 1e6)
    # Nearly a quarter of 100 ms: 84 degrees left of ahead.
    np.testing.assert_allclose(delays[0], -100 * 84.3 / 360, atol=2)
    np.testing.assert_allclose(delays[1], 100 * 84.3 / 360, atol=2)


def test_of_twins_one_stays_and_it_is_counted(sequence):
    notes = " | ".join(PandaSetReader(root=sequence).recording().notes)
    assert "4 boxes of the lidar that looks ahead are left out" in notes
    assert "1 of 2 objects are marked as standing all the time" in notes
    lone = cuboids(PLAN, 3)
    write(
        sequence / "annotations/cuboids/03.pkl.gz",
        table(
            {
                name: [values[0], values[2]] if isinstance(values, list) else values[[0, 2]]
                for name, values in lone.items()
            }
        ),
    )
    boxes = {one.name: one for one in there(PandaSetReader(root=sequence).recording().boxes)}
    assert (boxes[UUID].frames.tolist(), boxes[TWIN].frames.tolist()) == ([0, 1, 2], [3])
    # Of the lidar that does not turn: at the stamp of the sweep.
    assert there(boxes[TWIN].stamps) == (PLAN.stamps[3],)


def test_it_reads_as_a_log(sequence):
    log = PandaSetReader(root=sequence.parent, scene=1, cameras=list(CAMERAS)).read()
    assert (log.name, log.num_frames, log.num_cameras, len(log.sweeps), len(log.tracks)) == ("001", 4, 2, 4, 2)
    assert [round(there(view.seconds), 6) for view in log.views[:4]] == [0.0, -0.026, 0.1, 0.074]
    assert log.frames[0].image.shape == (24, 32, 3)
    assert PandaSetReader(root=sequence).check() == []
    assert log.frames[0].camera.position.tolist() == [0.0, 0.0, 0.0]


def test_a_window_a_camera_and_a_width(sequence):
    log = PandaSetReader(root=sequence, cameras=["left_camera"], first_frame=1, last_frame=2, width=16).read()
    assert (log.num_frames, log.frames[0].image.shape) == (2, (12, 16, 3))
    assert log.frames[0].stamp == PLAN.stamps[1] - 26_000_000
    assert {tuple(track.frames.tolist()) for track in log.tracks} == {(0, 1)}
    with pytest.raises(ValueError, match="frames 0 to 4 are not within"):
        PandaSetReader(root=sequence, last_frame=4).read()
    with pytest.raises(ValueError, match="must be different ones of the log's"):
        PandaSetReader(root=sequence, cameras=["front"]).read()


def test_rows_of_the_own_car_are_marked_in_the_back_camera(sequence):
    (sequence / "camera/left_camera").rename(sequence / "camera/back_camera")
    front, back = PandaSetReader(root=sequence, cameras=["front_camera", "back_camera"]).read().frames[:2]
    # 260 of 1080 rows are 5.8 of 24.
    assert there(back.ego).sum(1).tolist() == [0] * 18 + [32] * 6
    assert front.ego is None
    given = sequence / "masks/ego/back_camera"
    given.mkdir(parents=True)
    for frame in range(4):
        Image.fromarray(np.eye(24, 32, dtype=np.uint8) * 255).save(given / f"{frame:02d}.png")
    reader = PandaSetReader(root=sequence, cameras=["back_camera"], masks=sequence / "masks", width=16)
    assert reader.check() == []
    # What somebody made counts in place of the rows; at half its size, every pixel that the diagonal touches.
    assert there(reader.read().frames[0].ego).diagonal().all()
    assert int(there(reader.read().frames[0].ego).sum()) < 40


def test_without_lidar_boxes_have_the_stamps_of_their_instants(sequence):
    recording = PandaSetReader(root=sequence, lidar=False).recording()
    assert recording.sweeps is None
    assert {there(one.stamps) for one in there(recording.boxes)} == {tuple(PLAN.stamps.tolist())}
    assert any(note.startswith("boxes have the stamps of their sweeps") for note in recording.notes)


def test_without_boxes(sequence):
    for path in (sequence / "annotations/cuboids").iterdir():
        path.unlink()
    (sequence / "annotations/cuboids").rmdir()
    assert PandaSetReader(root=sequence).recording().boxes is None


def test_a_sequence_is_named(sequence):
    root = sequence.parent
    other = root / "011" / "camera" / "front_camera"
    other.mkdir(parents=True)
    (other / "poses.json").write_text("[]")
    assert PandaSetReader(root=root, scene="001").recording().name == "001"
    with pytest.raises(ValueError, match="there are 2 sequences in"):
        PandaSetReader(root=root).recording()
    with pytest.raises(ValueError, match="0 of 2 sequences are 016"):
        PandaSetReader(root=root, scene=16).recording()
    with pytest.raises(ValueError, match="no sequence of PandaSet is in"):
        PandaSetReader(root=root / "none").recording()


def test_its_hash_is_of_what_it_reads(sequence):
    before = PandaSetReader(root=sequence).data_hash()
    (sequence / "lidar/poses.json").write_text("[]")
    assert PandaSetReader(root=sequence).data_hash() == before
    poses = json.loads((sequence / "camera/front_camera/poses.json").read_text())
    poses[0]["position"]["x"] += 1
    (sequence / "camera/front_camera/poses.json").write_text(json.dumps(poses))
    assert PandaSetReader(root=sequence).data_hash() != before


def test_the_lidar_is_mounted_as_the_published_calibration_says():
    """Pandar64's ahead, -y, is the optical axis of the front camera; its up is up in the image."""
    default = Path(__file__).resolve().parents[4] / "shared" / "data"
    root = Path(os.environ.get("SPARSESTREET_DATA", default)) / "pandaset_static_calibration"
    if not root.is_dir():
        pytest.skip(f"no calibration at {root}: set SPARSESTREET_DATA to the folder of pandaset_static_calibration")
    front = yaml.safe_load((root / "static_extrinsic_calibration.yaml").read_text())["front_camera"]
    told = front["extrinsic"]["transform"]
    w, x, y, z = (told["rotation"][axis] for axis in "wxyz")
    turn = 2 * np.outer([x, y, z], [x, y, z]) + (2 * w * w - 1) * np.eye(3)
    turn += 2 * w * np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    np.testing.assert_allclose(CAMERA_FROM_LIDAR[:3, :3].numpy(), turn, atol=1e-9)
    assert CAMERA_FROM_LIDAR[:3, 3].tolist() == pytest.approx([told["translation"][axis] for axis in "xyz"])
    ahead = CAMERA_FROM_LIDAR[:3, :3] @ torch.tensor([0.0, -1, 0], dtype=torch.float64)
    assert ahead[2] > 0.999
    assert CAMERA_FROM_LIDAR[1, 2] < -0.999
    assert front["intrinsic"]["K"][:3] == [1970.0131, 0, 970.0002]
