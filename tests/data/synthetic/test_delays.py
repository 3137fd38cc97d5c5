"""Streets whose cameras fire at instants of their own."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from sparsestreet.data.log import DrivingLog
from sparsestreet.data.synthetic import StreetReader, StreetSettings, make_street
from sparsestreet.data.synthetic.capture import street_camera
from sparsestreet.data.synthetic.render import Instant, render_image
from sparsestreet.data.synthetic.settings import WAYMO_TOP
from sparsestreet.data.synthetic.world import World, build_world
from tests.conftest import unchecked
from tests.typed import there

pytestmark = pytest.mark.lengthy

DELAYS = (0.05, -0.1)
SETTINGS = StreetSettings(
    seed=3, num_frames=2, width=48, height=30, num_cameras=2, frame_rate=2.0, supersampling=1, ego_speed=15.0,
    num_parked_cars=2, num_moving_cars=3, num_pedestrians=1, num_cyclists=0,
    lidar=replace(WAYMO_TOP, beams=16, azimuth_steps=200), delays=DELAYS,
)  # fmt: skip
VIEWS = [(frame, camera) for frame in range(2) for camera in range(2)]


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    with unchecked():
        return make_street(SETTINGS, tmp_path_factory.mktemp("streets") / "own")


@pytest.fixture(scope="module")
def log(root) -> DrivingLog:
    return StreetReader(SETTINGS, root).read()


@pytest.fixture(scope="module")
def world() -> World:
    return build_world(SETTINGS)


@pytest.mark.parametrize(("frame", "camera"), [(0, 1), (1, 0)])
def test_images_are_of_their_own_instants(root, log, world, frame: int, camera: int):
    """Rendered once more from there; a JPEG of quality 97 is off by few levels."""
    time = frame / 2 + DELAYS[camera]
    with unchecked():
        mounted = street_camera(SETTINGS, camera, world.ego.pose(time))
        rendered = render_image(SETTINGS, Instant.at(world, time), mounted)
        found = there(there(log.truth)(log.frames[2 * frame + camera]))
    written = np.array(Image.open(root / f"images/{frame:03d}_{camera}.jpg"), float)
    assert np.abs(written - rendered.rgb).mean() < 3
    pose = np.loadtxt(root / f"extrinsics/{frame:03d}_{camera}.txt")
    np.testing.assert_allclose(pose, mounted.world_from_camera, atol=1e-12)
    different = np.abs(found.image.numpy().astype(int) - rendered.rgb).max(-1) > 1
    assert different.mean() < 5e-3  # edges, as in test_truth.py: 7 of 1,440 pixels


def test_views_sweeps_and_boxes_have_their_stamps(log, world):
    assert [view.seconds for view in log.views] == [0.05, -0.1, 0.55, 0.4]
    assert [sweep.seconds for sweep in log.sweeps] == [0.0, 0.5]
    # From the second camera's first image to the first camera's last.
    assert SETTINGS.recorded == (-0.1, 0.55)
    assert [view.time for view in log.views] == pytest.approx([(there(one.seconds) + 0.1) / 0.65 for one in log.views])
    assert [sweep.time for sweep in log.sweeps] == pytest.approx([0.1 / 0.65, 0.6 / 0.65])
    assert log.tracks
    for track in log.tracks:
        for frame, pose in zip(track.frames.tolist(), track.world_from_object, strict=True):
            place = (pose[:3, 3] + log.dataset_from_world[:3, 3]).numpy()
            away = [np.abs(actor.pose(frame / 2)[:3, 3] - place).max() for actor in world.actors]
            assert min(away) < 1e-9


def test_lidar_depth_is_that_of_the_image(root, log):
    """Of what stands still, and of cars, whose boxes carry the returns on."""
    errors = []
    for place, (frame, camera) in enumerate(VIEWS):
        true = torch.from_numpy(np.load(root / f"depth/{frame:03d}_{camera}.npz")["depth"])
        found = there(log.frames[place].depth)
        returned = (found > 0) & (true > 0)
        errors.append(((found - true).abs() / true)[returned])
    assert len(torch.cat(errors)) > 300
    # At the poses of the frames it is 0.027: pixels are coarse, and the road is seen at a flat angle.
    assert float(torch.cat(errors).median()) < 0.022


def test_the_control_says_of_every_image_that_it_is_its_frames(tmp_path, log, world):
    settings = replace(SETTINGS, delays_known=False)
    with unchecked():
        control = StreetReader(settings, tmp_path / "control").read()
    assert [view.seconds for view in control.views] == [0.0, 0.0, 0.5, 0.5]
    assert [view.time for view in control.views] == [0.0, 0.0, 1.0, 1.0]
    assert settings.recorded == (0.0, 0.5)
    assert not list((tmp_path / "control").glob("timestamps_*"))
    for place, (frame, camera) in enumerate(VIEWS):
        pose = np.loadtxt(tmp_path / f"control/extrinsics/{frame:03d}_{camera}.txt")
        claimed = street_camera(SETTINGS, camera, world.ego.pose(frame / 2))
        np.testing.assert_allclose(pose, claimed.world_from_camera, atol=1e-12)
        assert torch.equal(control.frames[place].image, log.frames[place].image)


@pytest.mark.parametrize("delays", [(0.1,), (0.1, 0.2, 0.3), (0.0, 0.5), (0.0, float("nan"))])
def test_delays_that_cannot_be(delays):
    with pytest.raises(ValueError, match=r"delays must be empty or one for each of 2 cameras, shorter than .* 0\.5 s"):
        replace(SETTINGS, delays=delays)
