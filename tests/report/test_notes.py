"""What the notes below a table say, and that they are silent where there is nothing to say."""

import dataclasses

import pytest

from sparsestreet.records.run import CodeVersion
from sparsestreet.records.summary import HELD_OUT, Evaluation, MetricSummary
from sparsestreet.report.sections import sections
from tests.evaluation.frames import CLEAN, MACHINE, make_summary
from tests.report.test_sections import STREETS, records, street


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


def test_caps_are_named_and_mark_what_they_hold_down():
    capped = make_summary("streetgs", caps={"background": 130_000, "rigid": 8000})
    free = make_summary("streetgs+paper")
    expected = "† streetgs: background reached its cap of 130,000 Gaussians, rigid reached its cap of 8,000 Gaussians"
    assert expected in notes(capped, free, make_summary("streetgs", 1))
    (section,) = sections(records(capped, free), "streetgs")
    assert [row.capped for row in section.rows] == [True, False, True]
    (section,) = sections(records(make_summary("streetgs"), make_summary("a", caps={"rigid": 5})), "streetgs")
    assert [row.capped for row in section.rows] == [False, True, True]


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
