"""The paper's tables: its figures beside ours, its rows, and runs that failed."""

from dataclasses import replace
from pathlib import Path

import pytest

from sparsestreet.metrics.definitions import DEFINITIONS, DRIVESTUDIO, STRICT
from sparsestreet.records.run import FailedRun
from sparsestreet.records.summary import HELD_OUT, NOVEL, SUMMARY, TRAINING, Evaluation, MetricSummary
from sparsestreet.report.bundle import _lay
from sparsestreet.report.collect import RunRecord
from sparsestreet.report.paper import TABLES, metric_id, paper_table
from sparsestreet.report.sections import sections
from sparsestreet.report.variants import Variant, variants
from tests.evaluation.frames import CLEAN, MACHINE, disturbed, make_summary, with_ranges
from tests.records.novel import write_beside
from tests.report.sweep_folder import record
from tests.typed import there

RUNS = [
    record(make_summary("omnire-legacy", 0, 29.0, training_psnr=33.0, scene="023"), "a"),
    record(make_summary("omnire-legacy", 0, None, training_psnr=34.0, scene="023", split="none"), "b"),
    record(make_summary("omnire-legacy+paper", 0, 28.0, training_psnr=32.0, scene="023"), "c"),
    record(make_summary("omnire-legacy+removal", 0, 28.5, scene="023"), "d"),
]


@pytest.fixture
def found():
    """As training labels them: the method is omnire, the preset stands in the label."""
    for one in RUNS:
        object.__setattr__(one.summary.run, "method", "omnire")
    return variants(RUNS)


def rows_of(grid):
    keys = [f"{group} {heading}".strip() for group, heading in grid.header]
    return {row[0].text: dict(zip(keys, row, strict=True)) for row in grid.rows}


def test_published_figures_stand_beside_ours(found):
    rows = rows_of(paper_table(found, [], DRIVESTUDIO, "table1_waymo"))
    assert list(rows)[:3] == ["EmerNeRF (published only)", "3DGS (not run)", "HUGS (published only)"]
    plain = rows["omnire-legacy"]
    assert plain["novel views full PSNR"].text == "29.00"
    assert (plain["novel views full PSNR, paper"].text, plain["novel views full PSNR, paper"].published) == (
        "29.86",
        True,
    )
    assert plain["Gaussians (M), paper"].text == "1.55"
    # Of the run that trained on all views, as DriveStudio's reconstruction.
    assert plain["reconstruction full PSNR"].text == "34.00"
    # Of the one that holds views out: the mark says that it compares with no other.
    assert rows["omnire-legacy+paper (1 of 2 runs ‡)"]["FPS, paper"].text == "80.2"
    assert rows["omnire-legacy+paper (1 of 2 runs ‡)"]["reconstruction full PSNR"].text == "32.00"
    assert rows["omnire-legacy+removal (1 of 2 runs ‡)"]["novel views full PSNR, paper"].text == "-"
    assert rows["PVG (not run)"]["FPS, paper"].text == "9.1"
    assert rows["PVG (not run)"]["novel views full PSNR"].text == "-"


def test_another_sweep_has_rows_of_its_own_only(found):
    grid = paper_table(found, [], DRIVESTUDIO, "streets")
    titles = ["omnire-legacy", "omnire-legacy+paper (1 of 2 runs ‡)", "omnire-legacy+removal (1 of 2 runs ‡)"]
    assert list(rows_of(grid)) == titles
    assert "of other data: to be read beside ours, not against it" in grid.notes[0]


def test_ranges_stand_behind_quality_where_a_run_has_lidar(found):
    """Means over the runs that hold views out; a dash for a run without lidar, and for those of the paper."""
    heard = [replace(one, summary=with_ranges(one.summary, 0.131, 0.5)) for one in RUNS[:2]] + RUNS[2:]
    failure = FailedRun(label="omnire+masks", seed=2, command="", error="out of memory", trace="")
    for sweep in ("table1_waymo", "streets"):
        grid = paper_table(variants(heard), [(Path("x"), failure)], DRIVESTUDIO, sweep)
        assert grid.header[-2:] == (("lidar", "median range error, m"), ("lidar", "within 0.2 m, %"))
        rows = {row[0].text: [cell.text for cell in row[-2:]] for row in grid.rows}
        assert rows["omnire-legacy"] == ["0.131", "50.0"]
        assert rows["omnire-legacy+paper (1 of 2 runs ‡)"] == ["-", "-"]
        assert rows["omnire+masks, seed 2: failed, out of memory"] == ["-", "-"]
    assert "lidar" not in {group for group, _ in paper_table(found, [], DRIVESTUDIO, "streets").header}


