"""A street small enough to be traced in seconds."""

from dataclasses import replace

import pytest

from sparsestreet.data.log import DrivingLog
from sparsestreet.data.synthetic import StreetReader, StreetSettings
from sparsestreet.data.synthetic.settings import WAYMO_TOP
from tests.conftest import unchecked


@pytest.fixture(scope="session")
def street(tmp_path_factory) -> DrivingLog:
    """8 frames of 2 cameras; ``street.name`` is its folder, which holds the exact truth."""
    return traced(
        tmp_path_factory.mktemp("triangulation") / "street",
        num_frames=8,
        width=160,
        height=96,
        num_cameras=2,
        supersampling=1,
    )


def traced(root, **settings) -> DrivingLog:
    """With a lidar that takes no time; points from images do not use it."""
    lidar = replace(WAYMO_TOP, beams=2, azimuth_steps=30)
    with unchecked():
        log = StreetReader(StreetSettings(lidar=lidar, **settings), root).read()
    return replace(log, name=str(root))
