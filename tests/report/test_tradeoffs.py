"""Differences and best variants against numbers worked out by hand."""

from dataclasses import replace

import pytest
from scipy import stats

from sparsestreet.metrics.definitions import DEFINITIONS, DRIVESTUDIO, STRICT
from sparsestreet.records.summary import HELD_OUT, MetricSummary
from sparsestreet.report.collect import run_frame
from sparsestreet.report.tables import spread
from sparsestreet.report.tradeoffs import differences, matched_budget, matched_quality, measures, paired, summary_line
from sparsestreet.report.variants import variants
from tests.evaluation.frames import disturbed, make_summary, with_ranges
from tests.report.sweep_folder import record, street_runs


@pytest.fixture(scope="module")
def found():
    return variants([record(run, name) for name, run in street_runs().items()])


def by_heading(grid, row):
    return {heading: cell for (_, heading), cell in zip(grid.header, row, strict=True)}


def test_seeds_of_one_scene_are_the_pairs_else_scenes_are():
    runs = {
        ("plain", "a", 0): 20.0, ("plain", "a", 1): 21.0, ("plain", "b", 0): 30.0,
        ("plain+removal", "a", 0): 19.0, ("plain+removal", "a", 1): 19.0, ("plain+removal", "b", 0): 29.0,
    }  # fmt: skip
    records = [record(make_summary(label, seed, value, scene=scene)) for (label, scene, seed), value in runs.items()]
    plain, removal = variants(records)
    both = paired(removal, plain, "held_out psnr_full")
    assert (both.mean, both.n) == (pytest.approx(-1.25), 2)  # scene a: -1.5, scene b: -1
    plain, removal = variants([one for one in records if one.summary.run.scene == "a"])
    alone = paired(removal, plain, "held_out psnr_full")
    assert (alone.mean, alone.n) == (pytest.approx(-1.5), 2)


def test_bold_where_the_interval_excludes_zero(found):
    grid = differences(found, DRIVESTUDIO)
    removal, control = (by_heading(grid, row) for row in grid.rows)
    assert removal["arm - plain"].text == "streetgs+removal - streetgs"
    assert control["arm - plain"].text == "control: streetgs+random - streetgs"
    assert (removal["n"].text, removal["PSNR full"].text) == ("3", "-0.30 [-0.55, -0.05]")
    assert removal["PSNR full"].bold
    assert not removal["PSNR vehicle"].bold  # all alike: 0 [0, 0]
    assert removal["ms/frame, %"].text.startswith("-75.0")


def test_a_share_of_a_capped_run_is_marked_as_one():
    runs = [make_summary("plain", 0, 25.0, caps={"road": 900}), make_summary("plain+removal", 0, 24.9)]
    found = variants([record(run) for run in runs])
    for make, named in (
        (differences, "plain+removal - plain †"),
        (matched_quality, "plain †, at most 0.1 dB"),
        (matched_budget, "plain †, at most 25 % of its Gaussians"),
    ):
        grid = make(found, DRIVESTUDIO)
        assert grid.rows[0][0].text == named
        assert "a share of its Gaussians is a share of that limit" in grid.notes[-1]
        free = make(variants([record(make_summary(run.run.label, 0, 25.0)) for run in runs]), DRIVESTUDIO)
        assert not any("†" in text for text in (free.rows[0][0].text, *free.notes))


def test_an_arm_without_its_plain_run_is_named():
    grid = differences(variants([record(make_summary("plain+removal"))]), DRIVESTUDIO)
    assert not grid.rows
    assert "to compare with: plain+removal" in grid.notes[-1]


