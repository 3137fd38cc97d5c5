"""Streets whose images are exposed for a while: what moves is blurred."""

from dataclasses import replace

import numpy as np
import pytest

from sparsestreet.data.synthetic import StreetReader, StreetSettings
from sparsestreet.data.synthetic.capture import Instant, street_camera, to_srgb
from sparsestreet.data.synthetic.render import render_frame, render_image
from sparsestreet.data.synthetic.settings import WAYMO_TOP
from sparsestreet.data.synthetic.street import with_declared, write_declared
from sparsestreet.data.synthetic.world import build_world
from tests.conftest import unchecked
from tests.typed import there

BLURRED = StreetSettings(
    seed=3, num_frames=2, width=48, height=30, num_cameras=2, frame_rate=10.0, supersampling=1, ego_speed=15.0,
    num_parked_cars=3, num_moving_cars=3, num_pedestrians=0, num_cyclists=0,
    lidar=replace(WAYMO_TOP, beams=2, azimuth_steps=16), shutter_time=0.04,
)  # fmt: skip
SHARP = replace(BLURRED, shutter_time=0.0)


@pytest.mark.lengthy
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


@pytest.mark.lengthy
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


@pytest.mark.lengthy
def test_a_log_declares_the_exposure_and_the_truth_is_sharp(tmp_path):
    world = build_world(SHARP)
    with unchecked():
        log = StreetReader(BLURRED, tmp_path / "blurred").read()
        truth = there(there(log.truth)(log.views[3])).image.numpy().astype(int)
        sharp = render_image(SHARP, Instant.at(world, 0.1), street_camera(SHARP, 1, world.ego.pose(0.1))).rgb
    assert [(view.camera.exposure, view.camera.shutter) for view in log.views] == [(0.04, None)] * 4
    assert log.frames[3].camera.exposure == 0.04
    assert (np.abs(truth - sharp).max(-1) > 1).mean() < 5e-3  # edges, as in test_truth.py
    silent, half = tmp_path / "silent", tmp_path / "half"
    for settings, folder in ((BLURRED, silent), (replace(BLURRED, readout=0.05), half)):
        folder.mkdir()
        write_declared(replace(settings, shutter_time_known=False), world, folder)
    assert not list(silent.iterdir())
    camera = with_declared(log, BLURRED, half).views[0].camera
    assert (camera.exposure, there(camera.shutter).seconds) == (0.0, 0.05)
