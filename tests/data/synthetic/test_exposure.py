"""Streets whose cameras record brighter and darker, and in tints of their own."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sparsestreet.data.synthetic import StreetReader, StreetSettings
from sparsestreet.data.synthetic.capture import to_srgb
from sparsestreet.data.synthetic.render import exposure_walk, recorded_gains, render_frame
from sparsestreet.data.synthetic.settings import WAYMO_TOP
from sparsestreet.data.synthetic.world import build_world
from tests.conftest import unchecked
from tests.typed import there

CLEAN = StreetSettings(
    seed=3, num_frames=2, width=48, height=30, num_cameras=2, supersampling=1, num_parked_cars=2, num_moving_cars=1,
    num_pedestrians=0, num_cyclists=0, lidar=replace(WAYMO_TOP, beams=2, azimuth_steps=16),
)  # fmt: skip


@pytest.mark.parametrize("effects", [{"exposure_walk": 0.3}, {"exposure_walk": 0.2, "white_balance": 0.05}])
def test_images_are_stored_values_times_gains(effects):
    """A stored value v became g v: one rounding before and one behind the gain, and white is white."""
    settings = replace(CLEAN, **effects)
    world = build_world(CLEAN)
    with unchecked():
        clean, frame = (render_frame(one, world, 1) for one in (CLEAN, settings))
    factors = []
    for before, behind in zip(clean.images, frame.images, strict=True):
        old, new = before.rgb.astype(float).reshape(-1, 3), behind.rgb.astype(float).reshape(-1, 3)
        unclipped = (old > 40) & (new < 255)
        assert unclipped.sum(0).min() > 100
        gain = np.array([np.median((new / old.clip(1))[unclipped[:, c], c]) for c in range(3)])
        assert (np.abs(np.minimum(old * gain, 255) - new) <= 0.5 * gain + 1.5).all()
        np.testing.assert_array_equal(before.depth, behind.depth)
        factors.append(gain)
    logs = np.log2(np.array(factors))
    # Two frames walk by one standard deviation around 0, each camera on its own way.
    np.testing.assert_allclose(np.abs(logs.mean(1)), effects["exposure_walk"], atol=0.02)
    tints = np.log(2) * (logs - logs.mean(1, keepdims=True))
    np.testing.assert_allclose(tints.std(), effects.get("white_balance", 0.0), atol=0.01)


def test_white_stays_white():
    linear = np.full((3, 1, 1), 9.0, np.float32)  # far beyond what an image stores
    assert to_srgb(linear, np.array([0.4, 1.0, 2.0], np.float32)).tolist() == [[[102, 255, 255]]]


def test_a_walk_is_smooth_and_each_cameras_own():
    settings = replace(CLEAN, num_frames=40, num_cameras=3, exposure_walk=0.2)
    walks = np.array([exposure_walk(settings, camera) for camera in range(3)])
    np.testing.assert_allclose(walks.mean(1), 0, atol=1e-12)
    np.testing.assert_allclose(walks.std(1), 0.2, rtol=1e-12)
    # A frame later exposure is nearly the same: neighbors tell that of a held-out image.
    assert np.diff(walks).std() < 0.3 * walks.std()
    assert np.abs(np.diff(walks, 2)).max() < 0.1
    assert np.abs(np.corrcoef(walks) - np.eye(3)).max() < 0.95


def test_tints_cancel_over_cameras_and_do_not_brighten():
    settings = replace(CLEAN, num_cameras=3, white_balance=0.04)
    gains = np.log([there(recorded_gains(settings, 0, camera)) for camera in range(3)])
    np.testing.assert_allclose(gains.sum(0), 0, atol=1e-6)
    np.testing.assert_allclose(gains.sum(1), 0, atol=1e-6)
    np.testing.assert_allclose(gains.std(), 0.04, rtol=1e-5)
    np.testing.assert_array_equal(gains, np.log([there(recorded_gains(settings, 1, camera)) for camera in range(3)]))
    assert recorded_gains(CLEAN, 0, 0) is None
    np.testing.assert_array_equal(recorded_gains(replace(CLEAN, num_frames=1, exposure_walk=0.2), 0, 0), 1)


@pytest.mark.lengthy
def test_the_truth_has_neither(tmp_path):
    """Its images are those of the clean street; what was recorded is not."""
    settings = replace(CLEAN, exposure_walk=0.4, white_balance=0.1)
    with unchecked():
        clean = StreetReader(CLEAN, tmp_path / "clean").read()
        log = StreetReader(settings, tmp_path / "walk").read()
        truth, same = (one.truth(log.views[2]) for one in (log, clean))
    assert torch.equal(truth.image, same.image)
    off = (truth.image.float() - log.frames[2].image.float()).mean((0, 1)).abs().max()
    assert off > 10
    assert (truth.image.float() - clean.frames[2].image.float()).mean((0, 1)).abs().max() < 1


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"exposure_walk": -0.1}, "exposure_walk must not be negative"),
        ({"white_balance": 0.1, "num_cameras": 1}, "white_balance needs two cameras"),
    ],
)
def test_settings_that_cannot_be(wrong, said):
    with pytest.raises(ValueError, match=said):
        replace(CLEAN, **wrong)
