"""A street behind a lens: every pixel shows what a pinhole sees in the direction that the lens bends there."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from sparsestreet.data.log import DrivingLog
from sparsestreet.data.poses import PosePath
from sparsestreet.data.synthetic import StreetReader, StreetSettings, capture, make_street
from sparsestreet.data.synthetic.capture import StreetCamera, street_camera, to_srgb
from sparsestreet.data.synthetic.render import Instant, StreetImage, developed, render_frame
from sparsestreet.data.synthetic.settings import WAYMO_TOP
from sparsestreet.data.synthetic.street import with_declared, write_declared
from sparsestreet.data.synthetic.tracer import _bounding_planes
from sparsestreet.data.synthetic.world import World, build_world
from tests.conftest import unchecked
from tests.typed import there

LENS = (-0.3, 0.1, 0.004, -0.006, 0.02)
SETTINGS = StreetSettings(
    seed=3, num_frames=1, width=97, height=61, num_cameras=1, supersampling=1, lens=LENS,
    lidar=replace(WAYMO_TOP, beams=2, azimuth_steps=16),
)  # fmt: skip


def seen_at(instant: Instant, camera: StreetCamera) -> StreetImage:
    """What the camera records then, by a ray through each pixel's center."""
    return developed(camera, instant.seen_by(camera, samples=1))