def test_a_control_is_never_chosen_but_named():
    """The capped method is smaller and better than what it controls: the tables choose the variant and say so."""
    runs = {"plain": (25.0, 1000), "plain+removal": (24.8, 400), "plain+capped": (24.9, 300)}
    made = variants([record(make_summary(name, 0, psnr, {"background": n})) for name, (psnr, n) in runs.items()])
    quality, budget = matched_quality(made, DRIVESTUDIO), matched_budget(made, DRIVESTUDIO)
    control = "control: plain+capped, -0.10 dB at 30 % of the Gaussians, is"
    assert [row[1].text for row in quality.rows] == ["plain", "plain+removal", "plain+removal"]
    assert [note for note in quality.notes if note.startswith("plain, at most 0.3 dB")] == [
        f"plain, at most 0.3 dB: {control} smaller"
    ]
    assert [row[1].text for row in budget.rows] == ["none of this sweep", "plain+removal", "plain+removal"]
    assert f"plain, at most 50 % of its Gaussians: {control} better" in budget.notes


def test_a_chosen_arm_has_the_numbers_of_the_seeds_it_shares():
    """Seed 1, which the plain variant lacks, has 900 Gaussians and is in no number of the row."""
    runs = [("plain", 0, 25.0, 1000), ("plain+removal", 0, 24.9, 300), ("plain+removal", 1, 20.0, 900)]
    made = variants([record(make_summary(name, seed, psnr, {"background": n})) for name, seed, psnr, n in runs])
    chosen = by_heading(matched_quality(made, DRIVESTUDIO), matched_quality(made, DRIVESTUDIO).rows[-1])
    assert (chosen["arm"].text, chosen["share, %"].text, chosen["Gaussians"].text) == ("plain+removal", "30", "300")


def chosen_of(grid, *runs):
    """The arm for each limit, of runs with these PSNR and Gaussians."""
    made = [make_summary(label, 0, psnr, {"a": rows}) for label, psnr, rows in runs]
    return [row[1].text for row in grid(variants([record(run) for run in made]), DRIVESTUDIO).rows]


def test_limits_choose_the_smallest_and_the_best():
    none = "none of this sweep"
    # A gain is no loss: smaller and better by 0.6 dB is within every limit.
    assert chosen_of(matched_quality, ("m", 25.0, 1000), ("m+removal", 25.6, 300)) == ["m+removal"] * 3
    # Below half of the Gaussians the one that loses less, not the smaller one.
    runs = ("m", 25.0, 1000), ("m+small", 23.0, 100), ("m+larger", 24.5, 400)
    assert chosen_of(matched_budget, *runs) == ["m+small", "m+larger", "m+larger"]
    # A limit itself is allowed: half of the Gaussians, and half a dB less, which is exact in floats.
    runs = ("m", 25.0, 8), ("m+removal", 24.5, 4)
    assert chosen_of(matched_quality, *runs) == ["m", "m", "m+removal"]
    assert chosen_of(matched_budget, *runs) == [none, "m+removal", "m+removal"]


def apart(label, quality, gaussians, milliseconds, seconds):
    """A run whose held-out metrics are one apart, in the order of DEFINITIONS, and others on training views."""
    metrics = {name: quality + place for place, name in enumerate(DEFINITIONS)}
    summary = make_summary(label, 0, gaussians={"a": gaussians}, milliseconds=milliseconds, training_seconds=seconds,
                           training_psnr=1.0)  # fmt: skip
    held_out = {name: MetricSummary(value, None, 1, 0) for name, value in metrics.items()}
    summary = with_ranges(summary, quality / 100, quality / 50)
    return replace(summary, quality=summary.quality | {HELD_OUT: held_out})


