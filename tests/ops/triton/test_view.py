"""The table of a camera is made once for equal numbers, and anew for any other."""

import dataclasses

import pytest
import torch

from sparsestreet.ops import SplatSettings, splat
from sparsestreet.ops.triton.view import KernelView
from sparsestreet.ops.validate import check_camera
from sparsestreet.types import Camera, Shutter
from tests.ops.scenes import camera, cast, device_of, random_gaussians

DEVICE = device_of("triton")
LENS = torch.tensor([0.1, 0.0, 0.0, 0.0, 0.0])


def seen() -> Camera:
    """With tensors that no other test holds."""
    view = camera(21, 9)
    shutter = Shutter(torch.full((3,), 0.1), torch.full((3,), 0.01))
    return dataclasses.replace(view, distortion=LENS.clone(), shutter=shutter)


def table_of(view: Camera, settings: SplatSettings | None = None) -> torch.Tensor:
    return KernelView.of(view, settings or SplatSettings()).table(DEVICE)


def test_equal_numbers_have_one_table():
    first = table_of(seen())
    assert table_of(seen()) is first
    assert table_of(seen(), SplatSettings(eps2d=0.2)) is not first
    assert table_of(dataclasses.replace(seen(), width=22)) is not first


TENSORS = {
    "pose": lambda view: view.camera_from_world[1:2, 3],
    "intrinsics": lambda view: view.intrinsics[0, 2:],
    "lens": lambda view: view.distortion,
    "translation": lambda view: view.shutter.translation,
    "rotation": lambda view: view.shutter.rotation,
}


@pytest.mark.parametrize("name", TENSORS)
def test_a_camera_that_is_changed_in_place_has_another_table(name):
    view = seen()
    before = table_of(view)
    kept, changed = before.clone(), TENSORS[name](view)
    number = float(changed[0])
    # Through memory that torch does not see being written, too.
    changed.numpy()[0] = number + 0.5
    after = table_of(view)
    assert not torch.equal(after, before)
    assert torch.equal(after, KernelView(view, SplatSettings()).table(DEVICE))
    changed[0] = number
    assert torch.equal(table_of(view), kept)


def test_a_camera_that_is_changed_in_place_is_drawn_and_checked_anew():
    view = camera(21, 9)
    gaussians = cast(random_gaussians(6, view), torch.float32, device=DEVICE)
    before = splat(gaussians, view, backend="triton").rgb
    view.camera_from_world[0, 3] += 0.1
    after = splat(gaussians, view, backend="triton").rgb
    assert not torch.equal(before, after)
    other = dataclasses.replace(view, camera_from_world=view.camera_from_world.clone())
    assert torch.equal(splat(gaussians, other, backend="triton").rgb, after)
    check_camera(view)
    view.camera_from_world[0, 0] *= 2
    with pytest.raises(ValueError, match="must be a rigid motion"):
        splat(gaussians, view, backend="triton")


def test_a_camera_in_inference_mode():
    """Its tensors count no versions."""
    with torch.inference_mode():
        view = dataclasses.replace(seen(), intrinsics=seen().intrinsics.clone())
        before = table_of(view).clone()
        view.intrinsics[0, 2] += 1
        assert not torch.equal(table_of(view), before)
