"""Time against work: sizes of constant density, the line on record, the figure."""

import pytest

from sparsestreet.bench.records import RecordFile, read_records
from sparsestreet.bench.scaling import DENSITY, ROWS, run_scaling, sized
from sparsestreet.bench.scenes import Size
from sparsestreet.bench.timing import TimingBudget
from tests.bench.test_records import PROVENANCE


def test_density_is_the_same_at_every_size():
    for rows in ROWS[1:]:
        size = sized(rows)
        # Sides are rounded to 16 px: 8 of 64 at worst for the least of these.
        assert size.rows / (size.width * size.height) == pytest.approx(DENSITY, rel=0.15)
        assert size.width % 16 == size.height % 16 == 0
    assert (min(ROWS), max(ROWS)) == (1_000, 3_000_000)


@pytest.mark.lengthy
def test_a_line_through_small_sizes(tmp_path):
    file, said = RecordFile(tmp_path / "scaling.jsonl", PROVENANCE), []
    run_scaling((300, 1200), Size(64, 48, 500), TimingBudget(repeats=2, least=1), file, tmp_path, said.append)
    records = read_records(file.path)
    assert [record["kind"] for record in records] == ["scaling"] * 3 + ["fit"] * 2
    small, large, beside = records[:3]
    assert large["times"]["pairs"] > 3 * small["times"]["pairs"]
    assert [record["fitted"] for record in (small, large, beside)] == [True, True, False]
    forward = next(record for record in records if record["kind"] == "fit" and record["part"] == "forward")
    # Two points: the line goes through both.
    at = [
        forward["line"]["intercept"] + forward["line"]["slope"] * record["times"]["pairs"] for record in (small, large)
    ]
    assert at == pytest.approx([r["times"]["stages"]["forward"]["median"] for r in (small, large)], rel=1e-3)
    assert forward["line"]["r_squared"] == pytest.approx(1)
    assert (tmp_path / "scaling.svg").is_file()
    assert (tmp_path / "scaling.png").is_file()
