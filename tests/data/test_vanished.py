"""An image that goes while a run trains: one error that names the file, whichever thread met it."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from sparsestreet.data.frame_cache import Prefetcher
from sparsestreet.data.images import read_image
from sparsestreet.data.problems import LogError
from sparsestreet.types import Frame
from tests.scene.street import frame_at


def test_a_frame_that_vanished_is_an_error_at_its_own_step_and_the_others_are_read(tmp_path: Path):
    """The threads meet it early; who trains hears of it when the frame is due, and may go on behind it."""
    paths = [tmp_path / f"{number}.png" for number in range(6)]
    for path in paths:
        Image.fromarray(np.zeros((4, 6, 3), np.uint8)).save(path)
    paths[3].unlink()

    def read(draw: int) -> Frame:
        read_image(paths[draw], (6, 4))
        return frame_at(draw)

    ahead = Prefetcher(read, torch.device("cpu"), threads=2)
    try:
        assert [ahead.take(draw).frame_index for draw in range(3)] == [0, 1, 2]
        with pytest.raises(LogError, match=r"3\.png.*cannot be decoded .*No such file"):
            ahead.take(3, 6)
        assert [ahead.take(draw, 6).frame_index for draw in (4, 5)] == [4, 5]
    finally:
        ahead.close()
