"""Tables from hand-made records, against numbers worked out by hand."""

import dataclasses
import io
from pathlib import Path

import pytest
from rich.console import Console
from rich.table import Table

from sparsestreet.metrics.definitions import DEFINITIONS, DRIVESTUDIO, STRICT
from sparsestreet.records.run import CodeVersion
from sparsestreet.records.summary import HELD_OUT, Evaluation, MetricSummary
from sparsestreet.report.collect import RunRecord
from sparsestreet.report.sections import section_tables, sections, sections_markdown
from sparsestreet.report.tables import Spread
from tests.evaluation.frames import CLEAN, MACHINE, disturbed, make_summary, with_ranges
from tests.report.sweep_folder import record
from tests.typed import as_a


def records(*summaries):
    return [RunRecord(Path(f"run{index}"), summary) for index, summary in enumerate(summaries)]


PLAIN_AND_OURS = records(
    make_summary("plain", 0, psnr=25.0, gaussians={"background": 1000, "rigid": 200}, training_seconds=100.0),
    make_summary("plain", 1, psnr=27.0, gaussians={"background": 1400, "rigid": 200}, training_seconds=120.0),
    make_summary("ours", 0, psnr=24.9, gaussians={"background": 300, "rigid": 100}, milliseconds=20.0),
    make_summary("ours", 1, psnr=26.6, gaussians={"background": 340, "rigid": 60}, milliseconds=30.0),
)


def test_ranges_have_columns_differences_and_a_note():
    heard = [with_ranges(make_summary(label, 0), *numbers) for label, *numbers in (("a", 0.1, 0.5), ("b", 0.15, 0.25))]
    (section,) = sections(records(*heard, make_summary("c", 0)), "a")
    rows = by_label(section)
    means = {label: cells(row, section) for label, row in rows.items()}
    assert (means["a"]["median range error, m"].mean, means["a"]["within 0.2 m, %"].mean) == (0.1, 50.0)
    assert means["b against a"]["median range error, m"].mean == pytest.approx(0.05)
    assert means["b against a"]["within 0.2 m, %"].mean == -25.0
    assert means["c"]["median range error, m"] is None
    assert any(note.startswith("median range error: along the rays of held-out sweeps") for note in section.notes)


def cells(row, section):
    return dict(zip([quantity.heading for quantity in section.quantities], row.cells, strict=True))


def by_label(section):
    return {row.label: row for row in section.rows}


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
    assert cells(ours, section)["ms/frame"].mean == 25.0
    assert "vehicle SSIM" not in found  # no run has it

    assert "median range error, m" not in found
    assert not any("range error" in note for note in section.notes)

    found = cells(difference, section)
    assert found["PSNR"].mean == pytest.approx((-0.1 - 0.4) / 2)  # paired by seed
    assert found["PSNR"].sd == pytest.approx(0.3 / 2**0.5)
    assert found["Gaussians"].mean == pytest.approx((400 / 1200 + 400 / 1600) / 2 * 100)  # per cent kept
    assert found["ms/frame"].mean == pytest.approx((50 + 75) / 2)
    assert [row.runs for row in section.rows] == ["n=2 (seed 0,1)"] * 3


def test_only_shared_seeds_are_paired_and_runs_of_one_seed_count_as_their_mean():
    twice = [make_summary("ours", 0, psnr=psnr) for psnr in (25.5, 26.5)]
    (section,) = sections(records(make_summary("plain", 0), *twice, make_summary("mask", 1)), "plain")
    rows = by_label(section)
    assert rows["ours"].runs == "n=2 (seed 0,0)"
    assert rows["ours against plain"].cells[0] == Spread(1.0, None, 1)
    assert (rows["mask against plain"].cells[0], rows["mask against plain"].runs) == (None, "no shared seed")


def test_a_difference_needs_a_number_to_be_a_share_of():
    (section,) = sections(
        records(make_summary("plain", gaussians={"a": 5, "b": 0}), make_summary("ours", gaussians={"a": 4, "b": 3})),
        "plain",
    )
    found = cells(section.rows[2], section)
    assert (found["a"].mean, found["b"]) == (80.0, None)