def test_failed_runs_stand_as_failed(found):
    failure = FailedRun(label="omnire+masks", seed=2, command="", error="out of memory", trace="")
    grid = paper_table(found, [(Path("x"), failure)], DRIVESTUDIO, None)
    assert grid.rows[-1][0].text == "omnire+masks, seed 2: failed, out of memory"
    assert {cell.text for cell in grid.rows[-1][1:]} == {"-"}
    assert "failed runs are in no mean" in grid.notes


def test_a_protocol_chooses_the_metric(found):
    strict = rows_of(paper_table(found, [], STRICT, "table1_waymo"))
    assert strict["omnire-legacy"]["novel views full PSNR"].text == "-"  # these records have no psnr8


def test_published_tables_are_the_papers():
    """Numbers that the paper's text repeats: three times fewer, 70.3 %, 1.14 dB between the strategies."""
    waymo = {row.name: TABLES["table1_waymo"].values(row) for row in TABLES["table1_waymo"].rows}
    count = ("", "", "gaussians")
    assert 1 - there(waymo["OmniRe+Ours"][count]) / there(waymo["OmniRe"][count]) == pytest.approx(0.703, abs=5e-4)
    everywhere, background = (there(row.values[0]) for row in TABLES["table3_pruning"].rows)
    assert background - everywhere == pytest.approx(1.14)
    assert [table.number for table in TABLES.values()] == [1, 2, 3, 4, 5]
    # Number by number, because swapped columns have as many.
    stages = TABLES["table5_ablation"]
    assert stages.values(stages.rows[0]) == {
        ("held_out", "full", "psnr"): 33.35, ("held_out", "full", "ssim"): 0.945, ("held_out", "full", "lpips"): 0.072,
        ("held_out", "human", "psnr"): 26.50, ("held_out", "vehicle", "psnr"): 26.88, count: 0.32e6,
    }  # fmt: skip
    for table in TABLES.values():
        assert all(len(row.values) == len(table.columns) for row in table.rows)


def told_apart(quality):
    """Held-out metrics one apart from ``quality`` on, those of training views 100 more, in the order of DEFINITIONS."""
    return {
        split: {name: MetricSummary(first + place, None, 1, 0) for place, name in enumerate(DEFINITIONS)}
        for split, first in ((HELD_OUT, quality), (TRAINING, quality + 100))
    }


@pytest.mark.parametrize("protocol", [DRIVESTUDIO, STRICT])
def test_every_column_of_ours_is_its_own(protocol):
    """FPS: 1000 / 8 ms. 2,500,000 Gaussians. Reconstruction of the run on all views: 500 more."""
    summaries = [
        replace(make_summary("omnire", 0, training_psnr=1.0, milliseconds=8.0, gaussians={"a": 2_500_000}, split=split),
                quality=told_apart(quality))
        for split, quality in (("some", 0.0), ("none", 500.0))
    ]  # fmt: skip
    found = variants([record(one, name) for one, name in zip(summaries, "ab", strict=True)])
    row = rows_of(paper_table(found, [], protocol, "table1_waymo"))["omnire"]
    values = {name: float(place) for place, name in enumerate(DEFINITIONS)}
    expected = {"method": "omnire", "n": "2", "Gaussians (M)": "2.5", "FPS": "125.0"}
    regions = {"full": (protocol.psnr, protocol.ssim), "human": protocol.human, "vehicle": protocol.vehicle}
    for region, (psnr, ssim) in regions.items():
        for views, more in (("novel views", 0.0), ("reconstruction", 600.0)):
            expected[f"{views} {region} PSNR"] = f"{values[psnr] + more:.2f}"
            expected[f"{views} {region} SSIM"] = f"{values[ssim] + more:.3f}"
    ours = {name: cell for name, cell in row.items() if not name.endswith(", paper")}
    assert {name: cell.text for name, cell in ours.items()} == expected
    assert {(cell.runs, cell.published) for cell in ours.values()} == {(("a", "b"), False)}
    theirs = [cell for name, cell in row.items() if name.endswith(", paper")]
    assert {(cell.runs, cell.published) for cell in theirs} == {((), True)}
    assert len(theirs) == len(ours) - 2


