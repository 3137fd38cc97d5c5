"""Which runs are repeats, and what the others are called."""

import dataclasses

from sparsestreet.report import variants
from tests.evaluation.frames import make_summary


def names(found):
    return [(variant.name, len(variant.runs)) for variant in found]


def with_option(value, seed=0, label="streetgs+removal", key="schedule.removal_db", **run):
    return make_summary(label, seed, config={key: value}, **run)


def test_runs_that_differ_in_one_option_are_named_by_it():
    found = variants([with_option(0.1), with_option(0.2), with_option(0.1, seed=1), make_summary("streetgs")])
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
    assert names(variants([*runs[:2], strange])) == [("streetgs+removal", 3)]
    assert names(variants([make_summary("a"), make_summary("b")])) == [("a", 1), ("b", 1)]


def test_a_variant_has_one_name_in_all_tables():
    here, there = with_option(0.1, scene="a"), with_option(0.2, scene="b")
    assert names(variants([here], [here, there])) == [("streetgs+removal schedule.removal_db=0.1", 1)]


def test_a_data_sets_own_options_are_no_name_where_nodes_take_them_over():
    """Each data set has its classes; a report over two of them names neither."""
    one, two = ({"data.classes": [name], "node.rigid.classes": [name]} for name in ("Car", "vehicle.car"))
    here, there = make_summary("m", config=one, scene="a"), make_summary("m", config=two, scene="b")
    assert names(variants([here], [here, there])) == [("m", 1)]


def test_what_follows_from_a_given_option_is_left_to_the_notes():
    small = make_summary("m", config={"capacity": "small", "node.num_points": 20, "node.cap": 4})
    command = "sparsestreet train capacity=paper"
    paper = make_summary("m", config={"capacity": "paper", "node.num_points": 600, "node.cap": 20}, command=command)
    found = variants([small, paper])
    assert names(found) == [("m capacity=paper", 1), ("m capacity=small", 1)]
    assert found[0].options == ("capacity=paper", "node.cap=20", "node.num_points=600")
    # A difference that no command gave, such as a default that has changed, is named where the given ones do not do.
    changed = make_summary("m", config={"capacity": "paper", "node.num_points": 600, "node.cap": 5}, command=command)
    assert [name for name, _ in names(variants([small, paper, changed]))] == [
        "m capacity=paper, node.cap=20, node.num_points=600",
        "m capacity=paper, node.cap=5, node.num_points=600",
        "m capacity=small, node.cap=4, node.num_points=20",
    ]


def test_options_of_the_data_are_named_only_within_a_table():
    near, far = with_option(1.0, key="data.min_path_length"), with_option(3.0, key="data.min_path_length")
    assert names(variants([near], [near, far])) == [("streetgs+removal", 1)]
    assert names(variants([near, far])) == [
        ("streetgs+removal data.min_path_length=1", 1),
        ("streetgs+removal data.min_path_length=3", 1),
    ]


def test_options_that_choose_images_name_no_column():
    assert names(variants([with_option(10, key="split.stride"), with_option(5, key="split.stride")])) == [
        ("streetgs+removal", 2)
    ]
    assert names(variants([with_option(640, key="data.log.width"), with_option(320, key="data.log.width")])) == [
        ("streetgs+removal", 2)
    ]


def test_many_or_long_options_are_cut_and_stay_apart():
    first = make_summary("m", config={f"a.option{index}": 0 for index in range(5)})
    second = make_summary("m", config={f"a.option{index}": index + 1 for index in range(5)})
    found = variants([first, second])
    for variant in found:
        assert variant.name.startswith("m a.option0=")
        assert ", and 2 more #" in variant.name
        assert len(variant.options) == 5
    assert found[0].name != found[1].name
    long = [make_summary("m", config={"classes": ["x" * 60, end]}) for end in "ab"]
    (one, two) = variants(long)
    assert "..." in one.name
    assert one.name != two.name


def test_a_difference_without_words_is_told_by_the_hash():
    found = variants([make_summary("m", config={"limit": None}), make_summary("m")])
    assert [variant.name[:3] for variant in found] == ["m #", "m #"]
    assert found[0].name != found[1].name


def test_counts_follow_from_another_run_in_controls_alone():
    """Elsewhere a count is an option as others are: two of them are never averaged."""
    key = "node.background.max_gaussians"
    assert len(variants([with_option(value, label="m", key=key) for value in (500, 1000)])) == 2
    controls = [make_summary("m+random", config={key: value, "count_of": "../m"}) for value in (500, 1000)]
    assert len(variants(controls)) == 1
    assert len(variants([with_option(value, label="m+random", key=key) for value in (500, 1000)])) == 2


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
    assert names(variants(runs)) == expected
    values = [
        rule(kind, 0, f"node.a.keep={keep}", "data=drivestudio", keep=keep)
        for kind in ("importance", "volume")
        for keep in (0.25, 0.5)
    ]
    assert [name for name, _ in names(variants(values))] == [
        f"streetgs+paper_short pruning={kind}, node.a.keep={keep}"
        for kind in ("importance", "volume")
        for keep in (0.25, 0.5)
    ]


def test_a_group_that_does_not_tell_arms_apart_names_none():
    """Repeats by two words, or two configurations by one: the class of the rule is named, and its end is kept."""
    one, two = rule("volume", 0), rule("volume", 1, "pruning@other.place=x")
    assert names(variants([one, two])) == [("streetgs+paper_short", 2)]
    plain = [
        dataclasses.replace(run, run=dataclasses.replace(run.run, command="sparsestreet train"))
        for run in (one, rule("importance", 0))
    ]
    assert sorted(variant.name for variant in variants(plain))[0].startswith("streetgs+paper_short rule=ImportanceRule")
    both = [rule("volume", 0, "pruning@other.place=x"), rule("importance", 0, "pruning@other.place=y")]
    assert [name for name, _ in names(variants(both))][1].startswith(
        "streetgs+paper_short pruning@callback.pruning.rule=volume, "
    )