def test_other_scenes_splits_and_clips_get_tables_of_their_own():
    found = sections(
        records(
            make_summary(),
            make_summary(scene="kitti"),
            make_summary(split="every 5th frame from 0"),
            make_summary(config={"data.log.first_frame": 50}),
        ),
        "plain",
    )
    assert {section.title for section in found if not section.over_scenes} == {
        "kitti (64x48; held out: every 10th frame from 0)",
        "street (64x48; held out: every 10th frame from 0): data.log.first_frame=null",
        "street (64x48; held out: every 10th frame from 0): data.log.first_frame=50",
        "street (64x48; held out: every 5th frame from 0)",
    }


STREETS = (  # label, scene and seed, PSNR, Gaussians
    *(("plain", 0, 30.0, 100), ("plain", 1, 32.0, 200), ("plain", 2, 31.0, 300)),
    *(("ours", 0, 29.0, 50), ("ours", 1, 32.5, 50), ("ours", 2, 30.0, 150)),
)


def street(label, seed, psnr, gaussians, **run):
    return make_summary(label, seed, psnr=psnr, gaussians={"a": gaussians}, scene=f"320x192_seed{seed}", **run)


def test_runs_over_three_streets_have_a_mean_over_scenes():
    *scenes, mean = sections(records(*(street(*values) for values in STREETS)), "plain")
    assert [section.over_scenes for section in scenes] == [False] * 3
    assert mean.over_scenes
    assert mean.title == "mean over scenes (64x48; held out: every 10th frame from 0)"
    plain, ours, difference = mean.rows
    assert (plain.label, plain.runs, plain.cells[0]) == ("plain", "3 scenes, n=3", Spread(31.0, 1.0, 3))
    assert ours.cells[0].mean == pytest.approx(30.5)
    assert difference.cells[0].mean == pytest.approx((-1 + 0.5 - 1) / 3)  # paired by scene
    assert cells(difference, mean)["Gaussians"].mean == pytest.approx((50 + 25 + 50) / 3)  # mean of the shares
    assert difference.runs == "3 scenes, n=3"


def test_each_scene_counts_once():
    """Three runs of one scene weigh as much as the one of the other; pairs need scene and seed."""
    mean = sections(
        records(
            *(make_summary("plain", seed, psnr=20.0 + seed, scene="a") for seed in (0, 1, 2)),
            make_summary("plain", 1, psnr=31.0, scene="b"),
            *(make_summary("ours", seed, psnr=25.0, scene="a") for seed in (1, 2)),
            make_summary("ours", 1, psnr=30.0, scene="b"),
            make_summary("ours", 7, psnr=99.0, scene="b"),
        ),
        "plain",
    )[-1]
    plain, ours, difference = mean.rows
    assert (plain.runs, plain.cells[0]) == ("2 scenes, n=4", Spread(26.0, 50**0.5, 2))
    assert ours.cells[0].mean == (25.0 + (30.0 + 99.0) / 2) / 2
    assert (difference.runs, difference.cells[0].mean) == ("2 scenes, n=3", ((4 + 3) / 2 - 1.0) / 2)


def test_no_mean_over_scenes_of_one_scene_or_of_different_configurations():
    assert not any(section.over_scenes for section in sections(records(make_summary(seed=0), make_summary(seed=1))))
    options = {"schedule.removal_db": 0.1}, {"schedule.removal_db": 0.2}
    apart = [make_summary("m", config=config, scene=scene) for config, scene in zip(options, "ab", strict=True)]
    assert not any(section.over_scenes for section in sections(records(*apart)))
    logs = {"data.log.width": 640}, {"data.log.width": 320}
    apart = [make_summary("m", config=config, scene=scene) for config, scene in zip(logs, "ab", strict=True)]
    assert not any(section.over_scenes for section in sections(records(*apart)))


