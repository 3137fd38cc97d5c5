"""Effects of a street together: they compose, the files say what they should, and the truth has none of them."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from PIL.JpegImagePlugin import JpegImageFile

from sparsestreet.data.log import DrivingLog
from sparsestreet.data.synthetic import StreetReader, StreetSettings
from sparsestreet.data.synthetic.reader import street_truth
from sparsestreet.data.synthetic.render import recorded_gains
from sparsestreet.data.synthetic.settings import WAYMO_TOP
from tests.conftest import unchecked
from tests.typed import there

CLEAN = StreetSettings(
    seed=3, num_frames=2, width=40, height=12, num_cameras=2, frame_rate=5.0, supersampling=1, ego_speed=12.0,
    num_parked_cars=3, num_moving_cars=3, num_pedestrians=1, num_cyclists=0,
    lidar=replace(WAYMO_TOP, beams=8, azimuth_steps=100),
)  # fmt: skip
PLANTED = replace(
    CLEAN, lens=(-0.15, 0.02, 0.0, 0.0, 0.0), delays=(0.0, 0.02), exposure_walk=0.3, white_balance=0.05, readout=0.03,
    readout_direction="bottom", shutter_time=0.01, hood=0.15, hood_known=True, pose_noise=(0.05, 0.2),
    box_noise=(0.1, 1.0), tunnel=True, jpeg=75,
)  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("streets")


@pytest.fixture(scope="module")
def log(folder) -> DrivingLog:
    with unchecked():
        return StreetReader(PLANTED, folder / "planted").read()


@pytest.mark.lengthy
def test_all_at_once_open_as_a_log(folder, log):
    assert StreetReader(PLANTED, folder / "planted").check() == []
    for frame in log.frames:
        camera = frame.camera
        assert (camera.exposure, there(camera.shutter).direction, there(camera.shutter).seconds) == (
            0.01,
            "bottom",
            0.03,
        )
        assert camera.distortion is not None
        assert not there(frame.sky).any()
        assert (frame.ego is not None) == (frame.camera_index == 0)
        # The 8-bit image is that of the truth, times its gains, where neither hood nor motion has a say.
        gains = there(recorded_gains(PLANTED, *frame.indices))
        with unchecked():
            true = there(street_truth(PLANTED, log.dataset_from_world)(frame)).image.double().numpy() * gains
        off = np.abs(frame.image.double().numpy() - true.clip(max=255))[:8]
        assert np.median(off) < 8
        unexposed = np.abs(frame.image.double().numpy() - true / gains)[:8]
        assert np.median(off) < 0.6 * np.median(unexposed)


@pytest.mark.lengthy
def test_the_truth_of_a_view_is_that_of_the_clean_street(log):
    """Of the tunnel as it was built, bit for bit; the view brings its own lens."""
    same_street = {"tunnel": True, "delays": PLANTED.delays}
    view = log.views[2]
    view = replace(view, camera=replace(view.camera, shutter=None, exposure=0.0))
    with unchecked():
        found, clean = (
            there(street_truth(one, log.dataset_from_world)(view)) for one in (PLANTED, replace(CLEAN, **same_street))
        )
    for field in fields(found):
        if field.name in ("image", "sky", "human", "vehicle"):
            assert torch.equal(getattr(found, field.name), getattr(clean, field.name))


@pytest.mark.lengthy
@pytest.mark.parametrize(("quality", "step"), [(97, 1), (75, 8), (50, 16)])
def test_images_have_the_quality_that_is_asked_for(tmp_path, quality, step):
    """The JPEG standard's step of a block's mean brightness is 16 at quality 50, halved at 75."""
    settings = replace(CLEAN, num_frames=1, num_cameras=1, jpeg=quality)
    with unchecked():
        StreetReader(settings, tmp_path / "one").read()
    with Image.open(tmp_path / "one/images/000_0.jpg") as image:
        assert isinstance(image, JpegImageFile)
        assert image.quantization[0][0] == step
        assert [layer[1:3] for layer in image.layer] == [(1, 1)] * 3  # no halved color


@pytest.mark.parametrize("jpeg", [0, 101])
def test_qualities_that_cannot_be(jpeg):
    with pytest.raises(ValueError, match="jpeg must be a quality from 1 to 100"):
        replace(CLEAN, jpeg=jpeg)
