"""Rows that the tests of this room draw."""

import pytest
import torch

from sparsestreet.bench.scenes import frustum_camera, frustum_gaussians
from sparsestreet.bench.timing import leaves
from sparsestreet.types import Gaussians


@pytest.fixture
def rows() -> Gaussians:
    """Sixty Gaussians that learn, before a camera of 48x32."""
    return leaves(frustum_gaussians(60, frustum_camera(48, 32), sigma_pixels=2.0, terms=9), torch.float32)
