"""Streets whose images show the hood of the recording car."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sparsestreet.data.synthetic import StreetReader, StreetSettings, make_street
from sparsestreet.data.synthetic.render import hood_coverage, render_frame
from sparsestreet.data.synthetic.settings import WAYMO_TOP
from sparsestreet.data.synthetic.world import build_world
from tests.conftest import unchecked
from tests.typed import there

HOODED = StreetSettings(
    seed=3, num_frames=2, width=48, height=30, num_cameras=2, frame_rate=1.0, supersampling=1, num_parked_cars=3,
    num_moving_cars=1, num_pedestrians=0, num_cyclists=0, lidar=replace(WAYMO_TOP, beams=2, azimuth_steps=16),
    hood=0.2, hood_known=True,
)  # fmt: skip


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    with unchecked():
        return make_street(HOODED, tmp_path_factory.mktemp("streets") / "hooded")


@pytest.mark.lengthy
def test_it_covers_the_bottom_of_the_front_camera_alone():
    world = build_world(HOODED)
    with unchecked():
        clean, hooded = (render_frame(one, world, 1).images for one in (replace(HOODED, hood=0.0), HOODED))
    np.testing.assert_array_equal(clean[1].rgb, hooded[1].rgb)
    covered = (clean[0].rgb != hooded[0].rgb).any(-1)
    # Whole rows at the bottom, none above the edge's middle: 1.1 times 0.2 of 30 rows.
    assert covered[-4:].all()
    assert not covered[: 30 - 7].any()
    assert hooded[0].rgb[-3:].mean() < 100
    assert not hooded[0].depth[-4:].any()
    assert (hooded[0].object_indices[-4:] == -1).all()
    np.testing.assert_array_equal(clean[0].depth[:23], hooded[0].depth[:23])


@pytest.mark.lengthy
def test_it_stands_still_while_the_street_passes(root):
    """A second apart: what is mirrored in it moves by the little that the car turns."""
    first, last = (np.array(Image.open(root / f"images/00{frame}_0.jpg"), float) for frame in range(2))
    moved = np.abs(first - last).mean(-1)
    assert moved[-4:].mean() < 4
    assert moved[:23].mean() > 12


@pytest.mark.lengthy
def test_its_masks_are_written_where_they_are_asked_for(root):
    """By the reader they are ``Frame.ego``; the truth beside the path has no hood."""
    log = StreetReader(HOODED, root).read()
    front, left = log.frames[0], log.frames[1]
    assert left.ego is None
    ego = there(front.ego).numpy()
    np.testing.assert_array_equal(ego, there(hood_coverage(HOODED, 0)) > 0)
    with unchecked():
        truth = there(there(log.truth)(log.views[0])).image.numpy().astype(float)
    off = np.abs(truth - front.image.numpy()).mean(-1)
    assert off[ego].mean() > 30
    assert off[:22].mean() < 3
    assert not list(root.glob("ego_masks/1.png"))


@pytest.mark.lengthy
def test_files_are_silent_on_it_unless_asked(tmp_path):
    with unchecked():
        silent = make_street(replace(HOODED, num_frames=1, hood_known=False), tmp_path / "silent")
    assert not (silent / "ego_masks").exists()


@pytest.mark.parametrize(("width", "hood"), [(48, 0.2), (160, 0.1), (33, 0.05)])
def test_its_share_of_the_image_is_the_settings(width, hood):
    settings = replace(HOODED, width=width, hood=hood, hood_cameras="all")
    for camera in range(2):
        assert there(hood_coverage(settings, camera)).mean() == pytest.approx(hood, rel=1e-3)
    assert hood_coverage(replace(settings, hood=0.0), 0) is None


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"hood": 0.6}, r"hood must be a share .* up to 0\.5"),
        ({"hood_cameras": "left"}, "must be front or all but is left"),
    ],
)
def test_settings_that_cannot_be(wrong, said):
    with unchecked(), pytest.raises(ValueError, match=said):
        replace(HOODED, **wrong)