def test_a_mean_over_scenes_takes_clips_of_any_length_and_who_has_several():
    """One camera each is one camera still, which has no table of its own."""
    clips = [
        make_summary("m", config={"data.log.last_frame": last}, scene=scene) for last, scene in ((9, "a"), (7, "b"))
    ]
    found = sections(records(*clips, make_summary("other", scene="a")))
    assert not any(section.by_camera for section in found)
    assert found[-1].over_scenes
    assert [(row.label, row.runs) for row in found[-1].rows] == [("m", "2 scenes, n=2")]


def test_each_clip_of_a_log_counts_once_in_a_difference():
    """Differences of -1 and -3 dB in two clips of one log and -5 dB in another log: -3 dB of three."""
    clips = {("a", 0): -1.0, ("a", 10): -3.0, ("b", 0): -5.0}
    runs = [
        make_summary(label, psnr=25.0 + change * (label == "ours"), scene=scene, config={"data.log.first_frame": first})
        for (scene, first), change in clips.items()
        for label in ("plain", "ours")
    ]
    difference = sections(records(*runs), "plain")[-1].rows[-1]
    assert (difference.runs, difference.cells[0].mean) == ("3 scenes, n=3", pytest.approx(-3.0))


def test_runs_without_held_out_views_show_their_training_views():
    run = make_summary(psnr=None, training_psnr=33.0, split="none")
    (section,) = sections(records(run))
    assert section.title == "street (64x48; held out: none)"
    found = cells(section.rows[0], section)
    assert found["train-view PSNR"].mean == 33.0
    assert {"train-view SSIM", "train-view vehicle PSNR"} < set(found)
    assert "PSNR" not in found
    (section,) = sections(records(make_summary(training_psnr=33.0)))
    found = cells(section.rows[0], section)
    assert (found["PSNR"].mean, found["train-view PSNR"].mean) == (25.0, 33.0)
    assert "train-view SSIM" not in found


def rig(front, back, **summary):
    """A run with a front camera 1, of full, near and beyond PSNR, and one behind, 10, that has no lidar."""
    metrics: dict[str, float | None] = dict(
        zip(("psnr_full", "psnr_near_lidar", "psnr_beyond_lidar"), front, strict=True)
    )
    return make_summary(cameras={"1": metrics, "10": {"psnr_full": back, "psnr_near_lidar": None}}, **summary)


def test_several_cameras_get_a_table_of_their_own():
    found = sections(
        records(
            rig((25.0, 28.0, 22.0), 24.0, label="plain", seed=0),
            rig((27.0, 29.0, 24.0), 26.0, label="plain", seed=1),
            rig((24.0, 27.5, 20.0), 24.5, label="ours", seed=0),
        ),
        "plain",
    )
    whole, cameras = found
    assert [section.by_camera for section in found] == [False, True]
    assert cameras.title == f"PSNR by camera, {whole.title}"
    assert [row.label for row in cameras.rows] == [row.label for row in whole.rows]
    plain, ours, difference = (cells(row, cameras) for row in cameras.rows)
    assert list(plain) == ["camera 1", "camera 1 near", "camera 1 beyond", "camera 10"]
    assert (plain["camera 1"].mean, plain["camera 1 near"].mean, plain["camera 10"].mean) == (26.0, 28.5, 25.0)
    assert plain["camera 1 beyond"].sd == pytest.approx(2**0.5)
    assert ours["camera 1 beyond"] == Spread(20.0, None, 1)
    assert (difference["camera 1 beyond"].mean, difference["camera 10"].mean) == (-2.0, 0.5)
    assert cameras.notes == (
        "PSNR in dB of held-out views, the mean over the images of each camera; the rest as above",
    )


def test_cameras_have_means_over_scenes():
    found = sections(records(*(rig((psnr, 28.0, 22.0), 24.0, scene=name) for name, psnr in (("a", 24.0), ("b", 26.0)))))
    assert [(section.over_scenes, section.by_camera) for section in found[-2:]] == [(True, False), (True, True)]
    assert cells(found[-1].rows[0], found[-1])["camera 1"] == Spread(25.0, 2**0.5, 2)


