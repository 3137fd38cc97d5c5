"""Errors by distance: regions of a small street, dB by hand, and paired differences."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from benchmarks import far_things
from benchmarks.far_things import FarRecord, Seen, differences, measured, traced
from sparsestreet.data.synthetic import StreetReader, StreetSettings
from sparsestreet.types import Camera, View
from tests.conftest import unchecked


def test_regions_are_of_the_depth_that_was_traced(tmp_path):
    settings = StreetSettings(num_frames=2, width=48, height=32, num_cameras=1, supersampling=1)
    with unchecked():
        reader = StreetReader(settings, tmp_path / "street")
        views = [replace(reader.read().views[1], frame_index=None, camera_index=None)]
        (seen,) = traced(reader, views)
    with np.load(tmp_path / "street" / "depth" / "001_0.npz") as truth:
        depth = truth["depth"]
    assert [*seen.regions] == ["full", "sky", "0 to 20 m", "20 to 40 m", "beyond 40 m"]
    for name, expected in {
        "full": depth > -1,
        "sky": depth == 0,
        "0 to 20 m": (depth > 0) & (depth < 20),
        "20 to 40 m": (depth >= 20) & (depth < 40),
        "beyond 40 m": depth >= 40,
    }.items():
        # the log's poses are float32: a pixel of an outline may be another thing
        assert (seen.regions[name] != expected).mean() < 0.01
        assert expected.any()
    recorded = reader.read().frames[1].image.numpy().astype(int)
    assert np.abs(recorded - seen.image).mean() < 2


@dataclass(frozen=True)
class Stub:
    """Renders one color."""

    color: float

    def render(self, view: View) -> SimpleNamespace:
        return SimpleNamespace(rgb=torch.full((2, 2, 3), self.color))

    @property
    def scene(self) -> SimpleNamespace:
        return SimpleNamespace(counts=lambda: {"background": 5, "rigid": 2})


def two_views() -> list[Seen]:
    """Black and white; the far pixels are one of the first view and three of the second."""
    view = View(Camera(torch.eye(4), torch.eye(3), width=2, height=2), 0.0)
    every, far = np.ones((2, 2), bool), np.array([[True, False], [False, False]])
    images = np.zeros((2, 2, 3), np.uint8), np.full((2, 2, 3), 255, np.uint8)
    return [
        Seen(view, image, {"full": every, "far": region, "none": ~every})
        for image, region in zip(images, (far, ~far), strict=True)
    ]


def test_errors_are_pooled_before_they_become_decibels(monkeypatch):
    monkeypatch.setattr(far_things, "open_scene", lambda run, device: Stub(1.25))  # 1 on a screen
    found = measured(Path("runs/a"), 3, 2.0, two_views())
    assert (found.street, found.run, found.gaussians, found.beside) == (3, "a", 7, 2.0)
    assert found.psnr == pytest.approx({"full": -10 * np.log10(0.5), "far": -10 * np.log10(0.25)})
    assert found.pixels == {"full": 1.0, "far": 0.5, "none": 0.0}


def records(beside: float, values: Sequence[float], **more: float) -> list[FarRecord]:
    return [FarRecord(n, "run", 9, beside, {"full": value} | more, {}) for n, value in enumerate(values)]


def test_differences_are_of_pairs_and_of_what_all_runs_have():
    before = records(0.0, [20.0, 22.0, 30.0], sky=30.0) + records(3.0, [10.0, 10.0, 10.0])
    after = records(0.0, [21.0, 24.0, 33.0]) + records(3.0, [10.5, 10.5, 10.5])
    path, beside = differences(before, after)
    assert (path.beside, path.region, path.streets, path.mean) == (0.0, "full", 3, 2.0)
    assert path.within == pytest.approx(4.303 / 3**0.5, rel=1e-3)  # t of 2 degrees of freedom, deviation 1
    assert (beside.beside, beside.mean, beside.within) == (3.0, 0.5, 0.0)
    (alone,) = differences(before[:1], after[:1])
    assert (alone.mean, alone.within) == (1.0, None)


def test_runs_of_other_logs_are_refused(tmp_path, capsys):
    assert far_things.main([f"before={tmp_path}", f"after={tmp_path}", f"out={tmp_path}"]) == 1
    assert str(tmp_path) in capsys.readouterr().err
    assert far_things.main([]) == 2
