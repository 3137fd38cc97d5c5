"""Which runs are repeats, and what the others are called."""

import dataclasses
from dataclasses import replace

import pytest

from sparsestreet.records.run import CodeVersion
from sparsestreet.report.sections import sections
from sparsestreet.report.tradeoffs import paired
from sparsestreet.report.variants import incomplete, masks_note, plain_of, repeats, variants, why_apart
from tests.evaluation.frames import make_summary
from tests.report.sweep_folder import record, street_runs


def names(found):
    return [(variant.name, len(variant.runs)) for variant in found]


def with_option(value, seed=0, label="streetgs+removal", key="schedule.removal_db", **run):
    return make_summary(label, seed, config={key: value}, **run)


def test_runs_that_differ_in_one_option_are_named_by_it():
    found = repeats([with_option(0.1), with_option(0.2), with_option(0.1, seed=1), make_summary("streetgs")])
    assert names(found) == [
        ("streetgs", 1),
        ("streetgs+removal schedule.removal_db=0.1", 2),
        ("streetgs+removal schedule.removal_db=0.2", 1),
    ]
    assert found[1].label == "streetgs+removal"


def test_only_the_configuration_makes_repeats():
    """Neither the seed nor the stored hash, which another version may have made by other rules."""
    runs = [with_option(0.1, seed) for seed in (0, 1, 2)]
    strange = dataclasses.replace(runs[2], run=dataclasses.replace(runs[2].run, config_hash="of another version"))
    assert names(repeats([*runs[:2], strange])) == [("streetgs+removal", 3)]
    assert names(repeats([make_summary("a"), make_summary("b")])) == [("a", 1), ("b", 1)]


def test_a_variant_has_one_name_in_all_tables():
    here, there = with_option(0.1, scene="a"), with_option(0.2, scene="b")
    assert names(repeats([here], [here, there])) == [("streetgs+removal schedule.removal_db=0.1", 1)]


def test_a_data_sets_own_options_are_no_name_where_nodes_take_them_over():
    """Each data set has its classes; a report over two of them names neither."""
    one, two = ({"data.classes": [name], "node.rigid.classes": [name]} for name in ("Car", "vehicle.car"))
    here, there = make_summary("m", config=one, scene="a"), make_summary("m", config=two, scene="b")
    assert names(repeats([here], [here, there])) == [("m", 1)]


def test_drives_of_several_lengths_are_one_row():
    """All frames or nine of ten, and drives of more frames: limits grow with them, and Table 1 had a row for each."""

    def drive(images, limit, **follows):
        config = {"training_views.images": images, "node.background.max_gaussians": limit}
        return make_summary("m", config=config, scene=f"drive {images}", follows=follows)

    least = {"node.background.max_gaussians": 130_000}
    short, long, longer = drive(100, 130_000), drive(450, 289_000, **least), drive(500, 321_100, **least)
    assert names(repeats([short, long, longer])) == [("m", 3)]
    given = drive(500, 321_100)  # as somebody wrote
    told = [("m node.background.max_gaussians=130000", 2), ("m node.background.max_gaussians=321100", 1)]
    assert names(repeats([short, long, given])) == told


def test_what_follows_from_a_given_option_is_left_to_the_notes():
    small = make_summary("m", config={"capacity": "small", "node.num_points": 20, "node.cap": 4})
    command = "sparsestreet train capacity=paper"
    paper = make_summary("m", config={"capacity": "paper", "node.num_points": 600, "node.cap": 20}, command=command)
    found = repeats([small, paper])
    assert names(found) == [("m capacity=paper", 1), ("m capacity=small", 1)]
    assert found[0].options == ("capacity=paper", "node.cap=20", "node.num_points=600")
    # A difference that no command gave, such as a default that has changed, is named where the given ones do not do.
    changed = make_summary("m", config={"capacity": "paper", "node.num_points": 600, "node.cap": 5}, command=command)
    assert [name for name, _ in names(repeats([small, paper, changed]))] == [
        "m capacity=paper, node.cap=20, node.num_points=600",
        "m capacity=paper, node.cap=5, node.num_points=600",
        "m capacity=small, node.cap=4, node.num_points=20",
    ]