BOTH = [make_summary("m", config={"x": value}, psnr=20.0 + value) for value in (1, 2)]


def test_the_baseline_may_be_the_name_of_a_column():
    (section,) = sections(records(*BOTH, make_summary("other")), "m x=2")
    assert [row.label for row in section.rows][:3] == ["m x=2", "m x=1", "other"]
    assert by_label(section)["m x=1 against m x=2"].cells[0].mean == -1.0
    with pytest.raises(ValueError, match=r"baseline 'm' has 2 configurations: choose one of \['m x=1', 'm x=2'\]"):
        sections(records(*BOTH), "m")
    with pytest.raises(ValueError, match=r"no run has the baseline 'none': choose one of \['m x=1', 'm x=2'\]"):
        sections(records(*BOTH), "none")


def test_a_label_is_a_baseline_in_tables_where_it_has_one_configuration():
    """Whatever it is called for the sake of other tables."""
    runs = [make_summary("m", config={"x": value}, scene=scene) for value, scene in ((1, "a"), (2, "b"))]
    found = sections(records(*runs, make_summary("other", scene="a")), "m")
    assert [row.label for row in found[0].rows] == ["m x=1", "other", "other against m x=1"]


def test_a_section_without_the_baseline_says_so():
    found = sections(records(make_summary(), make_summary("ours", scene="kitti")), "plain")
    assert "no run of the baseline plain here, so no differences" in found[0].notes
    assert [row.difference for row in found[0].rows] == [False]


def test_two_meanings_of_one_metric_do_not_meet_in_a_table():
    first, second = make_summary(), make_summary("ours")
    second.definitions["psnr_full"] = "something else"
    with pytest.raises(ValueError, match="psnr_full means different things in run0 and run1"):
        sections(records(first, second))


def test_a_time_of_a_busy_machine_is_marked_and_compared_with_no_other():
    """The plain training of seed 0 was disturbed, and all frames of ours. Left: 100 s of 400 s with seed 1."""
    found = records(
        disturbed(make_summary("plain", 0, training_seconds=900.0), "training"),
        make_summary("plain", 1, training_seconds=400.0),
        *(
            disturbed(make_summary("ours", seed, training_seconds=100.0, milliseconds=13.0), "frames")
            for seed in (0, 1)
        ),
    )
    (section,) = sections(found, "plain")
    lines = [line.split(" | ") for line in sections_markdown([section]).splitlines() if line.startswith("| ")]
    ms, seconds = (lines[0].index(heading) for heading in ("ms/frame", "train s |"))
    plain, ours, against = lines[2:]
    assert (plain[ms], plain[seconds]) == ("40.0 ± 0.0", "650 ± 354 § |")
    assert (ours[ms], ours[seconds]) == ("13.0 ± 0.0 §", "100 ± 0 |")
    assert (against[ms], against[seconds]) == ("- §", "25.0 % (n=1) |")
    said = "§ times of a machine that was not quiet, compared with no other: frames of ours; training of plain"
    assert said in section.notes
    (quiet,) = sections(PLAIN_AND_OURS, "plain")
    assert not any("§" in note for note in quiet.notes)


def text_of(found, baseline=None):
    return sections_markdown(sections(found, baseline))


def test_markdown_reads_as_written_by_hand():
    lines = text_of(PLAIN_AND_OURS, "plain").splitlines()
    assert lines[0] == "### street (64x48; held out: every 10th frame from 0)"
    header, rule, plain, ours, difference = (line.split(" | ") for line in lines[2:7])
    assert len(header) == len(rule) == len(plain) == len(ours) == len(difference)
    assert header[:3] == ["| method", "runs", "PSNR"]
    assert plain[:3] == ["| plain", "n=2 (seed 0,1)", "26.00 ± 1.41"]
    assert ours[:3] == ["| ours", "n=2 (seed 0,1)", "25.75 ± 1.20"]
    assert difference[2] == "-0.25 ± 0.21"
    assert difference[header.index("Gaussians")] == "29.2 ± 5.9 %"
    assert "**" not in text_of(PLAIN_AND_OURS, "plain")


