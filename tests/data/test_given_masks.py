"""Masks beside a data set: found by kind, camera and stem."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from sparsestreet.data.images import GivenMasks
from sparsestreet.data.problems import LogError
from sparsestreet.data.rig import Undistortion
from sparsestreet.geometry.lenses import Fisheye

SIZES = {"recorded_size": (8, 4), "size": (8, 4)}


@pytest.fixture
def masks(tmp_path: Path) -> GivenMasks:
    """Sky of one image of the camera front: its upper half."""
    folder = tmp_path / "sky" / "front"
    folder.mkdir(parents=True)
    pixels = np.zeros((4, 8), np.uint8)
    pixels[:2] = 255
    Image.fromarray(pixels).save(folder / "000.png")
    return GivenMasks(tmp_path)


def test_a_mask_is_found_by_kind_camera_and_stem(masks):
    found = masks.read("front", "000", **SIZES)
    assert (masks.kinds, list(found)) == ({"sky"}, ["sky"])
    assert found["sky"].any(1).tolist() == [True, True, False, False]
    assert masks.read("front", "000", recorded_size=(8, 4), size=(4, 2))["sky"].shape == (2, 4)


def test_a_camera_without_a_folder_has_none_and_one_with_a_folder_has_all(masks):
    assert masks.read("rear", "000", **SIZES) == {}
    with pytest.raises(LogError, match=r"001\.png: the mask is missing"):
        masks.read("front", "001", **SIZES)
    (problem,) = masks.check([("front", "000"), ("front", "001"), ("rear", "000")])
    assert problem.path.name == "001.png"


def test_a_mask_of_another_size_and_a_folder_of_none_are_refused(masks, tmp_path):
    with pytest.raises(LogError, match="the mask is 8x4, the camera's images are 16x8"):
        masks.read("front", "000", recorded_size=(16, 8), size=(8, 4))
    (problem,) = GivenMasks(tmp_path / "sky").check([])
    assert "none of the folders sky, human, vehicle, ego" in problem.message


def test_a_lens_is_taken_out_of_masks_too(masks):
    lens = Fisheye(fx=4.0, fy=4.0, cx=4.0, cy=2.0)
    take_out = Undistortion.of(lens, lens.pinhole, (8, 4), (8, 4))
    plain, seen = masks.read("front", "000", **SIZES), masks.read("front", "000", undistortion=take_out, **SIZES)
    expected = take_out(255 * plain["sky"].numpy().astype(np.uint8)) > 0
    assert (seen["sky"].numpy() == expected).all()
    assert not torch.equal(seen["sky"], plain["sky"])
