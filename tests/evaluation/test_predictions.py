"""Predictions on disk: what an image of 16 bits holds, and what is no such image."""

import numpy as np
import pytest
from PIL import Image

from sparsestreet.evaluation.evaluate import PredictionError, Predictions, quantized, restored

RGB = np.random.default_rng(0).random((9, 12, 3)).astype(np.float32)


def test_a_prediction_keeps_16_bits(tmp_path):
    predictions = Predictions.of(tmp_path, "held_out")
    predictions.write(3, 1, quantized(RGB))
    found = predictions.read(3, 1)
    assert (found == np.round(RGB.astype(np.float64) * 65535)).all()
    assert np.abs(restored(found).astype(np.float64) - RGB).max() <= 0.5 / 65535 + 6e-8  # and float32's own rounding
    assert [file.name for file in (tmp_path / "predictions" / "held_out").iterdir()] == ["003_1.png"]


def test_ends_and_ties():
    assert quantized(np.array([[[0.0, 1.0, 0.5]]])).tolist() == [[[0, 65535, 32768]]]
    assert restored(np.array([[[0, 65535, 32768]]], np.uint16))[0, 0, :2].tolist() == [0.0, 1.0]


def test_another_program_reads_red_green_and_blue(tmp_path):
    """Of its own decoder, in the order of an RGB image."""
    predictions = Predictions(tmp_path)
    predictions.write(3, 1, quantized(RGB))
    data = predictions.path(3, 1).read_bytes()
    assert (data[24], data[25]) == (16, 2)  # of the PNG header: bits of a channel, and 2 for RGB
    with Image.open(predictions.path(3, 1)) as image:  # Pillow keeps the upper eight bits
        assert (np.asarray(image) == quantized(RGB) // 256).all()


@pytest.mark.parametrize("kind", ["8 bits", "gray", "text", "cut short"])
def test_a_file_that_is_no_prediction_is_refused(tmp_path, kind):
    predictions = Predictions(tmp_path)
    path = predictions.path(0, 0)
    if kind == "8 bits":
        Image.fromarray((RGB * 255).astype(np.uint8)).save(path)
    elif kind == "gray":
        Image.fromarray((RGB[..., 0] * 65535).astype(np.uint16)).save(path)
    elif kind == "text":
        path.write_text("no image")
    else:
        predictions.write(0, 0, quantized(RGB))
        path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(PredictionError, match=r"000_0\.png .* evaluate the run again"):
        predictions.read(0, 0)


def test_a_missing_prediction_says_what_makes_it(tmp_path):
    with pytest.raises(PredictionError, match="is not there: evaluate the run, which stores its predictions"):
        Predictions(tmp_path).read(0, 0)
