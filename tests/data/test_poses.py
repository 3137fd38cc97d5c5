"""Many poses are checked as one is."""

import math
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation, Slerp

from sparsestreet.data.poses import PosePath, are_rigid, check_rigid, untwisted
from sparsestreet.data.problems import LogError
from sparsestreet.geometry.cameras import inverse, transform_points
from tests.conftest import unchecked

TURN = torch.tensor([[0, -1, 0, 3], [1, 0, 0, 4], [0, 0, 1, 5], [0, 0, 0, 1]], dtype=torch.float64)


def _changed(row: int, column: int, value: float) -> torch.Tensor:
    pose = TURN.clone()
    pose[row, column] = value
    return pose


@pytest.mark.parametrize(
    ("pose", "rigid"),
    [
        (TURN, True),
        (_changed(2, 2, 1 + 0.4e-4), True),
        (_changed(2, 2, 1 + 0.6e-4), False),
        (_changed(2, 2, -1.0), False),
        (_changed(3, 3, 1.1), False),
        (_changed(0, 3, torch.nan), False),
        (_changed(0, 3, torch.inf), False),
        (_changed(0, 0, torch.nan), False),
    ],
    ids=["turn", "nearly", "scaled", "mirrored", "last row", "no place", "nowhere", "no rotation"],
)
def test_many_poses_are_rigid_if_each_is(pose, rigid):
    assert are_rigid(torch.stack([TURN, pose, TURN])) == rigid
    if rigid:
        check_rigid(pose, Path("poses"), "it")
    else:
        with pytest.raises(LogError):
            check_rigid(pose, Path("poses"), "it")


START = 1_532_402_927_600_000_251
"""Nanoseconds since 1970: a double cannot tell neighbors from each other."""


def _random_path(count: int, *, seed: int = 0, angle: float = 2.0) -> PosePath:
    """Uneven steps, and turns of up to ``angle`` radians between them."""
    random = np.random.default_rng(seed)
    turns = random.standard_normal((count, 3))
    turns *= random.uniform(0, angle, (count, 1)) / np.linalg.norm(turns, axis=1, keepdims=True)
    rotation, rotations = Rotation.identity(), []
    for turn in turns:
        rotation = rotation * Rotation.from_rotvec(turn)
        rotations.append(rotation.as_matrix())
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = np.stack(rotations), random.uniform(-1e5, 1e5, (count, 3))
    stamps = START + np.cumsum(random.integers(1, 200_000_000, count))
    return PosePath(torch.from_numpy(stamps), torch.from_numpy(poses))


@pytest.mark.parametrize("angle", [1e-5, 0.03, 3.1])
def test_between_poses_rotations_are_scipys_slerp_and_translations_a_line(angle: float):
    path = _random_path(9, angle=angle)
    first, last = int(path.stamps[0]), int(path.stamps[-1])
    wanted = torch.from_numpy(np.random.default_rng(1).integers(first, last, 200))
    found = path.at(wanted)
    # Since the first stamp: scipy counts in doubles.
    known, asked = (path.stamps - first).double().numpy(), (wanted - first).double().numpy()
    turned = Slerp(known, Rotation.from_matrix(path.poses[:, :3, :3].numpy()))(asked).as_matrix()
    assert np.abs(found[:, :3, :3].numpy() - turned).max() < 1e-12  # rounding of doubles
    for axis in range(3):
        line = np.interp(asked, known, path.poses[:, axis, 3].numpy())
        assert np.abs(found[:, axis, 3].numpy() - line).max() < 1e-9  # of 1e5 m
    assert torch.equal(found[:, 3], torch.tensor([0.0, 0, 0, 1], dtype=torch.float64).expand(200, 4))


def test_at_its_own_stamps_a_path_has_its_own_poses():
    path = _random_path(7)
    torch.testing.assert_close(path.at(path.stamps), path.poses, atol=1e-12, rtol=1e-12)


def test_nanoseconds_of_an_epoch_are_told_apart():
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[1, 0, 3] = 4.0
    path = PosePath(torch.tensor([START, START + 4]), poses)
    assert path.at(torch.tensor([START + 1, START + 3]))[:, 0, 3].tolist() == [1.0, 3.0]


