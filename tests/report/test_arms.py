"""Which runs are averaged, and what they are compared with."""

from dataclasses import replace

import pytest

from sparsestreet.records.run import CodeVersion
from sparsestreet.report.arms import arms, incomplete, plain_of, why_apart
from sparsestreet.report.tradeoffs import paired
from tests.evaluation.frames import make_summary
from tests.report.sweep_folder import record, street_runs


def psnr(run):
    return run.mean("psnr_full")


def test_controls_of_other_counts_are_one_arm():
    found = {arm.name: arm for arm in arms([record(run, name) for name, run in street_runs().items()])}
    assert list(found) == ["streetgs", "streetgs+removal", "streetgs+random"]
    control = found["streetgs+random"]
    assert control.title == "control: streetgs+random"
    assert len(control.records) == 3
    assert control.mean(psnr) == pytest.approx(24.0)
    assert plain_of(control, found.values()) is found["streetgs"]
    assert plain_of(found["streetgs"], found.values()) is found["streetgs"]


def test_a_sparsification_says_itself_that_it_is_a_control():
    """In its configuration; records from before that are known by their names."""
    runs = [
        make_summary("streetgs", config={"sparsify.name": "none"}),
        make_summary("streetgs+size", config={"sparsify.control": "as many Gaussians, the smallest"}),
        make_summary("streetgs+opacity"),
    ]
    found = {arm.name: arm.control for arm in arms([record(run) for run in runs])}
    known = {"streetgs+opacity": "as many Gaussians, the most opaque"}
    assert found == {"streetgs": None, "streetgs+size": "as many Gaussians, the smallest"} | known


def test_each_scene_counts_once():
    runs = [
        make_summary("plain", 0, 20.0, scene="a"),
        make_summary("plain", 1, 22.0, scene="a"),
        make_summary("plain", 0, 30.0, scene="b"),
    ]
    (arm,) = arms([record(run) for run in runs])
    assert arm.mean(psnr) == 25.5


def test_several_runs_of_one_seed_are_their_mean():
    (arm,) = arms([record(make_summary("plain", 0, psnr)) for psnr in (20.0, 23.0)])
    assert list(arm.units(psnr).values()) == [21.5]


def test_two_parts_of_one_log_are_two_scenes():
    """Each part is paired with itself: 20 with 19 and 30 with 28."""
    parts = [{"data.log.first_frame": first, "data.log.last_frame": first + 9} for first in (0, 10)]
    runs = {"plain": (20.0, 30.0), "plain+removal": (19.0, 28.0)}
    plain, removal = arms(
        [
            record(make_summary(label, 0, psnr, config=part))
            for label, values in runs.items()
            for part, psnr in zip(parts, values, strict=True)
        ]
    )
    assert sorted(plain.units(psnr).values()) == [20.0, 30.0]
    difference = paired(removal, plain, psnr)
    assert (difference.mean, difference.n) == (-1.5, 2)


@pytest.mark.parametrize(
    ("other", "said"),
    [
        ({"device": "cuda: other"}, "runs differ in devices (cpu: test, cpu: test, measured on cuda: other)"),
        ({"threads": 1}, "runs differ in numbers of threads (1 thread, measured with 2, 2 threads)"),
        ({"source": CodeVersion("fedcba9876543210", False)}, "runs differ in commits (012345678, fedcba987)"),
        ({"config": {"schedule.max_steps": 70}}, "plain: runs of one label that differ are rows of their own"),
        (
            {"config": {"data.log.lidar": False}},
            "runs differ in options of the log (data.log.lidar=false, data.log.lidar=null)",
        ),
        ({"split": "every 4th frame"}, "runs differ in splits (every 10th frame from 0, every 4th frame)"),
    ],
)
def test_runs_that_differ_are_never_averaged(other, said):
    found = arms([record(make_summary("plain", 0, 20.0)), record(make_summary("plain", 1, 30.0, **other))])
    assert [len(arm.records) for arm in found] == [1, 1]
    assert len({arm.name for arm in found}) == 2
    assert any(note.startswith(said) for note in why_apart(found))


def test_options_of_the_log_name_arms_in_few_words():
    """Parts of a log are scenes of their own, and where it lies makes no difference."""
    read = {"data.log.lidar": True, "data.log.width": 480, "data.log.root": "/a", "data.log.first_frame": 0}
    other = read | {"data.log.width": 960, "data.log.root": "/b", "data.log.first_frame": 30}
    runs = [make_summary("plain", config=config) for config in (read, other, other | {"data.log.lidar": False})]
    names = {arm.name for arm in arms([record(run) for run in runs])}
    assert names == {
        "plain (data.log.lidar=true, data.log.width=480)",
        "plain (data.log.lidar=true, data.log.width=960)",
        "plain (data.log.lidar=false, data.log.width=960)",
    }


def test_no_comparison_between_places():
    runs = [make_summary("plain", 0), make_summary("plain+removal", 0, threads=1)]
    found = arms([record(run) for run in runs])
    assert [plain_of(arm, found) is None for arm in found] == [False, True]


def test_one_place_has_nothing_to_say():
    assert why_apart(arms([record(make_summary("plain", seed)) for seed in (0, 1)])) == []
    run = make_summary("plain")
    dirty = replace(run, run=replace(run.run, source=CodeVersion("0123456789abcdef", True)))
    assert why_apart(arms([record(dirty)])) == ["made by code with uncommitted changes: plain"]


def test_runs_on_all_views_stand_apart():
    """DriveStudio's two trainings: reconstruction is of the one without held-out views."""
    held = make_summary("plain", 0, 20.0, training_psnr=25.0)
    whole = make_summary("plain", 0, None, training_psnr=28.0, split="none")
    (arm,) = arms([record(held), record(whole)])
    assert list(arm.units(psnr).values()) == [20.0]
    assert list(arm.units(psnr, whole=True).values()) == [28.0]


def test_data_that_differ_under_one_name_stand_apart():
    runs = [make_summary("plain", seed) for seed in (0, 1)]
    for run, data_hash in zip(runs, ("aaaaaaaa", "bbbbbbbb"), strict=True):
        object.__setattr__(run.run, "data_hash", data_hash)
    found = arms([record(run) for run in runs])
    assert [arm.name for arm in found] == ["plain (data aaaaaa)", "plain (data bbbbbb)"]
    assert why_apart(found)[0].startswith("runs differ in data of one name (data aaaaaa, data bbbbbb)")


def test_an_arm_that_lacks_seeds_is_marked_everywhere():
    """Of three seeds the masks have one; other places and arms with all seeds say nothing."""
    runs = [make_summary("plain", seed) for seed in (0, 1, 2)] + [make_summary("plain+masks", 1)]
    found = arms([record(run) for run in (*runs, make_summary("plain+masks", 5, threads=1))])
    assert [(arm.label, arm.title.removeprefix(arm.name)) for arm in found] == [
        ("plain", ""),
        ("plain+masks", ""),
        ("plain+masks", " (1 of 3 runs ‡)"),
    ]
    (note,) = incomplete(found)
    assert note.endswith("both arms have. plain+masks (2 threads) lacks street seed 0, street seed 2")
    assert incomplete(arms([record(run) for run in runs[:3]])) == []
