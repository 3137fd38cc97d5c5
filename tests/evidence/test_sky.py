"""The share of sky is that of the masks, and unknown without any."""

from dataclasses import replace

import pytest
import torch

from sparsestreet.data.lazy import Frames, as_frames
from sparsestreet.evidence.light import sky_share
from sparsestreet.scene.effects import SkySettings
from tests.scene.street import street_log, training_data


def frames(*shares: float) -> Frames:
    """The street's first frames, each with this share of its pixels masked."""
    made = []
    for frame, share in zip(street_log().frames, shares, strict=False):
        height, width, _ = frame.image.shape
        mask = torch.arange(height * width).reshape(height, width) < share * height * width
        made.append(replace(frame, sky=mask))
    return as_frames(made)


def test_mean_and_error_are_over_images():
    found = sky_share(frames(0.2, 0.4, 0.6))
    assert found is not None
    assert found.share == pytest.approx(0.4, abs=2e-3)  # a pixel of 33 x 21 is 0.0014
    assert found.error == pytest.approx(0.2 / 3**0.5, abs=2e-3)
    assert found.frames == 3


@pytest.mark.parametrize(("share", "wanted"), [(0.0, False), (0.0025, False), (0.01, True)])
def test_a_tunnel_has_none(share: float, wanted: bool):
    data = replace(training_data(), frames=frames(share, share))
    found = SkySettings().detect(data)
    assert (found.called_for, found.missing) == (wanted, None)


def test_without_masks_there_is_a_sky():
    data = training_data()
    assert sky_share(as_frames([replace(frame, sky=None) for frame in data.frames])) is None
    found = SkySettings().detect(replace(data, frames=as_frames([replace(frame, sky=None) for frame in data.frames])))
    assert (found.called_for, found.value) == (True, None)
