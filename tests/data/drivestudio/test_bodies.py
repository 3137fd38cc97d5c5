"""Body poses come off the disk turned to the world, for the frames that have a box."""

import json
from pathlib import Path

import joblib
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sparsestreet.data.drivestudio import DriveStudioReader
from sparsestreet.data.problems import LogError
from sparsestreet.geometry import quaternions as quat
from tests.data.drivestudio.folders import TURN_LEFT, WORLD_FROM_OPENCV, make_nuscenes, make_waymo, write_json

FRAMES = 4
IN_WORLD = {
    make_nuscenes: WORLD_FROM_OPENCV,
    # The world of this flavor is turned.
    make_waymo: TURN_LEFT @ WORLD_FROM_OPENCV,
}
FLAVORS = pytest.mark.parametrize("make", [make_nuscenes, make_waymo])


def person(frames: int = FRAMES) -> dict:
    """As DriveStudio writes it: valid at frames 1, 2 and 3, at 1 and 2 seen by camera 1, at 3 by none."""
    drawn = Rotation.random(frames * 24, random_state=0)  # pyright: ignore[reportCallIssue]
    rotations = drawn.as_matrix().reshape(frames, 24, 3, 3)
    valid = np.isin(np.arange(frames), [1, 2])
    return {
        "smpl": {
            "global_orient": torch.tensor(rotations[:, :1], dtype=torch.float32),
            "body_pose": torch.tensor(rotations[:, 1:], dtype=torch.float32),
            "betas": torch.arange(10.0) + 10 * torch.arange(frames)[:, None],
        },
        "selected_cam_idx": torch.tensor(np.where(valid, 1, -1)),
        "matched_mask": torch.tensor(valid),
        "must_appear_mask": torch.tensor(valid),
        "valid_mask": torch.tensor(np.isin(np.arange(frames), [1, 2, 3])),
    }


def write_people(root: Path, people: dict) -> Path:
    (root / "humanpose").mkdir()
    joblib.dump(people, root / "humanpose/smpl.pkl")
    return root


@FLAVORS
def test_poses_are_in_the_world(make, tmp_path):
    stored = person()
    (track,) = DriveStudioReader(write_people(make(tmp_path, frames=FRAMES), {0: stored})).read().tracks
    assert track.body.valid.tolist() == [False, True, True, False]
    assert track.body.shape.tolist() == [10 + k for k in range(10)]  # of frame 1
    found = quat.to_matrix(track.body.rotations[1:3]).numpy()
    roots = IN_WORLD[make] @ stored["smpl"]["global_orient"][1:3, 0].numpy()
    np.testing.assert_allclose(found[:, 0], roots, atol=1e-5)  # float32
    np.testing.assert_allclose(found[:, 1:], stored["smpl"]["body_pose"][1:3].numpy(), atol=1e-5)


def test_a_window_takes_its_own_frames(tmp_path):
    root = write_people(make_nuscenes(tmp_path, frames=FRAMES), {0: person()})
    whole, part = (DriveStudioReader(root, first_frame=first).read().tracks[0] for first in (0, 2))
    assert part.body.valid.tolist() == [True, False]
    torch.testing.assert_close(part.body.rotations[0], whole.body.rotations[2], atol=0, rtol=0)
    assert part.body.shape[0] == 20
    assert DriveStudioReader(root, first_frame=3).read().tracks[0].body is None


def test_without_the_folder_or_when_asked_there_are_no_bodies(tmp_path):
    root = make_nuscenes(tmp_path, frames=FRAMES)
    assert DriveStudioReader(root).read().tracks[0].body is None
    write_people(root, {})  # an object without a person
    assert DriveStudioReader(root).read().tracks[0].body is None
    joblib.dump({0: person()}, root / "humanpose/smpl.pkl")
    assert DriveStudioReader(root, bodies=False).read().tracks[0].body is None
    assert DriveStudioReader(root).read().tracks[0].body is not None


def test_a_pose_without_a_box_is_left_out_with_a_note(tmp_path):
    root = write_people(make_nuscenes(tmp_path, frames=FRAMES), {0: person()})
    info = json.loads((root / "instances/instances_info.json").read_text())
    notes = info["0"]["frame_annotations"]
    info["0"]["frame_annotations"] = {name: [column[0], *column[2:]] for name, column in notes.items()}
    write_json(root / "instances/instances_info.json", info)
    log = DriveStudioReader(root).read()
    assert log.tracks[0].frames.tolist() == [0, 2, 3]
    assert log.tracks[0].body.valid.tolist() == [False, True, False]
    assert any("1 body poses are of frames in which the person has no box" in note for note in log.notes)


def broken(change: str) -> dict:
    stored = person()
    if change == "short":
        return {0: person(FRAMES - 1)}
    if change == "unknown":
        return {5: stored}
    if change == "no rotation":
        stored["smpl"]["body_pose"][2, 4] *= 1.1
    if change == "no cameras":
        del stored["selected_cam_idx"]
    if change == "camera":
        stored["selected_cam_idx"][2] = 7
    return {0: stored}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("short", r"the body of object 0 has the shapes .*\(3, 24, 3, 3\).*a log of 4 frames needs"),
        ("unknown", r"objects \['5'\] that instances_info.json does not describe"),
        ("no rotation", "object 0 at frame 2 has joints that are no rotations"),
        ("no cameras", "KeyError.*selected_cam_idx"),
        ("camera", "002_7.txt: the file is missing"),
    ],
)
def test_what_is_wrong_is_found_before_anything_is_read(change, message, tmp_path):
    reader = DriveStudioReader(write_people(make_nuscenes(tmp_path, frames=FRAMES), broken(change)))
    with pytest.raises(LogError, match=message):
        reader.read()
    assert len(reader.check()) == 1


def test_a_hostile_file_and_a_missing_one_are_refused(tmp_path):
    class Hostile:
        def __reduce__(self):
            return Path.touch, (tmp_path / "it_ran",)

    root = write_people(make_nuscenes(tmp_path / "log", frames=FRAMES), {0: Hostile()})
    with pytest.raises(LogError, match="must be a pickle of plain values and arrays"):
        DriveStudioReader(root).read()
    assert not (tmp_path / "it_ran").exists()
    (root / "humanpose/smpl.pkl").unlink()
    with pytest.raises(LogError, match=r"smpl.pkl: the file is missing"):
        DriveStudioReader(root).read()