def test_options_of_the_data_are_named_only_within_a_table():
    near, far = with_option(1.0, key="data.min_path_length"), with_option(3.0, key="data.min_path_length")
    assert names(repeats([near], [near, far])) == [("streetgs+removal", 1)]
    assert names(repeats([near, far])) == [
        ("streetgs+removal data.min_path_length=1", 1),
        ("streetgs+removal data.min_path_length=3", 1),
    ]


def test_options_that_choose_images_name_no_column():
    assert names(repeats([with_option(10, key="split.stride"), with_option(5, key="split.stride")])) == [
        ("streetgs+removal", 2)
    ]
    assert names(repeats([with_option(640, key="data.log.width"), with_option(320, key="data.log.width")])) == [
        ("streetgs+removal", 2)
    ]


def test_many_or_long_options_are_cut_and_stay_apart():
    first = make_summary("m", config={f"a.option{index}": 0 for index in range(5)})
    second = make_summary("m", config={f"a.option{index}": index + 1 for index in range(5)})
    found = repeats([first, second])
    for variant in found:
        assert variant.name.startswith("m a.option0=")
        assert ", and 2 more #" in variant.name
        assert len(variant.options) == 5
    assert found[0].name != found[1].name
    long = [make_summary("m", config={"classes": ["x" * 60, end]}) for end in "ab"]
    (one, two) = repeats(long)
    assert "..." in one.name
    assert one.name != two.name


def test_a_difference_without_words_is_told_by_the_hash():
    found = repeats([make_summary("m", config={"limit": None}), make_summary("m")])
    assert [variant.name[:3] for variant in found] == ["m #", "m #"]
    assert found[0].name != found[1].name


def test_counts_follow_from_another_run_in_controls_alone():
    """Elsewhere a count is an option as others are: two of them are never averaged."""
    key = "node.background.max_gaussians"
    assert len(repeats([with_option(value, label="m", key=key) for value in (500, 1000)])) == 2
    controls = [make_summary("m+random", config={key: value, "count_of": "../m"}) for value in (500, 1000)]
    assert len(repeats(controls)) == 1
    assert len(repeats([with_option(value, label="m+random", key=key) for value in (500, 1000)])) == 2


def rule(kind, seed, *more, keep=0.3, sparsify="paper_short"):
    """A job of a sweep whose commands choose the rule by its group, beside other words."""
    words = [f"sparsify={sparsify}", f"pruning@callback.pruning.rule={kind}", f"seed={seed}", *more]
    config = {"callback.pruning.rule._target_": f"mypaper.rules.of.mine.{kind.title()}Rule", "node.a.keep": keep}
    config |= {"callback.pruning.rule.gate": None} if kind == "volume" else {"callback.pruning.rule.nodes": ["a"]}
    command = f"sparsestreet train {' '.join(words)}"
    return make_summary(f"streetgs+{sparsify}", seed, config=config, command=command)


def test_arms_of_a_sweep_are_named_by_the_groups_that_it_varied():
    """2 x 2 with two seeds; the place of the group and what it brings into the configuration are in no name."""
    runs = [rule(kind, seed, sparsify=sparsify) for kind in ("importance", "volume") for sparsify in ("mine", "paper")
            for seed in (0, 1)]  # fmt: skip
    expected = [
        (f"streetgs+{sparsify} pruning={kind}", 2)
        for sparsify in ("mine", "paper")
        for kind in ("importance", "volume")
    ]
    assert names(repeats(runs)) == expected
    values = [
        rule(kind, 0, f"node.a.keep={keep}", "data=drivestudio", keep=keep)
        for kind in ("importance", "volume")
        for keep in (0.25, 0.5)
    ]
    assert [name for name, _ in names(repeats(values))] == [
        f"streetgs+paper_short pruning={kind}, node.a.keep={keep}"
        for kind in ("importance", "volume")
        for keep in (0.25, 0.5)
    ]


