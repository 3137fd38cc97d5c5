"""Over which views a run is measured beyond its quality."""

import pytest
import torch

from sparsestreet.data.datamodule import StreetData
from sparsestreet.data.log import DrivingLog
from sparsestreet.evaluation import extra
from sparsestreet.evaluation.extra import ExtraMetrics
from sparsestreet.records.novel import NOVEL
from sparsestreet.records.presets import PRESETS
from tests.evaluation.frames import make_frame
from tests.evaluation.scenes import OPTIONS, small_scene


@pytest.mark.parametrize(("stride", "views"), [(2, 1), (0, 3)])
def test_the_held_out_views_are_measured_and_the_training_views_where_there_are_none(
    monkeypatch, tmp_path, stride, views
):
    """Of three instants the second is held out, or none."""
    monkeypatch.setattr(extra, "open_lpips", lambda device: ({}, {"lpips_alex": "no weights"}))
    frames = tuple(make_frame(index) for index in range(3))
    data = StreetData(DrivingLog("three", frames, (), (), 3, 1, torch.eye(4).double()), stride=stride, offset=1)
    (tmp_path / "records").mkdir()
    said = []
    asked = ExtraMetrics(novel=(1.0,), presets=("fast",))
    asked.measure(small_scene(), data, OPTIONS, out=tmp_path, command="c", say=said.append)
    assert NOVEL.read(tmp_path).real_views == views
    assert PRESETS.read(tmp_path).views == views
    assert f"1 m to the right (n={views}): nothing to compare with" in said