@pytest.mark.parametrize("protocol", [DRIVESTUDIO, STRICT])
def test_every_column_has_a_difference_of_its_own(protocol):
    """Ours is better by 0.5 in every metric, has a quarter of the Gaussians, half of the frame and 90 % of training."""
    plain, ours = apart("m", 20.0, 1000, 40.0, 200.0), apart("m+removal", 20.5, 250, 20.0, 180.0)
    grid = differences(variants([record(plain, "p"), record(ours, "r")]), protocol)
    networks = {DRIVESTUDIO: ("LPIPS alex",), STRICT: ("LPIPS alex", "LPIPS vgg")}[protocol]
    (row,) = (by_heading(grid, row) for row in grid.rows)
    assert not any(cell.bold for cell in row.values())  # one pair never is
    assert {heading: cell.text for heading, cell in row.items()} == {
        "arm - plain": "m+removal - m",
        "n": "1",
        **dict.fromkeys(("PSNR full", "PSNR human", "PSNR vehicle"), "+0.50"),
        **dict.fromkeys(("SSIM full", *networks), "+0.5000"),
        **{"median range error, m": "+0.005", "within 0.2 m, %": "+1.0"},
        **{"Gaussians, %": "-75.0", "MB, %": "-75.0", "ms/frame, %": "-50.0", "train s, %": "-10.0"},
    }
    assert {cell.runs for cell in row.values()} == {("r", "p")}
    # Which metric a column holds: the plain run's own number.
    (numbers,) = run_frame([record(plain)]).to_dict("records")
    values = {one.heading: numbers[one.column] for one in measures(protocol)}
    wanted = (protocol.psnr, protocol.human[0], protocol.vehicle[0], protocol.ssim, *protocol.lpips)
    assert [values[name] for name in list(values)[: len(wanted)]] == [plain.mean(name) for name in wanted]
    assert [values[name] for name in ("Gaussians", "MB", "ms/frame", "train s")] == [1000.0, 0.236, 40.0, 200.0]


def test_a_chosen_arm_is_shown_with_all_its_numbers():
    """A third of 1,200 Gaussians for 0.25 dB; MB: 59 float32 a Gaussian."""
    plain = make_summary("m", 0, 25.0, {"a": 1200}, milliseconds=40.0, training_seconds=200.0)
    ours = make_summary("m+removal", 0, 24.75, {"a": 400}, milliseconds=25.0, training_seconds=150.0)
    found = variants([record(plain, "p"), record(ours, "r")])
    for grid, allowed in ((matched_quality, "at most 0.3 dB"), (matched_budget, "at most 50 % of its Gaussians")):
        chosen = grid(found, DRIVESTUDIO)
        assert [heading for _, heading in chosen.header[1:]] == [
            *("arm", "PSNR full, dB", "share, %", "Gaussians", "MB", "ms/frame", "train minutes"),
        ]
        (row,) = (row for row in chosen.rows if row[0].text == f"m, {allowed}")
        assert [cell.text for cell in row[1:]] == ["m+removal", "-0.25", "33", "400", "0.09", "25.00", "2.50"]
        assert {cell.runs for cell in row[1:]} == {("r",)}


def test_an_interval_of_fewer_pairs_than_the_row_says_how_many():
    """Two seeds, of which one lacks vehicles."""
    runs = [make_summary(label, seed, vehicle_psnr=None if seed else 20.0, training_seconds=100.0 + seed)
            for label in ("m", "m+removal") for seed in (0, 1)]  # fmt: skip
    (row,) = differences(variants([record(run) for run in runs]), DRIVESTUDIO).rows
    texts = [cell.text for cell in row]
    assert texts[1] == "2"
    assert "+0.00 (n=1)" in texts


def test_who_has_no_plain_value_has_no_relative_difference():
    runs = [make_summary("m", training_seconds=None), make_summary("m+removal", training_seconds=100.0)]
    grid = differences(variants([record(run) for run in runs]), DRIVESTUDIO)
    assert by_heading(grid, grid.rows[0])["train s, %"].text == "-"
    zero = [make_summary("m", training_seconds=0.0), make_summary("m+removal", training_seconds=100.0)]
    grid = differences(variants([record(run) for run in zero]), DRIVESTUDIO)
    assert by_heading(grid, grid.rows[0])["train s, %"].text == "-"