def test_a_table_by_camera_has_rows_of_cameras():
    runs = [rig((25.0, 28.0, 22.0), 24.0, label=label) for label in ("ours", "plain")]
    text = text_of(records(*runs), "plain")
    table = text[text.index("### PSNR by camera") :].splitlines()[2:9]
    assert table[:4] == [
        "| method | plain | ours | ours against plain |",
        "| --- | ---: | ---: | ---: |",
        "| runs | n=1 (seed 0) | n=1 (seed 0) | n=1 (seed 0) |",
        "| camera 1 | 25.00 | 25.00 | +0.00 |",
    ]
    assert table[6] == "| camera 10 | 24.00 | 24.00 | +0.00 |"
    printed_text = printed(records(*runs), 80, "plain")
    assert "camera 1 beyond" in printed_text
    assert printed_text.count("runs ") == 2


def test_cells_of_fewer_runs_than_the_row_carry_their_number():
    alone = text_of(PLAIN_AND_OURS[:1], "plain")
    assert "| plain | n=1 (seed 0) | 25.00 |" in alone
    assert "n=1 has no spread" in alone
    assert "differences" not in alone
    assert "22.00 (n=1)" in text_of(records(make_summary(seed=0), make_summary(seed=1, vehicle_psnr=None)))
    assert "| - |" in text_of(records(make_summary(), make_summary("ours", vehicle_psnr=None)))


def test_counts_that_a_cap_held_down_are_marked_and_named():
    capped = make_summary("streetgs", caps={"background": 130_000, "rigid": 8000})
    text = text_of(records(capped, make_summary("streetgs", 1), make_summary("streetgs+paper")), "streetgs")
    plain, paper, difference = (line for line in text.splitlines() if line.startswith("| streetgs"))
    assert plain.count("†") == difference.count("†") == 3  # the total and two nodes, nothing else
    assert "1,200 ± 0 †" in plain
    assert "100.0 % †" in difference
    assert "†" not in paper
    said = "† streetgs: background reached its cap of 130,000 Gaussians, rigid reached its cap of 8,000 Gaussians"
    assert f"- {said}\n" in text
    (section,) = sections(records(make_summary("streetgs"), make_summary("a", caps={"rigid": 5})), "streetgs")
    assert [row.capped for row in section.rows] == [False, True, True]


def printed(found, width, baseline=None):
    console = Console(width=width)
    with console.capture() as capture:
        for part in section_tables(sections(found, baseline), width):
            console.print(part)
    return capture.get()


def test_a_few_methods_fit_a_terminal_of_80_characters():
    text = printed(PLAIN_AND_OURS, 80, "plain")
    for cell in ("26.00 ± 1.41", "25.75 ± 1.20", "-0.25 ± 0.21", "29.2 ± 5.9 %", "1,400 ± 283", "every 10th frame"):
        assert cell in text
    assert "…" not in text
    assert "mean ± sample sd over runs; n=1 has no spread and proves nothing below the noise" in text  # its whole width
    assert text.count("┏") == 1


SWEEP = records(*(make_summary("streetgs+removal", config={"schedule.removal_db": value}) for value in range(6)))


def test_many_variants_are_rows_where_there_is_room():
    title, found, notes = section_tables(sections(SWEEP), 200)
    table = as_a(Table, found)
    assert table.row_count == 6
    assert str(table.columns[0].header) == "method"
    assert "…" not in printed(SWEEP, 200)
    assert "held out" in str(title)
    assert "guards: none fired" in str(notes)


def test_many_variants_are_tables_below_each_other_where_there_is_none():
    text = printed(SWEEP, 80)
    assert text.count("┏") > 1
    assert all(f" schedule.removal_db={value} " in text for value in range(6))
    assert text.count("n=1 (seed 0) ") == 6
    assert "…" not in text
    assert text.count("held out:") == 1  # one title
    assert text.count("guards: none fired") == 1


