"""A record of device timings, and its line."""

import dataclasses

import pytest

from sparsestreet.bench import gpu_record
from sparsestreet.bench.accuracy import Errors, ImageError
from sparsestreet.bench.gpu_record import GpuRecord
from sparsestreet.bench.tile_loads import TileLoads
from sparsestreet.bench.timing import TimeSpread


def test_a_line_has_medians_and_spreads():
    value, single = TimeSpread(1.25, 1.0, 0.125, 20), TimeSpread(3.0, 3.0, None, 1)
    record = GpuRecord("sparsestreet triton", "a device", "random frustum", 7, 8, 9, forward=value, backward=single)
    record = dataclasses.replace(record, inference=value, stages={"sort": value, "other": single})
    text = gpu_record.line(record)
    assert "forward 1.250 (iqr 0.125)  backward 3.000  no grad 1.250 (iqr 0.125) ms" in text
    assert "[sort 1.250 (iqr 0.125), other 3.000]" in text


def test_every_number_of_a_record_is_in_its_line():
    values = [TimeSpread(float(place), 0.5, None, 3) for place in range(1, 5)]
    record = GpuRecord("sparsestreet triton", "a device", "a street", 1234, 640, 480)
    assert gpu_record.line(dataclasses.replace(record, failed="RuntimeError: no")).split() == [
        *("sparsestreet", "triton", "a", "street", "1234", "640x480", "FAILED:", "RuntimeError:", "no"),
    ]
    inference, forward, backward, step = values
    record = dataclasses.replace(record, inference=inference, forward=forward, backward=backward)
    start = "sparsestreet triton     a street             1234 640x480    forward 2.000  backward 3.000"
    assert gpu_record.line(record) == f"{start}  no grad 1.000 ms"
    assert gpu_record.line(dataclasses.replace(record, inference=None)) == f"{start}  no grad - ms"
    assert gpu_record.line(dataclasses.replace(record, backward=None, failed="why")).endswith("FAILED: why")
    image = ImageError(0.1, 0.2, 61.25)
    whole = dataclasses.replace(
        record, step=step, pairs=2_500_000, samples=70_000_000, memory_before=10.0, memory_peak=345.0,
        parity=Errors(image, {}), agrees=True, failed="late",
    )  # fmt: skip
    assert gpu_record.line(whole) == (
        f"{start}  no grad 1.000 ms  step 4.000  2.50 M pairs, 70 M samples  peak     345 MB  agrees: 61.2 dB"
        "  FAILED: late"
    )
    busy = dataclasses.replace(whole, launches=31, waits=1, tiles=TileLoads(804.4, 421.5, 7925, 700, 2500, 1300))
    said = "  tiles 804 pairs, longest 7925, 700 split in 2500 parts"
    assert gpu_record.line(busy) == gpu_record.line(whole).replace(
        "  peak     345 MB", f"{said}  peak     345 MB  31 launches, 1 waits"
    )
    without = dataclasses.replace(whole, samples=None)
    assert gpu_record.line(without) == gpu_record.line(whole).replace(", 70 M samples", "")
    assert " M " not in gpu_record.line(dataclasses.replace(without, pairs=None))


@pytest.mark.parametrize(
    ("failed", "agrees", "ok"), [(None, None, True), (None, True, True), (None, False, False), ("why", True, False)]
)
def test_a_failure_or_a_disagreement_is_not_ok(failed, agrees, ok):
    assert GpuRecord("r", "d", "s", 1, 2, 3, failed=failed, agrees=agrees).ok is ok