def test_all_views_count_every_image_once():
    """20 dB on 2 held-out images and 26 on 6 training images: 24.5. One of them has a vehicle: 12 of 1 and 18 of 2.

    LPIPS of held-out views alone is no number of all views.
    """

    def quality_of(**numbers):
        return {name: MetricSummary(mean, None, images, 0) for name, (mean, images) in numbers.items()}

    held = quality_of(psnr_full=(20.0, 2), psnr_vehicle=(12.0, 1), psnr_human=(None, 0), lpips_alex_full=(0.1, 2))
    training = quality_of(psnr_full=(26.0, 6), psnr_vehicle=(18.0, 2), psnr_human=(17.0, 3), lpips_alex_full=(None, 0))
    quality = {HELD_OUT: held, TRAINING: training}
    summary = replace(make_summary("omnire+paper", training_psnr=1.0), quality=quality)
    row = rows_of(paper_table(variants([record(summary)]), [], DRIVESTUDIO, "table5_ablation"))["omnire+paper"]
    assert (row["novel views full PSNR"].text, row["all views full PSNR"].text) == ("20.00", "24.50")
    assert (row["novel views vehicle PSNR"].text, row["all views vehicle PSNR"].text) == ("12.00", "16.00")
    assert (row["novel views human PSNR"].text, row["all views human PSNR"].text) == ("-", "17.00")
    assert (row["novel views full LPIPS"].text, row["all views full LPIPS"].text) == ("0.100", "-")
    both = quality | {TRAINING: training | {"lpips_alex_full": MetricSummary(0.3, None, 6, 0)}}
    assert replace(summary, quality=both).mean_of_all("lpips_alex_full") == pytest.approx(0.25)
    assert replace(summary, quality={HELD_OUT: held, TRAINING: held}).mean_of_all("psnr_human") is None


def test_a_scene_on_all_views_alone_has_counts_and_speed_but_no_novel_views():
    only = make_summary("omnire", psnr=None, training_psnr=30.0, milliseconds=8.0, gaussians={"a": 10}, split="none")
    row = rows_of(paper_table(variants([record(only)]), [], DRIVESTUDIO, "table1_waymo"))["omnire"]
    assert (row["FPS"].text, row["Gaussians (M)"].text) == ("125.0", "1e-05")
    assert (row["reconstruction full PSNR"].text, row["novel views full PSNR"].text) == ("30.00", "-")


@pytest.mark.parametrize(("protocol", "metric"), [(DRIVESTUDIO, "lpips_alex_full"), (STRICT, "lpips_alex_no_hood")])
def test_lpips_is_of_the_full_image(protocol, metric):
    assert metric_id(protocol, "full", "lpips") == metric
    assert metric_id(protocol, "human", "lpips") is None
    assert metric_id(protocol, "full", "fid") is None


def test_headers_and_notes_of_a_table():
    found = variants([record(make_summary("omnire")), record(make_summary("omnire+random"))])
    ablation = paper_table(found, [], DRIVESTUDIO, "table5_ablation")
    assert ablation.header[2:4] == (("novel views", "full PSNR"), ("novel views", "full PSNR, paper"))
    regions = [f"full {one}" for one in ("PSNR", "SSIM", "LPIPS")] + ["human PSNR", "vehicle PSNR"]
    assert ablation.header[12:17] == tuple(("all views", region) for region in regions)  # the paper has none
    assert ablation.header[-2:] == (("", "Gaussians (M)"), ("", "Gaussians (M), paper"))
    assert ablation.header[6] == ("novel views", "full LPIPS")
    assert ablation.title.startswith("Table 5 of the paper: ")
    assert ablation.notes[0].endswith("clock and machine, on its drives")
    assert ablation.notes[0].startswith("paper: published in Table 5, ")
    assert "control random: as many Gaussians, drawn at random" in ablation.notes
    assert any(note.startswith("all views: the mean over the images of training and held") for note in ablation.notes)
    table = paper_table(found, [], DRIVESTUDIO, None)
    assert any(note.startswith("reconstruction: of the training views of the runs") for note in table.notes)
    assert not any(note.startswith(("all views:", "masks of")) for note in table.notes)
    fine = variants([record(make_summary("omnire", masks=dict.fromkeys(("human", "vehicle"), "fine")))])
    assert "masks of people and vehicles: fine" in paper_table(fine, [], DRIVESTUDIO, None).notes
    assert "masks of people and vehicles: fine" not in paper_table(fine, [], DRIVESTUDIO, "table4_novel").notes
    assert "failed runs are in no mean" not in ablation.notes
    assert f"protocol drivestudio: {', '.join(DRIVESTUDIO.metrics)}" in ablation.notes[2]
    whole = variants([record(make_summary("omnire", psnr=None, training_psnr=30.0, split="none"))])
    of_any = paper_table(whole, [], DRIVESTUDIO, None)
    assert not any(note.startswith("reconstruction: of the training") for note in of_any.notes)
    assert of_any.title == "All arms, in the layout of the paper's Table 1"
    failure = FailedRun(label="m", seed=2, command="", error="e", trace="")
    alone = paper_table([], [(Path("x"), failure)], DRIVESTUDIO, None)
    assert [len(row) for row in alone.rows] == [len(alone.header)]
    assert alone.rows[0][0].runs == ("x",)