def shown(summary, protocol):
    (section,) = sections(records(summary), protocol=protocol)
    return {heading: cell.mean for heading, cell in cells(section.rows[0], section).items() if cell is not None}


def test_a_protocol_chooses_the_columns():
    """Every metric has a value of its own."""
    values = {name: float(place) for place, name in enumerate(DEFINITIONS, start=1)}
    quality = {HELD_OUT: {name: MetricSummary(value, 0.0, 6, 0) for name, value in values.items()}}
    summary = dataclasses.replace(make_summary(), quality=quality)
    headings = ("vehicle PSNR", "vehicle SSIM", "human PSNR", "human SSIM")
    for protocol, lpips in ((DRIVESTUDIO, ("LPIPS alex",)), (STRICT, ("LPIPS alex", "LPIPS vgg"))):
        found = shown(summary, protocol)
        names = (*("PSNR", "SSIM"), *lpips, *headings)
        metrics = (protocol.psnr, protocol.ssim, *protocol.lpips, *protocol.vehicle, *protocol.human)
        assert {name: found[name] for name in names} == {
            name: values[metric] for name, metric in zip(names, metrics, strict=True)
        }
        assert found["near PSNR"] == values["psnr_near_lidar"]
    assert "LPIPS vgg" not in shown(summary, DRIVESTUDIO)


def test_brackets_of_a_label_are_no_markup():
    """A label comes from outside: ``[red]`` stands in the terminal as it is written, and colors nothing."""
    runs = [record(make_summary("[red]mine", scene="[/b]street")), record(make_summary("[bold]x", scene="[/b]street"))]
    out = io.StringIO()
    console = Console(file=out, width=200, force_terminal=True, color_system="standard")
    for part in section_tables(sections(runs), 200):
        console.print(part)
    text = out.getvalue()
    assert all(word in text for word in ("[red]mine", "[bold]x", "[/b]street"))
    assert "\x1b[31m" not in text


def notes(*summaries, baseline=None):
    return sections(records(*summaries), baseline)[-1].notes


def note(start, *summaries, baseline=None):
    (found,) = [one for one in notes(*summaries, baseline=baseline) if one.startswith(start)]
    return found


OTHER = dataclasses.replace(MACHINE, cores=64)
NEWER = CodeVersion("fedcba9876543210", False)
DIRTY = CodeVersion("0123456789abcdef", True)


def test_like_runs_get_no_warning():
    said = "\n".join(notes(make_summary(), make_summary("ours")))
    for word in ("not comparable", "different", "uncommitted", "stopped", "reached", "times", "has no run"):
        assert word not in said
    assert "trained on cpu: test, 2 threads, 2 cores, torch 2.13.0" in said
    assert "guards: none fired" in said


@pytest.mark.parametrize(
    "other", [{"device": "cuda: big"}, {"evaluated": Evaluation("e", OTHER, CLEAN, "cpu: test", 2)}]
)
def test_clocks_of_different_places_are_called_incomparable(other):
    said = note("ms/frame are not comparable, measured on: ", make_summary(), make_summary("ours", **other))
    assert said.count(";") == 1


def test_trainings_at_different_places_are_called_incomparable():
    for other in (make_summary("ours", threads=1), make_summary("ours", machine=OTHER)):
        said = note("train s are not comparable, trained on: ", make_summary(), other)
        assert "cpu: test, 2 threads, 2 cores" in said
        assert said.count(";") == 1
    assert "cpu: test, 1 thread, 2 cores" in note("trained on", make_summary(threads=1))
    two = dataclasses.replace(make_summary(), run=dataclasses.replace(make_summary().run, device="cuda: big"))
    assert "cuda: big" in note("train s are not comparable", make_summary(), two)


