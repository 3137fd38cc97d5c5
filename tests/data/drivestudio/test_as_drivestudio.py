"""Options that read a drive as DriveStudio does: without lenses, what lies ahead, in the axes of the first pose."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sparsestreet.data.drivestudio import DriveStudioReader
from sparsestreet.data.images import read_image, read_mask
from sparsestreet.data.rig import Undistortion
from sparsestreet.geometry.lenses import BrownConrady
from sparsestreet.types import Camera
from tests.conftest import unchecked
from tests.data.drivestudio.folders import (
    FOCAL,
    HEIGHT,
    POINTS_IN_WORLD,
    TURN_LEFT,
    WIDTH,
    WORLD_FROM_OPENCV,
    make_nuscenes,
    make_waymo,
    write_image,
    write_lines,
)

BARREL, SLIGHT = [-0.25, 0.05, 1e-3, -1e-3, 0.0], [0.01, 0.0, 0.0, 0.0, 0.0]
PINCUSHION = [0.3, 0.0, 0.0, 0.0, 0.0]


def taken_out(camera: Camera, coefficients: list[float]) -> Undistortion:
    intrinsics, size = camera.intrinsics.double(), (camera.width, camera.height)
    lens = BrownConrady.of(intrinsics, torch.tensor(coefficients, dtype=torch.float64))
    return Undistortion.of(lens, intrinsics, size, size)


@pytest.fixture
def bent(tmp_path):
    """Camera 1 has a lens, camera 2 one that moves no pixel by half; what they see is no even color."""
    make_waymo(tmp_path, cameras=3)
    for camera, lens in ((1, BARREL), (2, SLIGHT)):
        write_lines(tmp_path / f"intrinsics/{camera}.txt", [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, *lens])
    pixels = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    for name in ("images/001_1.jpg", "images/001_2.jpg"):
        write_image(tmp_path / name, pixels)
    mask = 255 * (pixels[..., 0] > 200).astype(np.uint8)
    for name in ("ego_masks/1", "sky_masks/001_1", "dynamic_masks/human/001_1", "dynamic_masks/vehicle/001_1"):
        write_image(tmp_path / f"{name}.png", mask)
    return tmp_path


@pytest.mark.parametrize("width", [None, WIDTH // 2])
def test_lenses_are_taken_out_of_images_and_masks(bent, width):
    log = DriveStudioReader(bent, undistort=True, width=width).read()
    assert all(view.camera.distortion is None for view in log.views)
    assert [note.split(",")[0] for note in log.notes] == [f"camera {camera}: its lens" for camera in (1, 2)]
    assert all(note.endswith("is taken out of the images") for note in log.notes)
    plain = DriveStudioReader(bent, width=width).read()
    for camera, lens in ((1, BARREL), (2, SLIGHT)):
        seen, recorded = log.frames[3 + camera], plain.frames[3 + camera]
        # The same intrinsics, scaled with the image.
        assert torch.equal(seen.camera.intrinsics, recorded.camera.intrinsics)
        assert float(seen.camera.intrinsics[0, 0]) == FOCAL * (1 if width is None else 0.5)
        take_out = taken_out(seen.camera, lens)
        assert torch.equal(seen.image, torch.from_numpy(take_out(recorded.image.numpy())))
        assert not torch.equal(seen.image, recorded.image)
    size = log.frames[4].image.shape[1::-1]
    take_out = taken_out(log.frames[4].camera, BARREL)
    for kind, path in (("sky", "sky_masks"), ("human", "dynamic_masks/human"), ("vehicle", "dynamic_masks/vehicle")):
        mask = read_mask(bent / path / "001_1.png", size, sky=kind == "sky", undistortion=take_out)
        assert torch.equal(getattr(log.frames[4], kind), mask)
        assert not torch.equal(mask, getattr(plain.frames[4], kind))
    hood = read_mask(bent / "ego_masks/1.png", size, sky=False, undistortion=take_out)
    assert torch.equal(log.frames[4].ego, hood if take_out.blank is None else hood | take_out.blank)
    # The pinhole's image is as recorded.
    assert torch.equal(log.frames[3].image, read_image(bent / "images/001_0.jpg", size))


def test_no_loss_sees_what_the_lens_did_not_record(tmp_path):
    """A pincushion's pinhole has black corners."""
    make_waymo(tmp_path, cameras=2)
    write_lines(tmp_path / "intrinsics/1.txt", [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, *PINCUSHION])
    pixels = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    for frame in range(3):
        write_image(tmp_path / f"images/{frame:03d}_1.jpg", pixels)
    frame = DriveStudioReader(tmp_path, undistort=True).read().frames[3]
    assert frame.ego[[0, 0, -1, -1], [0, -1, 0, -1]].all()
    assert 0 < int(frame.ego.sum()) < frame.ego.numel() / 2
    # JPEG leaves 255 at 254 or more.
    assert (frame.image[~frame.ego] >= 254).all()
    assert (frame.image[0, 0] == 0).all()
    assert DriveStudioReader(tmp_path).read().frames[3].ego is None