def test_fid_stands_in_table_4_or_says_why_not(tmp_path):
    """The mean of both sides, for each of the rows; of how many images stands in the note, and what another lacks."""
    for name, distances in (("a", {1.0: 40.0, -1.0: 44.0}), ("b", {2.0: 61.5, -2.0: 61.5})):
        write_beside(tmp_path / name, distances)
    few = NOVEL.read(tmp_path / "b")
    NOVEL.write(tmp_path / "b", replace(few, real_views=3))
    NOVEL.write(tmp_path / "c", replace(few, shifts=(), absent="no weights: get them", missing={"fid": "no weights"}))
    labels = {"a": "omnire", "b": "omnire+paper", "c": "omnire+masks"}
    found = variants([RunRecord(tmp_path / name, make_summary(label)) for name, label in labels.items()])
    grid = paper_table(found, [], DRIVESTUDIO, "table4_novel")
    rows = rows_of(grid)
    beside = [rows["omnire"][f"beside the path {meters} m FID"].text for meters in (1, 2)]
    assert beside == ["42.00", "-"]
    assert rows["omnire"]["beside the path 2 m FID, paper"].text == "61.56"
    assert rows["omnire+paper"]["beside the path 2 m FID"].text == "61.50"
    (said,) = [note for note in grid.notes if note.startswith("FID: ")]
    assert ", of 3 to 6 recorded images a run and as many renders a side; the fewer" in said
    assert "FID n/a in some runs: no weights" in grid.notes
    alone = paper_table([one for one in found if one.sparsify == "masks"], [], DRIVESTUDIO, "table4_novel")
    assert [note for note in alone.notes if note.startswith("FID")] == ["FID n/a in some runs: no weights"]


def test_words_of_a_rows_options_choose_its_arm():
    """Rows of one method and sparsification differ in what a variant's name says."""
    table = TABLES["table3_pruning"]
    named = [row for row in table.rows if row.options]
    assert named
    for row in table.rows:
        name = " ".join((row.method or "", *row.options))
        summary = make_summary("x")
        variant = Variant(name, "x", row.method or "", row.sparsify, (), (record(summary),))
        grid = paper_table([variant], [], DRIVESTUDIO, "table3_pruning")
        assert grid.rows[[one.name for one in table.rows].index(row.name)][0].text == name


def test_frames_of_a_busy_machine_carry_the_mark_where_they_stand():
    runs = [
        make_summary("omnire", milliseconds=8.0),
        disturbed(make_summary("omnire+mine", milliseconds=16.0), "frames"),
    ]
    grid = paper_table(variants([record(one) for one in runs]), [], DRIVESTUDIO, None)
    assert {name: row["FPS"].text for name, row in rows_of(grid).items()} == {
        "omnire": "125.0",
        "omnire+mine": "62.5 §",
    }
    assert grid.notes[-1].endswith("compared with no other: frames of omnire+mine")


def test_frames_that_were_timed_alone_are_said(tmp_path):
    """Their machine is the one that timed them; a bundle names no folder of it."""
    command = "sparsestreet evaluate run=/home/me/a only=speed"
    alone = Evaluation(command, replace(MACHINE, cores=64), CLEAN, "cuda: x", 2)
    runs = [make_summary("omnire"), replace(make_summary("omnire", 1), timed=alone)]
    found = variants([record(one) for one in runs])
    assert [variant.name for variant in found] == ["omnire (cpu: test)", "omnire (cpu: test, measured on cuda: x)"]
    grid = paper_table(found, [], DRIVESTUDIO, None)
    assert "FPS: 1 of 2 runs timed alone, one after the other (evaluate DIR only=speed)" in grid.notes
    assert not any("alone" in note for note in paper_table(found, [], DRIVESTUDIO, "table5_ablation").notes)
    (section,) = sections([record(one) for one in runs])
    assert any("ms/frame are not comparable" in note and "64 cores" in note for note in section.notes)
    _lay(RunRecord(tmp_path / "run", runs[1]), tmp_path / "laid")
    assert there(SUMMARY.read(tmp_path / "laid").timed).command == "sparsestreet evaluate run=a only=speed"


def test_columns_of_the_paper_without_a_number_are_left_out():
    """Of a method and data that the paper has not, nothing is published; of one that it has, every column is."""
    own = paper_table(variants([record(make_summary("mine"))]), [], DRIVESTUDIO, None)
    assert not any(heading.endswith("paper") for _, heading in own.header)
    assert len(own.header) == 2 + 14
    assert not any("paper" in note for note in own.notes)
    both = paper_table(variants([record(make_summary("mine")), record(make_summary("pvg"))]), [], DRIVESTUDIO, None)
    assert sum(heading.endswith("paper") for _, heading in both.header) == 14
