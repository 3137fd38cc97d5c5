"""The stages beside vectorized torch, at a size of milliseconds."""

import pytest

from sparsestreet.bench import blend
from sparsestreet.bench.records import RecordFile, read_records
from sparsestreet.bench.scenes import Size
from sparsestreet.bench.timing import TimingBudget
from tests.bench.test_records import PROVENANCE

ONCE = TimingBudget(repeats=2, seconds=0.0, least=1)


def test_main_size_has_a_peer_and_a_floor(tmp_path, monkeypatch):
    monkeypatch.setattr(blend, "measured_peak", lambda: 1e11)
    file, said = RecordFile(tmp_path / "blend.jsonl", PROVENANCE), []
    blend.run_blend(Size(64, 48, 300), [Size(48, 32, 200)], ONCE, ONCE, file, said.append)
    main, training = read_records(file.path)
    assert set(main["peer"]) == {"forward", "both"}
    samples = main["times"]["samples"]
    assert main["floor_ms"] == pytest.approx({"blend": 30e3 * samples / 1e11, "blend_backward": 57e3 * samples / 1e11})
    assert main["difference"]["pixels"] == 64 * 48
    assert main["difference"]["largest_without_ties"] <= 1e-5
    assert training["peer"] is None
    text = "\n".join(said)
    assert "torch over C++" in text
    assert "x its floor" in text
