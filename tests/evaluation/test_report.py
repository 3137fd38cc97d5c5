"""The table on hand-made records, against numbers worked out by hand."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import pytest
from rich.console import Console

from sparsestreet.evaluation.records import summary_path, write_summary
from sparsestreet.evaluation.report import RunRecord, Spread, collect, markdown, sections, spread, tables
from sparsestreet.evaluation.strict_json import RecordError
from tests.evaluation.frames import make_summary


def records(*summaries):
    return [RunRecord(Path(f"run{index}"), summary) for index, summary in enumerate(summaries)]


PLAIN_AND_OURS = records(
    make_summary("plain", 0, psnr=25.0, gaussians={"background": 1000, "rigid": 200}, training_seconds=100.0),
    make_summary("plain", 1, psnr=27.0, gaussians={"background": 1400, "rigid": 200}, training_seconds=120.0),
    make_summary("ours", 0, psnr=24.9, gaussians={"background": 300, "rigid": 100}, milliseconds=20.0),
    make_summary("ours", 1, psnr=26.6, gaussians={"background": 340, "rigid": 60}, milliseconds=30.0),
)


def cells(row, section):
    return dict(zip([column.heading for column in section.columns], row.cells, strict=True))


def test_rows_hold_mean_spread_and_number_of_runs():
    (section,) = sections(PLAIN_AND_OURS, "plain")
    plain, ours, difference = section.rows
    assert [row.label for row in section.rows] == ["plain", "ours", "ours against plain"]
    found = cells(plain, section)
    assert (found["PSNR"].mean, found["PSNR"].n) == (26.0, 2)
    assert found["PSNR"].sd == pytest.approx(2**0.5)
    assert found["Gaussians"].mean == 1400.0
    assert found["Gaussians"].sd == pytest.approx(200 * 2**0.5)
    assert found["background"].mean == 1200.0
    assert found["MB"].mean == pytest.approx(4 * 59 * 1400 / 1e6)
    assert found["train s"].mean == 110.0
    assert found["vehicle SSIM"] is None
    assert cells(ours, section)["ms/frame"].mean == 25.0

    found = cells(difference, section)
    assert found["PSNR"].mean == pytest.approx((-0.1 - 0.4) / 2)  # paired by seed
    assert found["PSNR"].sd == pytest.approx(0.3 / 2**0.5)
    assert found["Gaussians"].mean == pytest.approx((400 / 1200 + 400 / 1600) / 2 * 100)  # per cent kept
    assert found["ms/frame"].mean == pytest.approx((50 + 75) / 2)
    assert difference.seeds == (0, 1)


def test_markdown_reads_as_written_by_hand():
    lines = markdown(PLAIN_AND_OURS, "plain").splitlines()
    assert lines[0] == "### street (64x48; held out: every 10th frame from 0)"
    header, rule, plain, ours, difference = (line.split(" | ") for line in lines[2:7])
    assert len(header) == len(rule) == len(plain) == len(ours) == len(difference)
    assert header[:3] == ["| method", "runs", "PSNR"]
    assert plain[:3] == ["| plain", "n=2 (seed 0,1)", "26.00 ± 1.41"]
    assert ours[:3] == ["| ours", "n=2 (seed 0,1)", "25.75 ± 1.20"]
    assert difference[2] == "-0.25 ± 0.21"
    assert difference[header.index("Gaussians")] == "29.2 ± 5.9 %"
    assert plain[header.index("vehicle SSIM")] == "-"
    assert "**" not in markdown(PLAIN_AND_OURS, "plain")


def test_a_single_run_says_so_and_has_no_spread():
    text = markdown(PLAIN_AND_OURS[:1])
    assert "| plain | n=1 (seed 0) | 25.00 |" in text
    assert "n=1 has no spread" in text


def test_cells_of_fewer_runs_than_the_row_carry_their_number():
    text = markdown(records(make_summary(seed=0), make_summary(seed=1, vehicle_psnr=None)))
    assert "22.00 (n=1)" in text


def test_only_shared_seeds_are_paired():
    (section,) = sections(
        records(make_summary("plain", 0), make_summary("ours", 1), make_summary("mask", 0, psnr=26.0)), "plain"
    )
    by_label = {row.label: row for row in section.rows}
    assert by_label["ours against plain"].cells[0] is None
    assert by_label["mask against plain"].cells[0] == Spread(1.0, None, 1)
    assert "no shared seed" in markdown(records(make_summary("plain", 0), make_summary("ours", 1)), "plain")


def test_runs_of_one_seed_count_as_their_mean_in_a_pair():
    (section,) = sections(
        records(make_summary("plain", 0), make_summary("ours", 0, psnr=25.5), make_summary("ours", 0, psnr=26.5)),
        "plain",
    )
    assert section.rows[1].seeds == (0, 0)
    assert section.rows[2].cells[0] == Spread(1.0, None, 1)


def test_other_scenes_and_splits_get_tables_of_their_own():
    found = sections(
        records(make_summary(), make_summary(scene="kitti"), make_summary(split="every 5th frame from 0")), "plain"
    )
    assert len(found) == 3
    assert found[0].title.startswith("kitti")


def test_a_section_without_the_baseline_says_so():
    found = sections(records(make_summary(), make_summary("ours", scene="kitti")), "plain")
    assert "no run of the baseline plain here, so no differences" in found[0].notes
    with pytest.raises(ValueError, match=r"no run has the baseline method 'none': choose one of \['plain'\]"):
        sections(records(make_summary()), "none")


def test_clocks_of_different_devices_are_called_incomparable():
    (section,) = sections(records(make_summary(), make_summary("ours", device="cuda: big")))
    assert any(note.startswith("ms/frame are not comparable") and "cuda: big" in note for note in section.notes)
    (section,) = sections(records(make_summary(), make_summary("ours")))
    assert not any("not comparable" in note for note in section.notes)


def test_two_meanings_of_one_metric_do_not_meet_in_a_table():
    first, second = make_summary(), make_summary("ours")
    second.definitions["psnr_full"] = "something else"
    with pytest.raises(ValueError, match="psnr_full means different things in run0 and run1"):
        sections(records(first, second))


def guards_note(*summaries):
    (section,) = sections(records(*summaries))
    (note,) = [note for note in section.notes if note.startswith("guards")]
    return note


def test_guards_that_fired_are_named():
    calm, older = make_summary(), dataclasses.replace(make_summary(seed=2), guards=None)
    loud = make_summary("ours", 3, alarms={"vanished": 1234, "color_held": 1})
    assert guards_note(calm, make_summary(seed=1)) == "guards: none fired"
    assert guards_note(calm, loud) == "guards: ours (seed 3) vanished 1,234, color_held 1"
    assert guards_note(make_summary("plain", 1, alarms={"overflowed": 7}), loud) == (
        "guards: plain (seed 1) overflowed 7; ours (seed 3) vanished 1,234, color_held 1"
    )
    assert guards_note(calm, older) == "guards: none fired (1 of 2 runs did not count them)"
    assert guards_note(older) == "guards: not counted"


def printed(table, width):
    console = Console(width=width)
    with console.capture() as capture:
        console.print(table)
    return capture.get()


def test_a_few_methods_fit_a_terminal_of_80_characters():
    (table,) = tables(PLAIN_AND_OURS, "plain")
    text = printed(table, 80)
    for cell in ("26.00 ± 1.41", "25.75 ± 1.20", "-0.25 ± 0.21", "29.2 ± 5.9 %", "1,400 ± 283", "every 10th frame"):
        assert cell in text
    assert "…" not in text


def test_many_methods_stand_below_each_other():
    (table,) = tables(records(*(make_summary(f"method{index}") for index in range(6))))
    assert table.row_count == 6
    assert table.columns[0].header == "method"


def test_collect_finds_each_run_once(tmp_path):
    for name in ("a/run", "b"):
        write_summary(summary_path(tmp_path / name), make_summary(name))
    found = collect([tmp_path, tmp_path / "a", tmp_path / "a" / ".." / "b"])
    assert [record.summary.run.method for record in found] == ["a/run", "b"]
    assert found[1].folder == (tmp_path / "b").resolve()
    assert collect([tmp_path / "b"])[0].summary.run.method == "b"  # the run's folder itself


def test_collect_names_what_is_wrong(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"holds no records/summary\.json"):
        collect([tmp_path])
    write_summary(summary_path(tmp_path / "good"), make_summary())
    broken = summary_path(tmp_path / "broken")
    broken.parent.mkdir(parents=True)
    broken.write_text("{}")
    with pytest.raises(RecordError, match=r"broken/records/summary\.json"):
        collect([tmp_path])


def test_spread():
    assert spread([]) is None
    assert spread([3.0]) == Spread(3.0, None, 1)
    assert spread([1.0, 2.0, 6.0]).sd == pytest.approx(7**0.5)


def test_reading_records_imports_no_torch():
    modules = ("records", "report", "compare", "pictures", "plots", "quality", "provenance")
    names = ", ".join(f"sparsestreet.evaluation.{name}" for name in modules)
    code = f"import sys, {names}; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