def test_lidar_meets_a_pinhole_where_the_lens_is_taken_out(bent):
    """(10, 2, 0.75) is 9 m ahead of camera 1 at frame 1, 1.5 m to its left and 0.75 m below it."""
    (bent / "ego_masks/1.png").unlink()
    frame = DriveStudioReader(bent, undistort=True).read().frames[4]
    column, row = WIDTH / 2 - FOCAL * 1.5 / 9, HEIGHT / 2 + FOCAL * 0.75 / 9
    assert float(frame.depth[int(row), int(column)]) == pytest.approx(9.0)


def test_returns_ahead_of_the_vehicle(tmp_path):
    """At frame 1 the points lie 9, 19, 7, -6 and 9 m ahead of it."""
    root = make_waymo(tmp_path / "waymo")
    everything = DriveStudioReader(root).read().sweeps[1]
    for ahead, kept in (((-2.0, 80.0), [0, 1, 2, 4]), ((-6.5, 8.0), [2, 3]), ((7.0, 9.5), [0, 4])):
        sweep = DriveStudioReader(root, lidar_ahead=ahead).read().sweeps[1]
        assert torch.equal(sweep.points, everything.points[kept])
    # nuScenes' points lie in the frame of the sensor.
    flavor = make_nuscenes(tmp_path / "nuscenes")
    log = DriveStudioReader(flavor, lidar_ahead=(1.0, 8.0)).read()
    assert len(log.sweeps[1].points) == len(POINTS_IN_WORLD)
    assert "lidar_ahead=[1.0, 8.0] has no effect: returns of the flavor nuscenes are not cut" in log.notes
    without = DriveStudioReader(root, lidar_ahead=(1.0, 8.0), lidar=False).read()
    assert "lidar_ahead=[1.0, 8.0] has no effect: no lidar is read" in without.notes
    for quiet in (DriveStudioReader(root, lidar_ahead=(1.0, 8.0)), DriveStudioReader(flavor)):
        assert "lidar_ahead" not in " ".join(quiet.read().notes)


def test_the_axes_of_the_first_pose(tmp_path):
    """The vehicle's of Waymo, the front camera's of nuScenes."""
    flavors = ((make_waymo, TURN_LEFT), (make_nuscenes, WORLD_FROM_OPENCV))
    for make, axes in flavors:
        root = make(tmp_path / make.__name__)
        assert DriveStudioReader(root).read().first_axes is None
        log = DriveStudioReader(root, extent="first_pose").read()
        np.testing.assert_allclose(log.first_axes.numpy(), axes, atol=1e-12)
        seen = np.concatenate([sweep.points[sweep.colored].numpy() for sweep in log.sweeps]) @ axes
        low, high = np.quantile(seen, (0.02, 0.98), axis=0)
        high[2] = max(high[2], 20.0)
        assert log.radius == pytest.approx(1.1 * (high - low).max() / 2, rel=1e-6)
        np.testing.assert_allclose(log.center.numpy(), axes @ ((low + high) / 2), atol=1e-5)
        assert replace(log, first_axes=None).radius != pytest.approx(log.radius, rel=1e-3)


@pytest.mark.parametrize(
    ("choice", "said"),
    [
        ({"extent": "street"}, "extent must be one of world, first_pose, got 'street'"),
        ({"lidar_ahead": (80.0, -2.0)}, r"lidar_ahead needs a least and a larger distance, got \(80.0, -2.0\)"),
        ({"lidar_ahead": (80.0,)}, "lidar_ahead needs a least and a larger distance"),
    ],
)
def test_what_cannot_be(choice, said, tmp_path):
    with unchecked(), pytest.raises(ValueError, match=said):
        DriveStudioReader(tmp_path, **choice)
