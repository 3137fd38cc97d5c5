"""Streets whose images are read row by row, or column by column, while cars and cameras move."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from sparsestreet.data.log import DrivingLog
from sparsestreet.data.motion import PosePath
from sparsestreet.data.synthetic import StreetReader, StreetSettings
from sparsestreet.data.synthetic.capture import Instant, street_camera
from sparsestreet.data.synthetic.render import render_frame, render_image
from sparsestreet.data.synthetic.settings import WAYMO_TOP
from sparsestreet.data.synthetic.street import with_declared, write_declared
from sparsestreet.data.synthetic.world import build_world
from tests.conftest import unchecked
from tests.typed import there

SETTINGS = StreetSettings(
    seed=3, num_frames=2, width=48, height=30, num_cameras=2, frame_rate=10.0, supersampling=1, ego_speed=15.0,
    num_parked_cars=4, num_moving_cars=3, num_pedestrians=1, num_cyclists=0,
    lidar=replace(WAYMO_TOP, beams=8, azimuth_steps=100), readout=0.06,
)  # fmt: skip
CLEAN = replace(SETTINGS, readout=0.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("streets")


@pytest.fixture(scope="module")
def log(folder) -> DrivingLog:
    with unchecked():
        return StreetReader(SETTINGS, folder / "rolling").read()


@pytest.mark.lengthy
@pytest.mark.parametrize(
    ("direction", "line", "late"),
    [("top", 20, 11 / 60), ("bottom", 20, -11 / 60), ("left", 40, 33 / 96), ("right", 40, -33 / 96)],
)
def test_a_line_is_that_of_an_image_taken_at_its_instant(direction, line, late):
    """Line n of N is read (n + 1/2) / N - 1/2 of the readout behind the middle, by camera, cars and light of then.

    The car turns where columns are read.
    """
    turn = 5.0 if direction in ("left", "right") else 0.0
    settings = replace(SETTINGS, num_cameras=1, readout_direction=direction, turn=turn)
    world = build_world(settings)
    time = 0.1 + 0.06 * late
    with unchecked():
        rolling = render_frame(settings, world, 1).images[0]
        then = render_image(CLEAN, Instant.at(world, time), street_camera(CLEAN, 0, world.ego.pose(time)))
        middle = render_image(CLEAN, Instant.at(world, 0.1), street_camera(CLEAN, 0, world.ego.pose(0.1)))
    np.testing.assert_array_equal(rolling.camera.world_from_camera, middle.camera.world_from_camera)
    part = line if direction in ("top", "bottom") else (slice(None), line)
    for name, tolerance in (("rgb", 1), ("depth", 1e-3), ("object_indices", 0), ("sky", 0)):
        found, true = (np.asarray(getattr(image, name)[part], float) for image in (rolling, then))
        # Rays of smaller bundles agree to float32's last digits: an edge may be met in another way.
        assert (np.abs(found - true) > tolerance).mean() < 0.05
    assert (np.abs(rolling.rgb[part].astype(float) - middle.rgb[part]) > 1).mean() > 0.15


@pytest.mark.lengthy
def test_a_log_declares_how_its_cameras_move(folder, log):
    """Against the path of a camera that was measured at a thousand instants a second."""
    world = build_world(SETTINGS)
    milliseconds = np.arange(-40, 160)
    for view in log.views:
        frame, camera = view.indices
        poses = [street_camera(SETTINGS, camera, world.ego.pose(at / 1000)).world_from_camera for at in milliseconds]
        path = PosePath(torch.tensor(milliseconds * 1_000_000), torch.from_numpy(np.stack(poses)))
        translation, rotation = path.motion_during(frame * 100_000_000, 60_000_000)
        shutter = there(view.camera.shutter)
        torch.testing.assert_close(shutter.translation, translation, rtol=0, atol=1e-6)
        torch.testing.assert_close(shutter.rotation, rotation, rtol=0, atol=1e-6)
        assert shutter.translation.norm() > 0.7
        # Two frames at 10 Hz are a tenth of a second.
        assert (shutter.direction, shutter.seconds, shutter.span) == ("top", 0.06, pytest.approx(0.6))
        assert there(log.frames[2 * frame + camera].camera.shutter).direction == "top"


@pytest.mark.lengthy
def test_a_split_declares_it_too(log):
    """A training reads the log without the boxes of what it holds out."""
    kept = log.holding_out(frozenset({1}))
    for view, frame in zip(kept.views, kept.frames, strict=True):
        for camera in (view.camera, frame.camera):
            assert there(camera.shutter).seconds == 0.06


def test_files_can_be_silent_on_it(tmp_path, log):
    write_declared(replace(SETTINGS, readout_known=False), build_world(SETTINGS), tmp_path)
    assert not list(tmp_path.iterdir())
    assert with_declared(log, SETTINGS, tmp_path) is log


@pytest.mark.lengthy
def test_the_truth_is_read_as_the_views_camera_is(folder, log):
    """At a recorded view it is the recorded image; JPEG is off by few levels. Without a shutter it is taken at once."""
    view = log.views[3]
    world = build_world(SETTINGS)
    with unchecked():
        found = there(there(log.truth)(view)).image.numpy().astype(int)
        at_once = there(there(log.truth)(replace(view, camera=replace(view.camera, shutter=None)))).image.numpy()
        clean = render_image(CLEAN, Instant.at(world, 0.1), street_camera(CLEAN, 1, world.ego.pose(0.1))).rgb
    written = np.array(Image.open(folder / "rolling/images/001_1.jpg"), int)
    assert np.abs(written - found).mean() < 3
    assert np.abs(written - at_once).mean() > 5
    assert (np.abs(at_once.astype(int) - clean).max(-1) > 1).mean() < 5e-3


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"readout": -0.01}, "readout must not be negative"),
        ({"shutter_time": 0.1}, r"shutter_time must be shorter than a frame of 0\.1 s but is 0\.1"),
        (
            {"turn": 15.0},
            r"turn must keep the car within 1\.75 m of its lane's middle, but 15 degrees at 15 m/s take it 2\.56",
        ),
        ({"readout": 0.1}, r"readout must be shorter than a frame of 0\.1 s but is 0\.1"),
        ({"readout_direction": "up"}, "readout_direction must be one of top, bottom, left, right but is up"),
    ],
)
def test_settings_that_cannot_be(wrong, said):
    with unchecked(), pytest.raises(ValueError, match=said):
        replace(SETTINGS, **wrong)
