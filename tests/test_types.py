"""What the frozen values that rooms hand to each other refuse to answer."""

import math
from dataclasses import replace

import pytest
import torch

from sparsestreet.types import Camera, Frame, Rendering, Sweep, Track
from tests.scene.street import view_at


def test_a_camera_stands_where_its_axes_meet():
    """It looks along world x from (3, -1, 2): its own x is world -y, its y is world -z."""
    rotation = torch.tensor([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    pose = torch.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, torch.tensor([-1.0, 2.0, -3.0])
    assert Camera(pose, torch.eye(3), 2, 2).position.tolist() == [3.0, -1.0, 2.0]


def test_only_a_recorded_view_has_both_indices():
    """0 is an index: it is not taken for none."""
    recorded = replace(view_at(0.0), frame_index=0, camera_index=0)
    assert recorded.indices == (0, 0)
    for beside in (replace(recorded, frame_index=None), replace(recorded, camera_index=None)):
        with pytest.raises(ValueError, match="take the views of a log"):
            _ = beside.indices


def test_the_path_of_an_object_is_as_long_as_its_steps():
    """3, 4 and 0 m along the axes, then 5 m across two of them; turning is no way."""
    poses = torch.eye(4, dtype=torch.float64).repeat(5, 1, 1)
    poses[:, :3, 3] = torch.tensor([[7.0, 1, 1], [10, 1, 1], [10, 5, 1], [10, 5, 1], [10, 2, 5]])
    poses[1, :2, :2] = torch.tensor([[0.0, -1], [1, 0]])
    assert Track("0", "Vehicle", torch.arange(5), poses, torch.ones(3)).path_length == 12.0


def test_screen_gradients_are_there_after_a_backward_pass_only():
    offsets = torch.zeros(3, 2, requires_grad=True)
    image = torch.zeros(4, 5)
    rendering = Rendering(torch.zeros(4, 5, 3), image, image, torch.zeros(3), offsets)
    with pytest.raises(ValueError, match="screen_gradients=True"):
        _ = rendering.screen_gradients
    cotangent = torch.arange(6.0).reshape(3, 2)
    (offsets * cotangent).sum().backward()
    assert torch.equal(rendering.screen_gradients, cotangent)


TURN = torch.tensor([[0.6, -0.8, 0, 7], [0.8, 0.6, 0, -2], [0, 0, 1, 1], [0, 0, 0, 1]], dtype=torch.float64)


def boxes(**changes) -> Track:
    given = {
        "frames": torch.tensor([2, 3, 7]),
        "world_from_object": TURN.repeat(3, 1, 1),
        "size": torch.tensor([4.0, 2.0, 1.5]),
        "times": torch.tensor([0.1, 0.2, 0.9], dtype=torch.float64),
    }
    return Track("it", "car", **{**given, **changes})


def posed(value: float, row: int, column: int) -> torch.Tensor:
    poses = TURN.repeat(3, 1, 1)
    poses[1, row, column] = value
    return poses


WRONG = {
    "a size of 0": ({"size": torch.tensor([4.0, 0.0, 1.5])}, "side 1 has 0.0"),
    "a negative size": ({"size": torch.tensor([-4.0, 2.0, 1.5])}, "side 0 has -4.0"),
    "a size of NaN": ({"size": torch.tensor([4.0, 2.0, math.nan])}, "side 2 has nan"),
    "an infinite size": ({"size": torch.tensor([math.inf, 2.0, 1.5])}, "side 0 has inf"),
    "a pose of NaN": ({"world_from_object": posed(math.nan, 0, 3)}, "must be finite, but box 1 has nan"),
    "an infinite pose": ({"world_from_object": posed(-math.inf, 2, 3)}, "must be finite, but box 1 has -inf"),
    "a scaled pose": (
        {"world_from_object": posed(1.1, 2, 2)},
        "must be a rotation and a translation, .* box 1 has 0.21",
    ),
    "a mirrored pose": ({"world_from_object": posed(-1.0, 2, 2)}, "must be a rotation and a translation, .* box 1"),
    "a last row": ({"world_from_object": posed(2.0, 3, 3)}, "must be a rotation and a translation, .* box 1 has 1.0"),
    "a frame twice": ({"frames": torch.tensor([2, 7, 7])}, "the frames of object it .* must increase, but box 2 has 7"),
    "frames out of order": ({"frames": torch.tensor([2, 1, 7])}, "must increase, but box 1 has 1"),
    "a time of NaN": ({"times": torch.tensor([0.1, math.nan, 0.9]).double()}, "the times of .* box 1 has nan"),
    "times that fall": ({"times": torch.tensor([0.1, 0.9, 0.2]).double()}, "the times of .* box 2 has 0.2"),
}


@pytest.mark.parametrize("name", WRONG)
def test_boxes_that_cannot_be_are_refused_by_object_and_box(name):
    boxes()
    changes, said = WRONG[name]
    with pytest.raises(ValueError, match=said) as caught:
        boxes(**changes)
    assert "object it (car)" in str(caught.value)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_times_that_are_no_numbers_are_refused(value):
    view = view_at(0.25)
    image = torch.zeros(view.camera.height, view.camera.width, 3, dtype=torch.uint8)
    frame = Frame.of(view, image=image)
    sweep = Sweep(0, 0.25, torch.zeros(1, 3), torch.zeros(1, 3), torch.zeros(1, dtype=torch.bool))
    for one in (view, frame, sweep):
        assert replace(one, time=-3.0, seconds=-1.0).time == -3.0  # beside the log is a time
        for name in ("time", "seconds"):
            with pytest.raises(ValueError, match="times must be finite numbers, got time"):
                replace(one, **{name: value})
