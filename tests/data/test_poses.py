"""Many poses are checked as one is."""

from pathlib import Path

import pytest
import torch

from sparsestreet.data.poses import are_rigid, check_rigid
from sparsestreet.data.problems import LogError

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