def test_a_turn_by_hand():
    """A quarter turn to the left in one second while driving 10 m."""
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[1, :3, :3] = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    poses[1, 0, 3] = 10.0
    pose = PosePath(torch.tensor([0, 1_000_000_000]), poses).at(torch.tensor([300_000_000]))[0]
    cosine, sine = math.cos(0.3 * math.pi / 2), math.sin(0.3 * math.pi / 2)
    expected = torch.tensor([[cosine, -sine, 0, 3], [sine, cosine, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    torch.testing.assert_close(pose, expected.double(), atol=1e-7, rtol=0)  # of the float32 literals


@pytest.mark.parametrize("outside", [-1, 3_000_000_001])
def test_outside_of_the_path_nothing_is_known(outside: int):
    path = PosePath(torch.tensor([0, 1_000_000_000, 3_000_000_000]), torch.eye(4, dtype=torch.float64).repeat(3, 1, 1))
    with pytest.raises(ValueError, match=r"1 of 2 instants lie up to 1 ns outside .* max_extrapolation"):
        path.at(torch.tensor([500, outside]))


def test_a_little_outside_the_last_velocity_goes_on():
    poses = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    poses[:, 0, 3] = torch.tensor([0.0, 1.0, 3.0])
    turn = Rotation.from_rotvec([0, 0, 0.2]).as_matrix()
    poses[2, :3, :3] = torch.from_numpy(turn)
    path = PosePath(torch.tensor([0, 100, 200]), poses, max_extrapolation=50)
    before, after = path.at(torch.tensor([-50, 250]))
    assert (before[0, 3], after[0, 3]) == (-0.5, 4.0)
    assert np.abs(Rotation.from_matrix(after[:3, :3].numpy()).as_rotvec() - [0, 0, 0.3]).max() < 1e-12
    with pytest.raises(ValueError, match="outside"):
        path.at(torch.tensor([251]))


def test_a_path_of_one_pose_stands_still():
    path = PosePath(torch.tensor([5]), torch.eye(4, dtype=torch.float64)[None], max_extrapolation=2)
    assert torch.equal(path.at(torch.tensor([3, 5, 7])), torch.eye(4, dtype=torch.float64).expand(3, 4, 4))
    assert path.at(torch.zeros(0, dtype=torch.int64)).shape == (0, 4, 4)


@pytest.mark.parametrize(
    ("stamps", "poses", "said"),
    [
        ([0, 0], torch.eye(4).repeat(2, 1, 1), "stamps must increase, but 0 follows 0 at place 1"),
        ([4, 7, 6], torch.eye(4).repeat(3, 1, 1), "but 6 follows 7 at place 2"),
        ([4, 7, 9], torch.eye(4).repeat(2, 1, 1), "a pose for each stamp, got 3 stamps and 2 poses"),
        ([], torch.eye(4).repeat(0, 1, 1), "at least one pose"),
        ([4, 7], torch.eye(4).repeat(2, 1, 1) * torch.nan, "pose 0 holds NaN or infinity"),
    ],
)
def test_a_path_that_cannot_be(stamps: list[int], poses: torch.Tensor, said: str):
    with unchecked(), pytest.raises(ValueError, match=said):
        PosePath(torch.tensor(stamps, dtype=torch.int64), poses.double())


def test_points_of_a_turning_sensor_come_back_to_the_wall():
    """A wall, seen from a car that drives and turns: each point in the sensor's frame of its own instant."""
    path = _random_path(6, seed=3, angle=0.2)
    random = np.random.default_rng(4)
    wall = torch.from_numpy(random.uniform(-50, 50, (500, 3)))
    stamps = torch.from_numpy(random.integers(int(path.stamps[0]), int(path.stamps[-1]), 500))
    seen = torch.stack(
        [
            transform_points(inverse(path.at(stamp[None])[0]), point[None])[0]
            for stamp, point in zip(stamps, wall, strict=True)
        ]
    )
    assert torch.abs(untwisted(seen, stamps, path) - wall).max() < 1e-9  # of poses 1e5 m away
    at = int(stamps[7])
    one_instant = untwisted(seen, stamps, path, at=at)
    expected = transform_points(inverse(path.at(torch.tensor([at]))[0]), wall)
    assert torch.abs(one_instant - expected).max() < 1e-9


def test_points_and_stamps_must_belong_together():
    with unchecked(), pytest.raises(ValueError, match="a stamp for each point, got 3 points and 2 stamps"):
        untwisted(torch.zeros(3, 3), torch.zeros(2, dtype=torch.int64), _random_path(2))


def test_chunks_change_nothing_and_a_large_sweep_is_fast():
    path = _random_path(20, angle=0.05)
    count = 200_000
    random = np.random.default_rng(5)
    points = torch.from_numpy(random.uniform(-80, 80, (count, 3)).astype(np.float32))
    stamps = torch.from_numpy(random.integers(int(path.stamps[0]), int(path.stamps[-1]), count))
    began = time.process_time()
    moved = untwisted(points, stamps, path)
    assert time.process_time() - began < 1  # 0.1 s alone; a loop over points takes ten
    some = torch.cat((torch.arange(0, count, 997), torch.arange(16_380, 16_390)))  # and around the end of a chunk
    assert torch.equal(moved[some], untwisted(points[some], stamps[some], path))


def test_motion_during_a_readout():
    """Of a camera that drives 10 m/s along its z axis and turns right (about y, which is down)."""
    turn = torch.from_numpy(Rotation.from_rotvec([[0, 0, 0], [0, 0.4, 0]]).as_matrix())
    poses = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    poses[:2, :3, :3] = turn
    poses[1:, 2, 3] = torch.tensor([10.0, 90.0])  # another speed later, which no readout in the first second sees
    path = PosePath(torch.tensor([0, 1_000_000_000, 2_000_000_000]), poses)
    translation, rotation = path.motion_during(500_000_000, 40_000_000)
    # In the camera's frame at the middle, turned by 0.2 rad: ahead is partly to the left.
    expected = torch.tensor([-0.4 * math.sin(0.2), 0.0, 0.4 * math.cos(0.2)])
    torch.testing.assert_close(translation, expected, atol=1e-6, rtol=0)  # float32
    torch.testing.assert_close(rotation, torch.tensor([0.0, 0.016, 0.0]), atol=1e-6, rtol=0)
    with pytest.raises(ValueError, match="outside of the poses"):
        path.motion_during(19_999_999, 40_000_000)
    assert path.motion_during(980_000_000, 40_000_000)[0].norm() == pytest.approx(0.4, abs=1e-6)