def imaged(x: np.ndarray, y: np.ndarray, lens: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Brown-Conrady as OpenCV's manual states it."""
    k1, k2, p1, p2, k3 = lens
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    bent_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    bent_y = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    return bent_x, bent_y


def seen(x: np.ndarray, y: np.ndarray, lens: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Its inverse as a fixed point: what the lens adds is taken off until nothing changes."""
    guess = x, y
    for _ in range(200):
        bent = imaged(*guess, lens)
        guess = guess[0] + x - bent[0], guess[1] + y - bent[1]
    bent = imaged(*guess, lens)
    assert max(np.abs(bent[0] - x).max(), np.abs(bent[1] - y).max()) < 1e-12
    return guess


def test_a_pixel_shows_what_a_pinhole_of_one_pixel_sees_there():
    world = build_world(SETTINGS)
    instant = Instant.at(world, 0.0)
    camera = street_camera(SETTINGS, 0, world.ego.pose(0.0))
    image = seen_at(instant, camera)
    focal = camera.intrinsics[0, 0]
    columns, rows = np.random.default_rng(0).integers((97, 61), size=(20, 2)).T
    columns[:4], rows[:4] = (0, 96, 0, 96), (0, 0, 60, 60)
    x, y = seen((columns + 0.5 - 48.5) / focal, (rows + 0.5 - 30.5) / focal, LENS)
    moved = np.hypot(x * focal + 48.5 - columns - 0.5, y * focal + 30.5 - rows - 0.5)
    assert moved[:4].min() > 5
    same = []
    for column, row, right, down in zip(columns, rows, x, y, strict=True):
        intrinsics = np.array([[focal, 0, 0.5 - focal * right], [0, focal, 0.5 - focal * down], [0, 0, 1]])
        found = seen_at(instant, StreetCamera(camera.world_from_camera, intrinsics, 1, 1))
        same.append(
            np.abs(found.rgb[0, 0].astype(int) - image.rgb[row, column]).max() <= 1
            and np.isclose(found.depth[0, 0], image.depth[row, column], rtol=1e-4)
            and found.object_indices[0, 0] == image.object_indices[row, column]
            and found.sky[0, 0] == image.sky[row, column]
        )
    # Rays agree to float32's last digits: one of 20 may meet an edge in another way.
    assert sum(same) >= 19


def test_files_of_a_street_say_its_lens_and_show_it(tmp_path):
    """Unprojected by what the files say, the road is flat."""
    root = make_street(SETTINGS, tmp_path)
    fx, fy, cx, cy, *lens = np.loadtxt(root / "intrinsics/0.txt")
    assert tuple(lens) == LENS
    with np.load(root / "depth/000_0.npz") as stored:
        depth, ids = stored["depth"], stored["instance"]
    v, u = np.meshgrid(np.arange(61) + 0.5, np.arange(97) + 0.5, indexing="ij")
    x, y = seen((u - cx) / fx, (v - cy) / fy, LENS)
    pose = np.loadtxt(root / "extrinsics/000_0.txt")
    points = np.stack((x, y, np.ones_like(x)), -1) * depth[..., None] @ pose[:3, :3].T + pose[:3, 3]
    road = points[(depth > 0) & (ids < 0) & (np.abs(points[..., 1]) < 1.5) & (points[..., 0] < 50)]
    assert len(road) > 300
    # Float32 depth is good to 1e-7 of 50 m.
    np.testing.assert_allclose(road[:, 2], 0, atol=1e-4)
    read = StreetReader(SETTINGS, root).read().views[0].camera
    np.testing.assert_array_equal(read.distortion, np.array(LENS, np.float32))


def test_frames_share_the_rays_of_a_lens(monkeypatch):
    first = street_camera(SETTINGS, 0, np.eye(4))
    ahead = first.rays(1)
    monkeypatch.setattr(capture, "undistort", None)
    turn = np.array([[0.0, -1, 0, 5], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    turned = street_camera(SETTINGS, 0, turn).rays(1)
    np.testing.assert_allclose(
        turned.directions, np.einsum("ij,jhw->ihw", turn[:3, :3], ahead.directions), rtol=0, atol=1e-7
    )


@pytest.mark.parametrize("k1", [-0.3, 0.3])
def test_tiles_with_bent_sides_are_bounded_on_all_of_them(k1):
    """Culling by four planes is what makes a street fast to trace: none is lost, none cuts off a ray."""
    tile = street_camera(replace(SETTINGS, lens=(k1, 0.0, 0.0, 0.0, 0.0)), 0, np.eye(4)).rays(1).directions
    heights = np.einsum("kj,jhw->khw", _bounding_planes(tile), tile)
    assert len(heights) == 4
    assert heights.min() >= -1e-6
    # Each touches the tile.
    assert heights.min((1, 2)).max() < 1e-6


@pytest.mark.parametrize(("beyond", "planes"), [(0.0, 4), (0.5e-6, 4), (1.5e-6, 3)])
def test_a_plane_of_a_wide_tile_goes_if_it_cuts_off_more_than_rounding(beyond, planes):
    """Columns at -80 and 80 degrees, most of them at 80: from the middle a ray points back, and no plane is turned."""
    x, y, z = np.cos(np.radians(80)), np.sin(np.radians(80)), 0.3
    outwards = np.array([-z, 0, x]) / np.hypot(x, z)
    top = np.array([x, 0, z]) + beyond * outwards
    rows = [[(x, -y, z), tuple(top), *[(x, y, z)] * 3], [(x, -y, -z), (1, 0, 0), *[(x, y, -z)] * 3]]
    assert len(_bounding_planes(np.array(rows, np.float32).transpose(2, 0, 1))) == planes


SETTINGS_READOUT = StreetSettings(
    seed=3, num_frames=2, width=48, height=30, num_cameras=2, frame_rate=10.0, supersampling=1, ego_speed=15.0,
    num_parked_cars=4, num_moving_cars=3, num_pedestrians=1, num_cyclists=0,
    lidar=replace(WAYMO_TOP, beams=8, azimuth_steps=100), readout=0.06,
)  # fmt: skip
CLEAN = replace(SETTINGS_READOUT, readout=0.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("streets")


@pytest.fixture(scope="module")
def log(folder) -> DrivingLog:
    with unchecked():
        return StreetReader(SETTINGS_READOUT, folder / "rolling").read()


@pytest.mark.parametrize(
    ("direction", "line", "late"),
    [("top", 20, 11 / 60), ("bottom", 20, -11 / 60), ("left", 40, 33 / 96), ("right", 40, -33 / 96)],
)
def test_a_line_is_that_of_an_image_taken_at_its_instant(direction, line, late):
    """Line n of N is read (n + 1/2) / N - 1/2 of the readout behind the middle, by camera, cars and light of then.

    The car turns where columns are read.
    """
    turn = 5.0 if direction in ("left", "right") else 0.0
    settings = replace(SETTINGS_READOUT, num_cameras=1, readout_direction=direction, turn=turn)
    world = build_world(settings)
    time = 0.1 + 0.06 * late
    with unchecked():
        rolling = render_frame(settings, world, 1).images[0]
        then = seen_at(Instant.at(world, time), street_camera(CLEAN, 0, world.ego.pose(time)))
        middle = seen_at(Instant.at(world, 0.1), street_camera(CLEAN, 0, world.ego.pose(0.1)))
    np.testing.assert_array_equal(rolling.camera.world_from_camera, middle.camera.world_from_camera)
    part = line if direction in ("top", "bottom") else (slice(None), line)
    for name, tolerance in (("rgb", 1), ("depth", 1e-3), ("object_indices", 0), ("sky", 0)):
        found, true = (np.asarray(getattr(image, name)[part], float) for image in (rolling, then))
        # Rays of smaller bundles agree to float32's last digits: an edge may be met in another way.
        assert (np.abs(found - true) > tolerance).mean() < 0.05
    assert (np.abs(rolling.rgb[part].astype(float) - middle.rgb[part]) > 1).mean() > 0.15


def test_a_log_declares_how_its_cameras_move(folder, log):
    """Against the path of a camera that was measured at a thousand instants a second."""
    world = build_world(SETTINGS_READOUT)
    milliseconds = np.arange(-40, 160)
    for view in log.views:
        frame, camera = view.indices
        poses = [
            street_camera(SETTINGS_READOUT, camera, world.ego.pose(at / 1000)).world_from_camera for at in milliseconds
        ]
        path = PosePath(torch.tensor(milliseconds * 1_000_000), torch.from_numpy(np.stack(poses)))
        translation, rotation = path.motion_during(frame * 100_000_000, 60_000_000)
        shutter = there(view.camera.shutter)
        torch.testing.assert_close(shutter.translation, translation, rtol=0, atol=1e-6)
        torch.testing.assert_close(shutter.rotation, rotation, rtol=0, atol=1e-6)
        assert shutter.translation.norm() > 0.7
        # Two frames at 10 Hz are a tenth of a second.
        assert (shutter.direction, shutter.seconds, shutter.span) == ("top", 0.06, pytest.approx(0.6))
        assert there(log.frames[2 * frame + camera].camera.shutter).direction == "top"


def test_a_split_declares_it_too(log):
    """A training reads the log without the boxes of what it holds out."""
    kept = log.holding_out(frozenset({1}))
    for view, frame in zip(kept.views, kept.frames, strict=True):
        for camera in (view.camera, frame.camera):
            assert there(camera.shutter).seconds == 0.06


def test_files_can_be_silent_on_it(tmp_path, log):
    write_declared(replace(SETTINGS_READOUT, readout_known=False), build_world(SETTINGS_READOUT), tmp_path)
    assert not list(tmp_path.iterdir())
    assert with_declared(log, SETTINGS_READOUT, tmp_path) is log


def test_the_truth_is_read_as_the_views_camera_is(folder, log):
    """At a recorded view it is the recorded image; JPEG is off by few levels. Without a shutter it is taken at once."""
    view = log.views[3]
    world = build_world(SETTINGS_READOUT)
    with unchecked():
        found = there(there(log.truth)(view)).image.numpy().astype(int)
        at_once = there(there(log.truth)(replace(view, camera=replace(view.camera, shutter=None)))).image.numpy()
        clean = seen_at(Instant.at(world, 0.1), street_camera(CLEAN, 1, world.ego.pose(0.1))).rgb
    written = np.array(Image.open(folder / "rolling/images/001_1.jpg"), int)
    assert np.abs(written - found).mean() < 3
    assert np.abs(written - at_once).mean() > 5
    assert (np.abs(at_once.astype(int) - clean).max(-1) > 1).mean() < 5e-3


pytestmark = pytest.mark.lengthy

DELAYS = (0.05, -0.1)
SETTINGS_DELAYS = StreetSettings(
    seed=3, num_frames=2, width=48, height=30, num_cameras=2, frame_rate=2.0, supersampling=1, ego_speed=15.0,
    num_parked_cars=2, num_moving_cars=3, num_pedestrians=1, num_cyclists=0,
    lidar=replace(WAYMO_TOP, beams=16, azimuth_steps=200), delays=DELAYS,
)  # fmt: skip
VIEWS = [(frame, camera) for frame in range(2) for camera in range(2)]


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    with unchecked():
        return make_street(SETTINGS_DELAYS, tmp_path_factory.mktemp("streets") / "own")


@pytest.fixture(scope="module")
def log_delays(root) -> DrivingLog:
    return StreetReader(SETTINGS_DELAYS, root).read()


@pytest.fixture(scope="module")
def world() -> World:
    return build_world(SETTINGS_DELAYS)


@pytest.mark.parametrize(("frame", "camera"), [(0, 1), (1, 0)])
def test_images_are_of_their_own_instants(root, log_delays, world, frame: int, camera: int):
    """Rendered once more from there; a JPEG of quality 97 is off by few levels."""
    time = frame / 2 + DELAYS[camera]
    with unchecked():
        mounted = street_camera(SETTINGS_DELAYS, camera, world.ego.pose(time))
        rendered = seen_at(Instant.at(world, time), mounted)
        found = there(there(log_delays.truth)(log_delays.frames[2 * frame + camera]))
    written = np.array(Image.open(root / f"images/{frame:03d}_{camera}.jpg"), float)
    assert np.abs(written - rendered.rgb).mean() < 3
    pose = np.loadtxt(root / f"extrinsics/{frame:03d}_{camera}.txt")
    np.testing.assert_allclose(pose, mounted.world_from_camera, atol=1e-12)
    different = np.abs(found.image.numpy().astype(int) - rendered.rgb).max(-1) > 1
    assert different.mean() < 5e-3  # edges: 7 of 1,440 pixels


def test_views_sweeps_and_boxes_have_their_stamps(log_delays, world):
    assert [view.seconds for view in log_delays.views] == [0.05, -0.1, 0.55, 0.4]
    assert [sweep.seconds for sweep in log_delays.sweeps] == [0.0, 0.5]
    # From the second camera's first image to the first camera's last.
    assert SETTINGS_DELAYS.recorded == (-0.1, 0.55)
    assert [view.time for view in log_delays.views] == pytest.approx(
        [(there(one.seconds) + 0.1) / 0.65 for one in log_delays.views]
    )
    assert [sweep.time for sweep in log_delays.sweeps] == pytest.approx([0.1 / 0.65, 0.6 / 0.65])
    assert log_delays.tracks
    for track in log_delays.tracks:
        for frame, pose in zip(track.frames.tolist(), track.world_from_object, strict=True):
            place = (pose[:3, 3] + log_delays.dataset_from_world[:3, 3]).numpy()
            away = [np.abs(actor.pose(frame / 2)[:3, 3] - place).max() for actor in world.actors]
            assert min(away) < 1e-9


def test_lidar_depth_is_that_of_the_image(root, log_delays):
    """Of what stands still, and of cars, whose boxes carry the returns on."""
    errors = []
    for place, (frame, camera) in enumerate(VIEWS):
        true = torch.from_numpy(np.load(root / f"depth/{frame:03d}_{camera}.npz")["depth"])
        found = there(log_delays.frames[place].depth)
        returned = (found > 0) & (true > 0)
        errors.append(((found - true).abs() / true)[returned])
    assert len(torch.cat(errors)) > 300
    # At the poses of the frames it is 0.027: pixels are coarse, and the road is seen at a flat angle.
    assert float(torch.cat(errors).median()) < 0.022


def test_the_control_says_of_every_image_that_it_is_its_frames(tmp_path, log_delays, world):
    settings = replace(SETTINGS_DELAYS, delays_known=False)
    with unchecked():
        control = StreetReader(settings, tmp_path / "control").read()
    assert [view.seconds for view in control.views] == [0.0, 0.0, 0.5, 0.5]
    assert [view.time for view in control.views] == [0.0, 0.0, 1.0, 1.0]
    assert settings.recorded == (0.0, 0.5)
    assert not list((tmp_path / "control").glob("timestamps_*"))
    for place, (frame, camera) in enumerate(VIEWS):
        pose = np.loadtxt(tmp_path / f"control/extrinsics/{frame:03d}_{camera}.txt")
        claimed = street_camera(SETTINGS_DELAYS, camera, world.ego.pose(frame / 2))
        np.testing.assert_allclose(pose, claimed.world_from_camera, atol=1e-12)
        assert torch.equal(control.frames[place].image, log_delays.frames[place].image)


BLURRED = StreetSettings(
    seed=3, num_frames=2, width=48, height=30, num_cameras=2, frame_rate=10.0, supersampling=1, ego_speed=15.0,
    num_parked_cars=3, num_moving_cars=3, num_pedestrians=0, num_cyclists=0,
    lidar=replace(WAYMO_TOP, beams=2, azimuth_steps=16), shutter_time=0.04,
)  # fmt: skip
SHARP = replace(BLURRED, shutter_time=0.0)


def test_an_image_is_the_mean_light_of_its_exposure():
    """Against 24 moments, far more than are taken: light is averaged, not stored values."""
    world = build_world(SHARP)
    times = 0.1 + 0.04 * ((np.arange(24) + 0.5) / 24 - 0.5)
    with unchecked():
        blurred, sharp = (render_frame(one, world, 1).images[1] for one in (BLURRED, SHARP))
        light = [Instant.at(world, t).light(street_camera(SHARP, 1, world.ego.pose(t)), 1) for t in times]
    expected = to_srgb(np.stack(light).mean(0, np.float64).astype(np.float32)).astype(float)
    stored = np.mean([to_srgb(one) for one in light], 0)
    assert np.abs(blurred.rgb - expected).mean() < 0.5 * np.abs(sharp.rgb - expected).mean()
    assert np.abs(blurred.rgb - expected).mean() < np.abs(blurred.rgb - stored).mean()
    # Nor is it brighter, nor does the truth of its middle change.
    assert abs((blurred.rgb - expected).mean()) < 0.3
    np.testing.assert_array_equal(blurred.depth, sharp.depth)


def test_a_row_that_is_read_late_is_exposed_late():
    """Together with a readout: each row is the mean around its own instant."""
    low = replace(SHARP, num_cameras=1, height=10)
    both, rolling = replace(low, readout=0.05, shutter_time=0.04), replace(low, readout=0.05)
    world = build_world(SHARP)
    time = 0.1 + 0.05 * (8.5 / 10 - 0.5)
    with unchecked():
        image, sharp = (render_frame(one, world, 1).images[0] for one in (both, rolling))
        moments = time + 0.04 * ((np.arange(12) + 0.5) / 12 - 0.5)
        light = [Instant.at(world, t).light(street_camera(low, 0, world.ego.pose(t)), 1) for t in moments]
    row = to_srgb(np.stack(light).mean(0, np.float64).astype(np.float32))[8].astype(float)
    assert np.abs(image.rgb[8] - row).mean() < 0.6 * np.abs(sharp.rgb[8] - row).mean()
    np.testing.assert_array_equal(image.depth, sharp.depth)


def test_a_log_declares_the_exposure_and_the_truth_is_sharp(tmp_path):
    world = build_world(SHARP)
    with unchecked():
        log = StreetReader(BLURRED, tmp_path / "blurred").read()
        truth = there(there(log.truth)(log.views[3])).image.numpy().astype(int)
        sharp = seen_at(Instant.at(world, 0.1), street_camera(SHARP, 1, world.ego.pose(0.1))).rgb
    assert [(view.camera.exposure, view.camera.shutter) for view in log.views] == [(0.04, None)] * 4
    assert log.frames[3].camera.exposure == 0.04
    assert (np.abs(truth - sharp).max(-1) > 1).mean() < 5e-3  # edges
    silent, half = tmp_path / "silent", tmp_path / "half"
    for settings, folder in ((BLURRED, silent), (replace(BLURRED, readout=0.05), half)):
        folder.mkdir()
        write_declared(replace(settings, shutter_time_known=False), world, folder)
    assert not list(silent.iterdir())
    camera = with_declared(log, BLURRED, half).views[0].camera
    assert (camera.exposure, there(camera.shutter).seconds) == (0.0, 0.05)