def test_a_group_that_does_not_tell_arms_apart_names_none():
    """Repeats by two words, or two configurations by one: the class of the rule is named, and its end is kept."""
    one, two = rule("volume", 0), rule("volume", 1, "pruning@other.place=x")
    assert names(repeats([one, two])) == [("streetgs+paper_short", 2)]
    plain = [
        dataclasses.replace(run, run=dataclasses.replace(run.run, command="sparsestreet train"))
        for run in (one, rule("importance", 0))
    ]
    assert sorted(variant.name for variant in repeats(plain))[0].startswith("streetgs+paper_short rule=ImportanceRule")
    both = [rule("volume", 0, "pruning@other.place=x"), rule("importance", 0, "pruning@other.place=y")]
    assert [name for name, _ in names(repeats(both))][1].startswith(
        "streetgs+paper_short pruning@callback.pruning.rule=volume, "
    )


PSNR = "held_out psnr_full"


def test_controls_of_other_counts_are_one_arm():
    found = {variant.name: variant for variant in variants([record(run, name) for name, run in street_runs().items()])}
    assert list(found) == ["streetgs", "streetgs+removal", "streetgs+random"]
    control = found["streetgs+random"]
    assert control.title == "control: streetgs+random"
    assert len(control.records) == 3
    assert control.mean(PSNR) == pytest.approx(24.0)
    assert plain_of(control, found.values()) is found["streetgs"]
    assert plain_of(found["streetgs"], found.values()) is found["streetgs"]


def test_a_sparsification_says_itself_that_it_is_a_control():
    """In its configuration; records from before that are known by their names."""
    runs = [
        make_summary("streetgs", config={"sparsify.name": "none"}),
        make_summary("streetgs+size", config={"sparsify.control": "as many Gaussians, the smallest"}),
        make_summary("streetgs+opacity"),
    ]
    found = {variant.name: variant.control for variant in variants([record(run) for run in runs])}
    known = {"streetgs+opacity": "as many Gaussians, the most opaque"}
    assert found == {"streetgs": None, "streetgs+size": "as many Gaussians, the smallest"} | known


def test_two_parts_of_one_log_are_two_scenes():
    """Each part is paired with itself: 20 with 19 and 30 with 28."""
    parts = [{"data.log.first_frame": first, "data.log.last_frame": first + 9} for first in (0, 10)]
    runs = {"plain": (20.0, 30.0), "plain+removal": (19.0, 28.0)}
    plain, removal = variants(
        [
            record(make_summary(label, 0, psnr, config=part))
            for label, values in runs.items()
            for part, psnr in zip(parts, values, strict=True)
        ]
    )
    assert sorted(plain.units(PSNR)) == [20.0, 30.0]
    difference = paired(removal, plain, PSNR)
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
    found = variants([record(make_summary("plain", 0, 20.0)), record(make_summary("plain", 1, 30.0, **other))])
    assert [len(variant.records) for variant in found] == [1, 1]
    assert len({variant.name for variant in found}) == 2
    assert any(note.startswith(said) for note in why_apart(found))


def test_options_of_the_log_name_arms_in_few_words():
    """Parts of a log are scenes of their own, and where it lies makes no difference."""
    read = {"data.log.lidar": True, "data.log.width": 480, "data.log.root": "/a", "data.log.first_frame": 0}
    other = read | {"data.log.width": 960, "data.log.root": "/b", "data.log.first_frame": 30}
    runs = [make_summary("plain", config=config) for config in (read, other, other | {"data.log.lidar": False})]
    names = {variant.name for variant in variants([record(run) for run in runs])}
    assert names == {
        "plain (data.log.lidar=true, data.log.width=480)",
        "plain (data.log.lidar=true, data.log.width=960)",
        "plain (data.log.lidar=false, data.log.width=960)",
    }


def test_no_comparison_between_places():
    runs = [make_summary("plain", 0), make_summary("plain+removal", 0, threads=1)]
    found = variants([record(run) for run in runs])
    assert [plain_of(variant, found) is None for variant in found] == [False, True]