def test_commits_and_uncommitted_changes_are_named():
    assert note("runs were trained by", make_summary(), make_summary("ours", source=NEWER)) == (
        "runs were trained by different commits: 012345678, fedcba987"
    )
    assert "some runs were trained by code with uncommitted changes" in notes(make_summary(source=DIRTY))
    measured = make_summary(evaluated=Evaluation("e", MACHINE, DIRTY, "cpu: test", 2))
    assert "some runs were measured by code with uncommitted changes" in notes(measured)
    measured = make_summary(evaluated=Evaluation("e", MACHINE, NEWER, "cpu: test", 2))
    assert note("runs were measured by different", make_summary(), measured)


def test_the_same_run_twice_is_no_repeat():
    twice = [make_summary("m", 0), make_summary("m", 0), make_summary("m", 1)]
    assert "m: seed 0 2 times; equal runs of one seed are no independent repeats" in notes(*twice)
    apart = [make_summary("m", 0, scene="a"), make_summary("m", 0, scene="b")]
    assert not [one for one in notes(*apart) if "times" in one]


def test_a_run_that_was_stopped_is_named():
    assert "plain (seed 3) stopped at step 23 of 60" in notes(make_summary(seed=3, steps=23))


def test_options_that_a_name_has_no_room_for():
    runs = [make_summary("m", config={f"a{index}": index * value for index in range(1, 6)}) for value in (1, 10)]
    said = [one for one in notes(*runs) if one.startswith("m a1=")]
    assert len(said) == 2
    assert "a1=1, a2=2, a3=3, a4=4, a5=5" in "\n".join(said)


def test_guards_that_fired_are_named():
    calm = make_summary()
    loud = make_summary("ours", 3, alarms={"vanished": 1234, "color_held": 1})
    assert note("guards", calm, loud) == "guards: ours (seed 3) vanished 1,234, color_held 1"
    assert note("guards", loud, make_summary("plain", 1, alarms={"overflowed": 7})) == (
        "guards: ours (seed 3) vanished 1,234, color_held 1; plain (seed 1) overflowed 7"
    )


def test_a_mean_over_scenes_says_which():
    said = notes(*(street(*values) for values in STREETS[:5]), baseline="plain")
    assert "scenes: 320x192_seed0, 320x192_seed1, 320x192_seed2" in said
    assert "ours has no run of 320x192_seed2: compare differences, not means" in said
    assert said[0] == "each scene counts once, with the mean of its runs; ± is the sample sd over scenes"
    assert said[-1] == "differences are to plain, paired by scene and seed; per cent is what remains of it"


def test_seeds_that_a_variant_lacks_are_named():
    runs = [make_summary("plain", 0), make_summary("plain", 1), make_summary("ours", 1)]
    assert "ours has no run of street with seed 0: compare differences, not means" in notes(*runs)
    lacking = [street(name, seed, 20.0, 100) for name in ("plain", "ours") for seed in (0, 1)]
    assert not [said for said in notes(*lacking) if "with seed" in said]


def test_near_and_beyond_are_explained_where_there_is_lidar():
    blind = make_summary()
    assert not [said for said in notes(blind) if said.startswith("near")]
    seen = {HELD_OUT: blind.quality[HELD_OUT] | {"psnr_beyond_lidar": MetricSummary(20.0, None, 1, 0)}}
    said = note("near:", blind, dataclasses.replace(make_summary("ours"), quality=seen))
    assert said.startswith("near: psnr_near_lidar, of pixels with a lidar return within 4 % of the longer image side")


def test_which_views_the_metrics_are_of():
    assert note("of held-out views, protocol drivestudio: PSNR psnr_full", make_summary(training_psnr=30.0))
    assert note("of training views (none is held out), protocol", make_summary(psnr=None, training_psnr=30.0))


def test_a_metric_that_could_not_be_measured_is_explained_once():
    reason = "no weights (a.ckpt): install them"
    said = notes(make_summary(absent={"lpips_alex": reason, "lpips_vgg": "?"}), make_summary("b"))
    assert [one for one in said if "n/a" in one] == [f"lpips_alex n/a in some runs: {reason}"]
