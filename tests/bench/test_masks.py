"""A mask's network beside its bits."""

import pytest
import torch

from sparsestreet.bench import masks
from sparsestreet.bench.masks import run_masks
from sparsestreet.bench.records import RecordFile, read_records
from sparsestreet.bench.timing import TimingBudget
from sparsestreet.scene.masks.temporal import TemporalMask
from tests.bench.test_records import PROVENANCE


def test_times_are_of_the_network_then_of_the_bits(monkeypatch, tmp_path):
    """On a clock of which a look at the network takes 5 ms, one at the bits 1 ms; frames in turn, from 0 to 1."""
    now, asked = [0.0], []
    monkeypatch.setattr(masks.time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(masks, "FRAMES", 5)
    make = masks._masked_rows

    def slow(mask, seconds):
        look = mask.multipliers

        def multipliers(rows, time):
            asked.append((type(mask).__name__, len(rows), time))
            now[0] += seconds
            return look(rows, time)

        monkeypatch.setattr(mask, "multipliers", multipliers)
        return mask

    def made(count, frames):
        mask, rows = make(count, frames)
        assert isinstance(mask, TemporalMask)
        finish = mask.finish

        def finished(rows):
            baked, buffers = finish(rows)
            return slow(baked, 1e-3), buffers

        monkeypatch.setattr(mask, "finish", finished)
        return slow(mask, 5e-3), rows

    monkeypatch.setattr(masks, "_masked_rows", made)
    file, said = RecordFile(tmp_path / "masks.jsonl", PROVENANCE), []
    run_masks((20, 30), 12, TimingBudget(repeats=4), file, said.append)
    records = read_records(file.path)
    assert [(one["kind"], one["rows"], one["frames"]) for one in records] == [("masks", 20, 12), ("masks", 30, 12)]
    for one, rows in zip(records, (20, 30), strict=True):
        assert (one["network"]["median"], one["bits"]["median"]) == pytest.approx((5.0, 1.0))
        assert one["network"]["repeats"] == one["bits"]["repeats"] == 4
        assert one["bytes_of_bits"] == rows * 2  # 12 frames in two bytes
    # Two warm-ups, then four that count, of the network and of the bits of both sizes.
    times = [0.0, 0.25, 0.5, 0.75, 1.0, 0.0]
    first, *others = (asked[start : start + 6] for start in range(0, 24, 6))
    assert [time for _, _, time in first] == times
    assert [[time for _, _, time in some] for some in others] == [times] * 3
    assert [len({(name, rows) for name, rows, _ in some}) for some in (first, *others)] == [1] * 4
    assert [rows for _, rows, _ in asked[::6]] == [20, 20, 30, 30]
    assert said[0].startswith("     20 Gaussians, 12 frames: network ")
    assert said[0].endswith("40 bytes; 4.00 ms saved a frame")


def test_the_rows_of_a_mask():
    """In a box of 2 m around the origin; the mask covers all frames."""
    mask, rows = masks._masked_rows(500, 3)
    assert len(rows) == 500
    assert float(rows.means.detach().abs().max()) <= 1.0
    assert rows.means.detach().min(0).values.max() < -0.9 < 0.9 < rows.means.detach().max(0).values.min()
    assert rows.sh_rest.shape == (500, 15, 3)
    assert torch.allclose(rows.opacity_logits.detach().sigmoid(), torch.tensor(0.5))
    assert float(rows.log_scales.detach().exp().mean()) == pytest.approx(0.02, rel=1e-3)
    _, buffers = mask.finish(rows)
    assert sum(map(masks._bytes, buffers.values())) == 500
