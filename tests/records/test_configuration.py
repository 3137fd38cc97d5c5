"""Identity of a configuration, and the options in which configurations differ."""

import pytest

from sparsestreet.records.configuration import config_hash, differing_options, flat_config, only, without

CONFIG = {"schedule.max_steps": 2000, "loss.depth.weight": 0.1, "node": ["background"], "sky.size": None}


def test_a_tree_becomes_flat():
    tree = {"a": {"b": 1, "c": {"d": [1, 2]}}, "e": None, "f": {}, "g": float("inf"), "h": (1.5, "x")}
    assert flat_config(tree) == {"a.b": 1, "a.c.d": [1, 2], "e": None, "g": "inf", "h": [1.5, "x"]}


@pytest.mark.parametrize(
    "names",
    [
        {"seed": 3},
        {"callback.density_control.seed": 3},
        {"data.log.settings.seed": 3},
        {"name": "mine"},
        {"data.root": "/elsewhere"},
        {"data.log.root": "/elsewhere"},
        {"cache": "elsewhere"},
        {"image_points.threads": 8},
        {"resume": "last.ckpt"},
        {"logger": None},
        {"logger.save_dir": "out"},
        {"callback.row_ledger.path": "out/counts.csv"},
        {"trainer.accelerator": "gpu"},
        {"trainer.val_check_interval": 5},
        {"evaluation.novel": [1, 2]},
        {"trunk": "a/run"},
    ],
)
def test_what_names_or_places_a_run_is_no_part_of_its_identity(names):
    assert config_hash(CONFIG | names) == config_hash(CONFIG)


@pytest.mark.parametrize(
    "changed",
    [
        {"schedule.max_steps": 2001},
        {"loss.depth.weight": 0.1000000001},
        {"node": ["background", "rigid"]},
        {"sky.size": 64},
        {"trainer.devices": 2},
        {"trainer.precision": "bf16-mixed"},
        {"seeds": 3},
        {"node.background.path_length": 1.0},
    ],
)
def test_every_other_option_is(changed):
    assert config_hash(CONFIG | changed) != config_hash(CONFIG)


def test_which_devices_train_is_no_part_of_it_but_how_many_share_a_step_is():
    one = config_hash(CONFIG | {"trainer.devices": 1})
    for devices in ([3], "3,", "auto", "1"):
        assert config_hash(CONFIG | {"trainer.devices": devices}) == one
    shared = CONFIG | {"trainer.strategy": "ddp"}
    assert config_hash(shared | {"trainer.devices": [2, 3]}) == config_hash(shared | {"trainer.devices": 2}) != one
    assert config_hash(shared | {"trainer.devices": "auto"}) != config_hash(shared | {"trainer.devices": 1})


def test_the_hash_knows_neither_order_nor_the_spelling_of_numbers():
    assert config_hash(dict(reversed(CONFIG.items()))) == config_hash(CONFIG)
    assert config_hash({"a": 1, "b": [2.0]}) == config_hash({"a": 1.0, "b": [2]})
    assert config_hash({"a": True}) != config_hash({"a": 1})
    assert config_hash({"a": "1"}) != config_hash({"a": 1})
    assert len(config_hash(CONFIG)) == 12
    # printf 'a=1\nb=[2, "x"]' | sha256sum: other programs can make it, and no process changes it.
    assert config_hash({"b": [2, "x"], "a": 1.0, "seed": 5}) == "c1159f138d38"


def test_options_are_chosen_by_pattern():
    assert without(CONFIG, ("loss.*", "node")) == {"schedule.max_steps": 2000, "sky.size": None}
    assert only(CONFIG, ("loss.*", "node")) == {"loss.depth.weight": 0.1, "node": ["background"]}


def differing(*configs, commands=()):
    return differing_options(list(configs), commands)


def test_differing_options_are_named():
    assert differing({"a": 1, "b": "x"}, {"a": 1.0, "b": "y"}, {"a": 1, "b": "x"}) == [("b=x",), ("b=y",), ("b=x",)]
    assert differing({"a": 1, "b": [1]}, {"a": 2, "b": [1, 2]}) == [("a=1", "b=[1]"), ("a=2", "b=[1, 2]")]
    assert differing({"a": 1}) == [()]
    assert differing() == []


def test_an_interpolated_option_is_named_once():
    short, long = {"schedule.steps": 60, "trainer.loop.steps": 60}, {"schedule.steps": 90, "trainer.loop.steps": 90}
    assert differing(short, long) == [("schedule.steps=60",), ("schedule.steps=90",)]
    # Unless a command gave it: then they were set apart.
    both = differing(short, long, commands=["sparsestreet train trainer.loop.steps=90 schedule.steps=90"])
    assert both[1] == ("schedule.steps=90", "trainer.loop.steps=90")
    one = differing(short, long, commands=["sparsestreet train ++trainer.loop.steps=90"])
    assert one[1] == ("trainer.loop.steps=90",)


def test_a_part_that_is_absent_is_named_as_a_whole():
    full = {"loss.depth.weight": 0.1, "loss.depth.kind": "l1", "loss.sky.weight": 1, "limit": None}
    bare = {"loss.sky.weight": 1, "limit": 5}
    assert differing(full, bare) == [("limit=null", "with loss.depth"), ("limit=5", "without loss.depth")]
    masked = {"node.mask.threshold": 0.01, "node.mask.rate": 1}
    assert differing(masked, {"node.mask": None}) == [("with node.mask",), ("without node.mask",)]
    assert differing({"a": None}, {}) == [(), ()]  # null is as good as absent
