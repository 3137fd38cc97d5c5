"""Over which views a run is measured beyond its quality."""

import pytest
import torch

from sparsestreet.data.datamodule import StreetData
from sparsestreet.data.lazy import Frames, Sweeps
from sparsestreet.data.log import DrivingLog
from sparsestreet.evaluation import extra
from sparsestreet.evaluation.extra import ExtraMetrics, _of_shifts
from sparsestreet.records.novel import NOVEL, NovelRecord, NovelShift
from sparsestreet.records.presets import PRESETS
from tests.evaluation.frames import make_frame
from tests.evaluation.scenes import OPTIONS, small_scene


@pytest.mark.lengthy
@pytest.mark.parametrize(("stride", "views", "ramp"), [(2, 1, True), (0, 3, False)])
def test_the_held_out_views_are_measured_and_the_training_views_where_there_are_none(
    monkeypatch, tmp_path, stride, views, ramp
):
    """Of three instants the second is held out, or none."""
    monkeypatch.setattr(extra, "open_lpips", lambda device: ({}, {"lpips_alex": "no weights"}))
    frames = tuple(make_frame(index) for index in range(3))
    data = StreetData(
        DrivingLog("three", Frames.of(frames), Sweeps.of(()), (), 3, 1, torch.eye(4).double()), stride=stride, offset=1
    )
    (tmp_path / "records").mkdir()
    said = []
    asked = ExtraMetrics(novel=(1.0,), ramp=ramp, presets=("fast",))
    asked.measure(small_scene(), data, OPTIONS, out=tmp_path, command="c", say=said.append)
    beside = NOVEL.read(tmp_path)
    assert (beside.real_views, beside.ramp) == (views, ramp)
    assert PRESETS.read(tmp_path).views == views
    assert f"1 m to the right (n={views}): nothing to compare with" in said


def test_what_is_said_of_a_side():
    """Offsets are meters to the right, as in the record."""
    shifts = [
        NovelShift(offset=offset, views=6, distances={"fid": 42.0}, truth={"psnr_full": 20.0}, true_views=6)
        for offset in (2.0, -2.0)
    ]
    record = NovelRecord(command="c", ramp=False, real_views=6, absent=None, shifts=tuple(shifts))
    said = [f"2 m to the {side} (n=6): fid 42, 20.00 dB to the truth" for side in ("right", "left")]
    assert list(_of_shifts(record)) == said
