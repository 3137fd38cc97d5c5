"""What each variant costs, in absolute numbers."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from sparsestreet.metrics.definitions import DRIVESTUDIO, STRICT
from sparsestreet.records.costs import EffectGain, update_costs
from sparsestreet.records.curves import HELD_OUT_CURVE, HeldOutLook
from sparsestreet.records.run import EffectDecision, RunDescription
from sparsestreet.records.summary import PRESETS, PresetRecord, RenderedAs
from sparsestreet.report.collect import RunRecord, collect
from sparsestreet.report.costs import (
    TRUTH,
    QualityCurve,
    beside_the_path,
    curves_of,
    rendered_otherwise,
    time_to_quality,
    what_effects_cost,
    what_variants_cost,
)
from sparsestreet.report.paper import paper_table
from sparsestreet.report.variants import variants
from tests.evaluation.frames import NOISE, make_summary
from tests.records.novel import write_beside
from tests.report.sweep_folder import record, write_sweep


def test_without_cost_records_the_summary_is_left(tmp_path):
    grid = what_variants_cost(variants(collect([write_sweep(tmp_path, curves=False)])))
    assert [heading for _, heading in grid.header] == ["arm", "n", "Gaussians", "MB", "ms/frame", "train s"]


def test_every_column_has_a_number_of_its_own(tmp_path):
    """Means of two runs; what is neither forward, backward nor the optimizer is in no column."""
    runs = []
    for seed in (0, 1):
        folder = tmp_path / f"run{seed}"
        gaussians = {"background": 1000, "rigid": 500 + 1000 * seed}
        numbers: dict[str, Any] = {"milliseconds": 7.0 + seed, "training_seconds": 50.0 + 4 * seed}
        runs.append(RunRecord(folder, make_summary("m", seed, gaussians=gaussians, **numbers)))
        parts = {"scene": 1.0, "splat": 2.0, "lens": 4.0, "losses": 8.0, "regularizers": 16.0, "loop": 500.0}
        parts |= {"backward": 32.0, "optimizer": 64.0, "density": 250.0, "sky": 125.0}  # no effect of this scene
        update_costs(
            folder,
            wall_seconds=300.0 + 100 * seed,
            phases={"train": 297.5 + 100 * seed, "prune": 2.5},
            step_ms={name: value + seed for name, value in parts.items()},
            effects={"lens": 0.5},
            peak_host_mb=800.0 + 50 * seed,
            peak_device_mb=6000.0 + 500 * seed,
        )
    grid = what_variants_cost(variants(runs))
    (row,) = grid.rows
    assert grid.header == (
        *(("", "arm"), ("", "n"), ("", "Gaussians"), ("", "MB"), ("", "ms/frame"), ("", "train s")),
        *(("seconds", "pruning"), ("seconds", "whole command")),
        *(("ms of a step", part) for part in ("forward", "backward", "optimizer")),
        *(("peak MB", "host"), ("peak MB", "GPU")),
    )
    # 1,500 and 2,500 Gaussians of 59 float32; forward: 31 ms of five parts, and 31 + 5.
    assert [cell.text for cell in row] == [
        *("m", "2", "2,000", "0.47", "7.50", "52.0", "2.5", "350", "33.5", "32.5", "64.5", "825", "6250"),
    ]
    assert {cell.runs for cell in row} == {("run0", "run1")}
    assert len(grid.notes) == 1
    update_costs(tmp_path / "plain", phases={"train": 9.0})  # a run without pruning has spent no seconds on it
    grid = what_variants_cost(variants([RunRecord(tmp_path / "plain", make_summary("m"))]))
    assert dict(zip(grid.header, (cell.text for cell in grid.rows[0]), strict=True))["seconds", "pruning"] == "0.0"


def test_a_machine_that_was_not_quiet_is_named():
    calm, loud = make_summary("m"), make_summary("m", 1)
    latency = replace(loud.latency, noise=replace(loud.latency.noise, quiet=False))
    runs = [record(calm), record(replace(loud, latency=latency))]
    grid = what_variants_cost(variants(runs))
    assert grid.notes[-1].startswith("§ times of a machine that was not quiet, compared with no other: frames of m")
    assert [cell.text for cell in grid.rows[0]][-2:] == ["40.00 §", "100.0"]


LENS = EffectDecision(
    name="lens", on=True, source="measured", reason="r", value=2.5, unit="px", threshold=0.5, noise=0.1,
    numbers=250_000, ms=0.75, gain=None,
)  # fmt: skip


def planned(seed: int, *effects: EffectDecision):
    summary = make_summary("m", seed)
    run: RunDescription = replace(summary.run, effects=effects)
    return replace(summary, run=run)


def test_predictions_stand_beside_measurements(tmp_path):
    sky = replace(LENS, name="sky", on=False, source="forced", value=None, threshold=None, numbers=0, gain=1.0)
    runs = []
    for seed in (0, 1):
        runs.append(RunRecord(tmp_path / str(seed), planned(seed, LENS, sky)))
        gains = {"lens": EffectGain(2.0 + seed, 1.0 if seed else None, None, 4)}
        update_costs(tmp_path / str(seed), effects={"lens": 0.5 + seed}, gains=gains)
    grid = what_effects_cost(variants(runs))
    assert [[cell.text for cell in row] for row in grid.rows] == [
        ["m", "lens", "on", "measured", "2.5 px", "0.5", "0.75", "1.00", "1", "-", "+2.50", "+1.00", "-"],
        ["m", "sky", "off", "forced", "-", "-", "0.75", "-", "0", "+1.00", "-", "-", "-"],
    ]


def test_repeats_may_decide_otherwise_and_older_records_say_nothing(tmp_path):
    runs = [RunRecord(tmp_path / str(seed), planned(seed, replace(LENS, on=bool(seed)))) for seed in (0, 1)]
    (row,) = what_effects_cost(variants(runs)).rows
    assert row[2].text == "on in 1 of 2"
    assert what_effects_cost(variants([RunRecord(tmp_path, make_summary("m"))])).rows == ()


def test_runs_of_one_scene_and_seed_are_their_mean(tmp_path):
    """Runs that were trained on all views are in no mean with them."""
    runs = []
    for name, seconds, psnr, split in (("a", 10.0, 20.0, "some"), ("b", 12.0, 21.0, "some"), ("c", 99.0, 9.0, "none")):
        HELD_OUT_CURVE.write(tmp_path / name, [HeldOutLook(seconds, 9, psnr, None, None)])
        runs.append(record(make_summary("plain", split=split, training_psnr=20.0), str(tmp_path / name)))
    (variant,) = variants(runs)
    assert list(curves_of(variant).values()) == [QualityCurve((11.0,), (20.5,))]


def test_seconds_to_the_plain_runs_quality(tmp_path):
    """Curves end at -3, -0.8, -0.3 and 0 dB; removal ends 0.2, 0.3 and 0.4 dB lower, the control 2 dB."""
    grid = time_to_quality(variants(collect([write_sweep(tmp_path)])))
    rows = {row[0].text: [cell.text for cell in row[1:]] for row in grid.rows}
    assert rows["streetgs"] == ["20.0 s", "30.0 s", "40.0 s"]
    # Within 1 dB: at -0.8 - 0.2 (20 s), else 30 s. Within 0.5: -0.3 - 0.2 at 30 s, else 40 s.
    assert rows["streetgs+removal"] == ["30.0 s", "40.0 s", "not reached"]
    assert rows["control: streetgs+random"] == ["not reached"] * 3


def test_the_last_look_of_the_plain_run_counts_not_its_best(tmp_path):
    """It ends 1 dB below its best: 0.5 dB below its end are 18.5 dB, which it has at 10 s."""
    looks = enumerate((18.6, 20.0, 19.0), start=1)
    HELD_OUT_CURVE.write(tmp_path, [HeldOutLook(10.0 * step, step, psnr, None, None) for step, psnr in looks])
    grid = time_to_quality(variants([record(make_summary("plain"), str(tmp_path))]))
    assert [cell.text for cell in grid.rows[0][1:]] == ["10.0 s", "10.0 s", "20.0 s"]


@pytest.mark.parametrize(
    "table",
    [time_to_quality, beside_the_path, lambda found: rendered_otherwise(found, DRIVESTUDIO)],
    ids=["curves", "beside the path", "presets"],
)
def test_none_recorded_no_table(tmp_path, table):
    assert table(variants(collect([write_sweep(tmp_path, curves=False)]))) is None


@pytest.mark.parametrize("seeds", [(0, 1), (0, 0)])
def test_a_scene_is_the_mean_of_its_runs(tmp_path, seeds):
    """Of other seeds and of one and the same."""
    runs = []
    for seed, distance in zip(seeds, (41.25, 43.25), strict=True):
        folder = tmp_path / str(distance)
        write_beside(folder, {1.0: distance, -1.0: distance})
        runs.append(record(make_summary("plain", seed), str(folder)))
    assert [row[1].text for row in beside_the_path(variants(runs)).rows] == ["42.25"]


@pytest.mark.parametrize(("splits", "distance"), [(("some", "none"), "41"), (("none", "none"), "42")])
def test_runs_on_all_views_are_in_no_mean_with_the_others(tmp_path, splits, distance):
    """Their real images are those that they trained on."""
    runs = []
    for split, value in zip(splits, (41.0, 43.0), strict=True):
        folder = tmp_path / str(value)
        write_beside(folder, {1.0: value, -1.0: value})
        runs.append(record(make_summary("plain", split=split, training_psnr=20.0), str(folder)))
    assert [row[1].text for row in beside_the_path(variants(runs)).rows] == [distance]


def test_the_truth_comes_before_distances_and_both_sides_count_alike(tmp_path):
    """Of three scenes two have a record; the other arms have none."""
    sweep = write_sweep(tmp_path)
    for seed in (0, 1):
        distances = {1.0: 40.25 + 10 * seed, -1.0: 42.25 + 10 * seed, 2.0: 50.0}
        write_beside(sweep / f"streetgs_seed{seed}", distances, name="a_distance", psnr=20.4 + seed)
    grid = beside_the_path(variants(collect([sweep])))
    names = [TRUTH["psnr_full"]] * 2 + ["a_distance"] * 2
    assert grid.header == (("", "arm"), *zip(names, ["1 m", "2 m"] * 2, strict=True))
    assert [cell.text for cell in grid.rows[0][1:]] == ["20.90", "20.90", "46.25", "50"]
    assert {cell.text for row in grid.rows[1:] for cell in row[1:]} == {"-"}


def test_table_4_holds_the_inception_distance_alone(tmp_path):
    summary = make_summary("omnire", scene="023")
    object.__setattr__(summary.run, "method", "omnire")
    write_beside(tmp_path, {1.0: 40.0, -1.0: 44.0})
    (variant,) = variants([record(summary, str(tmp_path))])
    grid = paper_table([variant], [], DRIVESTUDIO, "table4_novel")
    assert [cell.text for cell in grid.rows[0]] == ["omnire", "1", "42.00", "43.62", "-", "61.56", "-", "75.14"]
    write_beside(tmp_path, {1.0: 40.0, -1.0: 44.0}, name="frechet_alexnet")
    again = variants([record(summary, str(tmp_path))])
    assert paper_table(again, [], DRIVESTUDIO, "table4_novel").rows[0][2].text == "-"


def write_rendered(run: Path, loss: float) -> None:
    """As it was trained (30 dB, 20 ms) and faster, for so many dB."""
    rendered = tuple(
        RenderedAs(
            preset=name,
            trained=not lost,
            quality={"psnr_full": 30.0 - lost},
            psnr_to_exact=50.0 - lost,
            frame_ms=milliseconds,
            repeats=12,
        )
        for name, lost, milliseconds in (("default", 0.0, 20.0), ("fast", loss, 12.0))
    )
    made = PresetRecord(command="c", device="cpu: x", threads=1, views=3, noise=NOISE, rendered=rendered)
    PRESETS.write(run, made)


def test_arms_of_one_label_are_told_apart_by_how_they_were_trained(tmp_path):
    sweep = write_sweep(tmp_path, failed=False)
    for seed in range(3):
        write_rendered(sweep / f"streetgs_seed{seed}", 0.1)
    (plain, *_) = variants(collect([sweep]))
    other = replace(plain, name="streetgs render.settings.alpha_min=0.1")
    grid = rendered_otherwise([plain, other], DRIVESTUDIO)
    assert [row[0].text for row in grid.rows] == ["streetgs, default"] * 4


@pytest.mark.parametrize(
    ("splits", "expected"),
    [
        (("some", "some"), ["1", "29.80", "-0.20"]),  # losses of 0.1 and 0.3 dB, a pair alone
        (("some", "none"), ["1", "29.90", "-0.10"]),
        (("none", "none"), ["1", "29.80", "-0.20"]),
    ],
)
def test_renders_of_one_scene_and_seed_are_their_mean(tmp_path, splits, expected):
    """Those trained on all views count where no other has a record."""
    runs = []
    for name, loss, split in zip("ab", (0.1, 0.3), splits, strict=True):
        write_rendered(tmp_path / name, loss)
        runs.append(record(make_summary("plain", split=split, training_psnr=20.0), str(tmp_path / name)))
    default, fast = rendered_otherwise(variants(runs), DRIVESTUDIO).rows
    assert [cell.text for cell in fast[2:5]] == expected
    assert default[1].text == "default, as trained"


@pytest.mark.parametrize("protocol", [DRIVESTUDIO, STRICT])
def test_every_column_is_its_own(tmp_path, protocol):
    """Of two scenes: full, people and vehicles lose 0.1, 0.2 and 0.3 dB in the first, 0.2 dB more in the second."""
    names = (protocol.psnr, protocol.human[0], protocol.vehicle[0])
    runs = []
    for scene in (0, 1):
        ways = [
            RenderedAs(
                preset=preset,
                trained=preset == "fine",
                quality={name: 30.0 + place - lost * (0.1 * (place + 1) + 0.2 * scene)
                         for place, name in enumerate(names)} | {"psnr_sky": 1.0},
                psnr_to_exact=60.0 + scene - 10 * lost,
                frame_ms=20.0 + scene - 5 * lost,
                repeats=12,
            )
            for preset, lost in (("fast", 1.0), ("fine", 0.0))
        ]  # fmt: skip
        made = PresetRecord(command="c", device="d", threads=1, views=3, noise=NOISE, rendered=tuple(ways))
        folder = tmp_path / str(scene)
        PRESETS.write(folder, made)
        runs.append(record(make_summary("m", scene=f"s{scene}"), str(folder)))
    grid = rendered_otherwise(variants(runs), protocol)
    assert grid.header == (
        *(("", "trained"), ("", "rendered"), ("", "n")),
        *((f"PSNR {region}", what) for region in ("full", "human", "vehicle") for what in ("dB", "- as trained")),
        *(("", "dB to exact"), ("", "ms/frame")),
    )
    fast, fine = ([cell.text for cell in row] for row in grid.rows)
    # Two differences 0.2 apart: half width 12.706 x 0.1414 / sqrt(2) = 1.27.
    assert fast == [
        *("m", "fast", "2", "29.80", "-0.20 [-1.47, +1.07]", "30.70", "-0.30 [-1.57, +0.97]"),
        *("31.60", "-0.40 [-1.67, +0.87]", "50.5", "15.50"),
    ]
    assert fine == ["m", "fine, as trained", "2", "30.00", "-", "31.00", "-", "32.00", "-", "60.5", "20.50"]
    assert {cell.runs for row in grid.rows for cell in row if cell.text != "-"} == {("0", "1")}


def test_a_machine_that_was_not_quiet_while_it_rendered_is_named(tmp_path):
    write_rendered(tmp_path, 0.1)
    PRESETS.write(tmp_path, replace(PRESETS.read(tmp_path), noise=replace(NOISE, quiet=False)))
    grid = rendered_otherwise(variants([record(make_summary("m"), str(tmp_path))]), DRIVESTUDIO)
    assert grid.notes[-1] == "§ times of a machine that was not quiet, compared with no other: m"
    assert [row[-1].text for row in grid.rows] == ["20.00 §", "12.00 §"]