def test_a_difference_of_times_is_of_quiet_pairs_alone():
    """Of the plain frames one seed was disturbed, of the small variant's training every seed."""
    runs = [
        disturbed(make_summary("plain", 0, milliseconds=900.0), "frames"),
        make_summary("plain", 1, milliseconds=20.0),
        *(
            disturbed(make_summary("plain+removal", seed, 25.0, {"a": 9}, milliseconds=5.0), "training")
            for seed in (0, 1)
        ),
    ]  # fmt: skip
    found = variants([record(run) for run in runs])
    grid = differences(found, DRIVESTUDIO)
    row = by_heading(grid, grid.rows[0])
    assert (row["ms/frame, %"].text, row["train s, %"].text) == ("-75.0 (n=1)", "- §")
    assert grid.notes[-1].endswith("frames of plain; training of plain+removal")
    best = matched_quality(found, DRIVESTUDIO)
    assert by_heading(best, best.rows[0])["train minutes"].text.endswith(" §")


def runs(label: str, psnr: list[float], gaussians: int, **changes):
    return [
        make_summary(label, seed, value, {"background": gaussians}, scene=f"street {seed}", **changes)
        for seed, value in enumerate(psnr)
    ]


def said(*made):
    return summary_line(
        variants([record(run, f"{run.run.label}{run.run.seed}") for some in made for run in some]), DRIVESTUDIO
    )


PLAIN = runs("m", [25.0, 26.0, 27.0], 1000)
GOOD = runs("m+removal", [24.9, 25.8, 26.7], 400)
"""-0.1, -0.2, -0.3: t(2) = 4.303, sd 0.1, so 0.248 to each side."""
SMALLEST = runs("m+masks", [24.5, 25.5, 26.5], 100)
"""-0.5 each."""


def test_the_smallest_arm_within_the_loss():
    larger = runs("m+paper", [25.0, 26.0, 27.0], 500)
    assert said(PLAIN, GOOD, SMALLEST, larger) == (
        "m: of 3 arms the smallest within 0.3 dB is m+removal, with 40 % of the Gaussians, -0.20 dB [-0.45, +0.05] of "
        "held-out PSNR, n = 3.",
        "Intervals that reach beyond 0.3 dB: m+removal. More scenes or seeds may change this.",
    )


def test_none_is_within_the_loss():
    assert said(PLAIN, SMALLEST) == (
        "m: none is smaller within 0.3 dB; m+masks has 10 % of the Gaussians, -0.50 dB [-0.50, -0.50] of held-out "
        "PSNR, n = 3.",
    )


def test_two_pairs_say_nothing():
    assert said(PLAIN[:2], GOOD[:2]) == ()
    assert said(PLAIN, GOOD[1:]) == ()  # of three seeds the variant has two
    assert said(PLAIN) == ()
    assert said(GOOD) == ()


def test_a_larger_arm_and_a_control_are_not_chosen():
    larger, control = runs("m+masks", [25.0, 26.0, 27.0], 1100), runs("m+random", [25.0, 26.0, 27.0], 50)
    (sentence,) = said(PLAIN, larger, control)
    assert sentence.startswith("m: none is smaller within 0.3 dB; m+masks has 110 % of the Gaussians")


def test_a_limit_of_the_plain_run_is_named():
    found = said(runs("m", [25.0, 26.0, 27.0], 1000, caps={"background": 1000}), GOOD)
    assert found[-1] == "A limit ended the growth of m: shares of it are shares of that limit."


def test_each_method_has_its_sentence():
    others = [run for name in ("a", "b") for run in runs(name, [25.0, 26.0, 27.0], 1000)]
    smaller = [run for name in ("a", "b") for run in runs(f"{name}+removal", [25.0, 26.0, 27.0], 500)]
    found = said(others, smaller)
    for label, sentence in zip("ab", found, strict=True):
        assert sentence.startswith(f"{label}: the smallest within 0.3 dB is {label}+removal, with 50 %")


def test_the_interval_is_students():
    values = [-0.2, -0.3, -0.4]
    found = spread(values)
    expected = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    assert (found.mean, found.n) == (pytest.approx(-0.3), 3)
    assert found.interval == pytest.approx((expected.low, expected.high))
    assert found.proven


def test_what_proves_nothing():
    assert not spread([-1.0]).proven  # one value, however large
    assert spread([-1.0]).interval is None
    assert not spread([-1.0, 0.9]).proven
    assert spread([]) is None
