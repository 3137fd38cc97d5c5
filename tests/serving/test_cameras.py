"""Lenses and shutters of messages, against NVIDIA's own projection of them."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sparsestreet.geometry.cameras import inverse, project
from sparsestreet.serving import wire
from sparsestreet.serving.cameras import READ_FIRST, camera_spec, lens_of, matrix, pose_message, posed
from sparsestreet.types import Camera
from tests.serving.street import at, timed_views, world_from_camera
from tests.typed import there

LENS = {
    "radial_coeffs": [-0.12, 0.03, -0.004, 0.0, 0.0, 0.0],
    "tangential_coeffs": [0.002, -0.001],
    "thin_prism_coeffs": [0.0] * 4,
}
SIZE = (1080, 1920)


def spec(shutter: str = "GLOBAL", **lens: list[float]):
    made = wire.kind("CameraSpec")(resolution_h=SIZE[0], resolution_w=SIZE[1], logical_id="front")
    made.shutter_type = wire.number("ShutterType", shutter)
    pinhole = made.opencv_pinhole_param
    pinhole.focal_length_x, pinhole.focal_length_y = 1150.0, 1160.0
    pinhole.principal_point_x, pinhole.principal_point_y = 951.5, 548.25
    for name, values in lens.items():
        getattr(pinhole, name).extend(values)
    return made


def projected(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Through the lens, each row at its own instant: the pose of a row moves evenly from that of the middle one."""
    pixels = project(camera, torch.from_numpy(points).float())[0].double()
    shutter = camera.shutter
    if shutter is None:
        return pixels.numpy()
    lines = camera.width if shutter.reads_columns else camera.height
    middle = inverse(camera.camera_from_world.double()).numpy()
    found = []
    for point, pixel in zip(points, pixels.numpy(), strict=True):
        for _ in range(6):
            share = shutter.sign * (pixel[0 if shutter.reads_columns else 1] / lines - 0.5)
            pose = middle.copy()
            pose[:3, :3] = middle[:3, :3] @ Rotation.from_rotvec(share * shutter.rotation.double().numpy()).as_matrix()
            pose[:3, 3] += middle[:3, :3] @ (share * shutter.translation.double().numpy())
            moved = Camera(inverse(torch.from_numpy(pose)), *map_of(camera))
            pixel = project(moved, torch.from_numpy(point)[None])[0][0].numpy()
        found.append(pixel)
    return np.array(found)


def map_of(camera: Camera):
    distortion = None if camera.distortion is None else camera.distortion.double()
    return camera.intrinsics.double(), camera.width, camera.height, distortion


def ncore_camera(shutter: str, lens: dict[str, list[float]]):
    pytest.importorskip("ncore.sensors", reason="pip install nvidia-ncore==19.8.3")
    from ncore.impl.data import types  # pyright: ignore[reportMissingImports]
    from ncore.impl.sensors.camera import CameraModel  # pyright: ignore[reportMissingImports]

    coefficients = {name: np.array(values, np.float32) for name, values in lens.items()}
    return CameraModel.from_parameters(
        types.OpenCVPinholeCameraModelParameters(
            resolution=np.array(SIZE[::-1], np.uint64),
            shutter_type=types.ShutterType[shutter],
            principal_point=np.array([951.5, 548.25], np.float32),
            focal_length=np.array([1150.0, 1160.0], np.float32),
            external_distortion_parameters=None,
            **coefficients,
        ),
        device="cpu",
        dtype=torch.float64,
    )


START = at(3.0, -1.0, 1.5) @ np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Looks along +x."""


def moved(pose: np.ndarray) -> np.ndarray:
    """After 30 ms at 5 m/s, turning by 0.15 rad/s: 5 pixels to the side, 4 at the border towards it."""
    end = pose.copy()
    end[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec([0.001, 0.0045, -0.0005]).as_matrix()
    end[:3, 3] += pose[:3, :3] @ [0.01, 0.0, 0.15]
    return end


@pytest.mark.parametrize("lens", [LENS, {name: [0.0] * len(values) for name, values in LENS.items()}])
@pytest.mark.parametrize("shutter", ["GLOBAL", *READ_FIRST])
def test_points_land_where_ncore_puts_them(shutter, lens):
    theirs, end = ncore_camera(shutter, lens), moved(START)
    columns, rows = np.meshgrid(np.arange(20, 1920, 235), np.arange(10, 1080, 150))
    pixels = np.stack((columns, rows), -1).reshape(-1, 2).astype(np.int32)
    rays = theirs.pixels_to_world_rays_shutter_pose(pixels, START, end).world_rays.numpy()
    points = rays[:, :3] + np.random.default_rng(3).uniform(8, 60, (len(rays), 1)) * rays[:, 3:]
    camera = posed(lens_of(spec(shutter, **lens), *SIZE), START, end, shutter, 0.03, 0.01)
    # float32 intrinsics on both sides: 1e-4 pixels.
    assert np.abs(projected(camera, points) - (pixels + 0.5)).max() < 1e-3
    assert (camera.shutter is None) == (shutter == "GLOBAL")


def test_a_shutter_between_equal_poses_is_none_unless_objects_move_meanwhile():
    lens = lens_of(spec(), *SIZE)
    assert posed(lens, START, START, "ROLLING_TOP_TO_BOTTOM", 0.03, 0.0).shutter is None
    shutter = there(posed(lens, START, START, "ROLLING_RIGHT_TO_LEFT", 0.03, 0.01).shutter)
    assert (shutter.direction, shutter.translation.tolist(), shutter.rotation.tolist()) == ("right", [0] * 3, [0] * 3)
    # From the middle of the first column to that of the last.
    assert shutter.span == pytest.approx(0.01 * 1920 / 1919)


def test_a_moving_camera_says_how_it_is_read_out():
    lens = lens_of(spec(), *SIZE)
    assert torch.equal(
        posed(lens, START, START, "UNKNOWN", 0.0, 0.0).camera_from_world,
        posed(lens, START, moved(START), "GLOBAL", 0.03, 0.0).camera_from_world,
    )
    with pytest.raises(ValueError, match="send shutter_type"):
        posed(lens, START, moved(START), "UNKNOWN", 0.03, 0.0)


def test_a_recorded_camera_comes_back_from_its_message():
    camera = timed_views()[5].camera
    lens = torch.tensor([0.1, -0.02, 0.001, 0.002, 0.003])
    camera = Camera(camera.camera_from_world, camera.intrinsics, camera.width, camera.height, lens)
    message = camera_spec("left", camera)
    again = lens_of(message, camera.height, camera.width)
    assert torch.equal(again.intrinsics, camera.intrinsics)
    assert torch.equal(there(again.distortion), lens)
    assert (message.logical_id, message.shutter_type) == ("left", wire.number("ShutterType", "GLOBAL"))
    pose = world_from_camera(camera)
    assert np.allclose(matrix(pose_message(pose), "it"), pose, atol=1e-6)