def test_one_place_has_nothing_to_say():
    assert why_apart(variants([record(make_summary("plain", seed)) for seed in (0, 1)])) == []
    run = make_summary("plain")
    dirty = replace(run, run=replace(run.run, source=CodeVersion("0123456789abcdef", True)))
    assert why_apart(variants([record(dirty)])) == ["made by code with uncommitted changes: plain"]


def test_runs_on_all_views_stand_apart():
    """DriveStudio's two trainings: reconstruction is of the one without held-out views."""
    held = make_summary("plain", 0, 20.0, training_psnr=25.0)
    whole = make_summary("plain", 0, None, training_psnr=28.0, split="none")
    (variant,) = variants([record(held), record(whole)])
    assert variant.units(PSNR).tolist() == [20.0]
    assert variant.units("training psnr_full", whole=True).tolist() == [28.0]


def test_each_scene_and_each_seed_counts_once():
    runs = [("a", 0, 20.0), ("a", 0, 23.0), ("a", 1, 22.5), ("b", 0, 30.0)]
    (variant,) = variants([record(make_summary("plain", seed, psnr, scene=scene)) for scene, seed, psnr in runs])
    assert sorted(variant.units(PSNR)) == [21.5, 22.5, 30.0]
    assert variant.mean(PSNR) == 26.0


def test_data_that_differ_under_one_name_stand_apart():
    runs = [make_summary("plain", seed) for seed in (0, 1)]
    for run, data_hash in zip(runs, ("aaaaaaaa", "bbbbbbbb"), strict=True):
        object.__setattr__(run.run, "data_hash", data_hash)
    found = variants([record(run) for run in runs])
    assert [variant.name for variant in found] == ["plain (data aaaaaa)", "plain (data bbbbbb)"]
    assert why_apart(found)[0].startswith("runs differ in data of one name (data aaaaaa, data bbbbbb)")


def test_runs_with_masks_of_several_sources_are_no_repeats():
    """Nor is one whose people and vehicles are masked by two sources, nor an older record, which does not tell."""
    sources = ({"human": "fine", "vehicle": "fine"}, {"human": "coarse", "vehicle": "coarse"},
               {"human": "given", "vehicle": "shipped"}, {})  # fmt: skip
    runs = [make_summary("plain", seed, masks={"sky": "none", **one} if one else {})
            for seed, one in enumerate(sources)]  # fmt: skip
    words = ["coarse", "fine", "people given, vehicles shipped", "unknown"]
    found = variants([record(run) for run in runs])
    assert [variant.name for variant in found] == [f"plain (masks={word})" for word in words]
    options = ", ".join(f"masks={word}" for word in words)
    assert why_apart(found)[0] == f"runs differ in options of the log ({options}): shown apart, never averaged"
    assert masks_note(runs) == [f"masks of people and vehicles: {' and '.join(words)}: never averaged"]
    assert masks_note(runs[:1]) == ["masks of people and vehicles: fine"]
    assert masks_note(runs[3:]) == []
    titles = [section.title for section in sections([record(run) for run in runs])]
    assert sorted(title.partition("): ")[2] for title in titles) == [f"masks={word}" for word in words]


def test_an_arm_that_lacks_seeds_is_marked_everywhere():
    """Of three seeds the masks have one; other places and variants with all seeds say nothing."""
    runs = [make_summary("plain", seed) for seed in (0, 1, 2)] + [make_summary("plain+masks", 1)]
    found = variants([record(run) for run in (*runs, make_summary("plain+masks", 5, threads=1))])
    assert [(variant.label, variant.title.removeprefix(variant.name)) for variant in found] == [
        ("plain", ""),
        ("plain+masks", ""),
        ("plain+masks", " (1 of 3 runs ‡)"),
    ]
    (note,) = incomplete(found)
    assert note.endswith("both arms have. plain+masks (2 threads) lacks street seed 0, street seed 2")
    assert incomplete(variants([record(run) for run in runs[:3]])) == []
