"""What configurations resolve to: numbers that follow the log, rates, rules at one schedule, scene lists of papers."""

import copy
import re
from types import SimpleNamespace
from typing import Any

import pytest
from hydra import compose
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from sparsestreet.cli.config.compose import CONF, configuration, options_of, resolved, with_images
from sparsestreet.cli.runs.run import identity_of, recipe_of
from sparsestreet.pruning import ImportanceRule, LeaveOneOutRule, LightGaussianRule, MiniSplattingRule
from sparsestreet.records.configuration import flat_config
from sparsestreet.training.callbacks import DensityControl, Pruning
from sparsestreet.training.moved_views import MovedViews
from tests.cli.configurations import composed
from tests.typed import as_a

DRIVE = ("data=drivestudio", "data.root=/no/drive")


@pytest.mark.parametrize(
    ("words", "images", "expected"),
    [
        ((), None, (2000, 40_000, 130_000, 8000)),
        ((), 27, (2000, 40_000, 130_000, 8000)),
        ((), 432, (8000, 160_000, 520_000, 32_000)),  # of 160 frames of it
        (DRIVE, 54, (3000, 40_000, 130_000, 8000)),
        (DRIVE, 108, (6000, 80_000, 260_000, 16_000)),
        ((*DRIVE, "data.images_per_capacity=27"), 108, (6000, 160_000, 520_000, 32_000)),
        (("node.background.max_gaussians=7000",), 432, (8000, 160_000, 7000, 32_000)),
        (("sparsify=uncapped",), 432, (8000, 160_000, None, None)),
        (("schedule=paper", "capacity=paper"), 432, (30_000, 1_000_000, None, None)),
    ],
)
def test_steps_and_gaussians_follow_the_training_images(words, images, expected):
    cfg = with_images(composed(*words), images)
    background, rigid = cfg.node.background, cfg.node.rigid
    found = (cfg.schedule.max_steps, background.num_points, background.max_gaussians, rigid.max_gaussians)
    assert found == expected


@pytest.mark.parametrize(
    ("words", "images", "every"),
    [((), None, 100), ((), 108, 100), ((), 40, 100), ((), 432, 400), ((), 560, 600), (("schedule=paper",), 432, 100)],
)
def test_a_refinement_has_heard_all_training_images(words, images, every):
    cfg = composed(*words)
    recipe_of(cfg)  # as train has it before it reads the log
    control = as_a(DensityControl, recipe_of(with_images(cfg, images)).callbacks["density_control"])
    assert control.refine_in.every == every


@pytest.mark.parametrize(
    ("words", "largest"), [((), 40.0), (("schedule=paper",), None), (("preset=drivestudio",), None)]
)
def test_a_short_run_counts_no_more_of_the_radius_than_a_street_has(words, largest):
    cfg = composed(*words)
    assert recipe_of(cfg).optimizer.largest_radius == largest
    assert {node.density.steady_means for node in cfg.node.values()} == {"preset=drivestudio" not in words}


@pytest.mark.parametrize(
    ("words", "images", "length"),
    [
        ((), None, 1.0),
        ((), 27, 1.0),
        ((), 432, 4.0),
        (DRIVE, 108, 2.0),
        ((*DRIVE, "schedule.max_steps=2000"), 108, 1.0),  # a third of its steps: rates as they are
        (("schedule.max_steps=40000",), 432, 4.0),
        (("budget.minutes=5",), 432, 1.0),
        (("schedule=paper",), 432, 1.0),
    ],
)
def test_rates_are_lower_where_a_longer_log_is_trained_longer(words, images, length):
    cfg = composed(*words)
    recipe_of(cfg)
    assert recipe_of(with_images(cfg, images)).optimizer.relative_length == length


@pytest.mark.parametrize(
    ("words", "images", "removal", "weight"),
    [((), None, 6.0, 12.0), (("schedule.max_steps=1200",), None, 6.0, 12.0), (DRIVE, 108, 2.0, 4.0),
     (("schedule.max_steps=10000",), 108, 1.2, 2.4), (("schedule=paper",), 108, 1.0, 1.0)],
)  # fmt: skip
def test_masks_press_in_a_long_run_as_much_in_all_as_in_2000_steps(words, images, removal, weight):
    schedule = with_images(composed(*words), images).schedule
    assert (schedule.removal_lambda_m, schedule.lambda_m) == pytest.approx((removal, weight))


RULES = options_of("experiment/rule")
NAMES = ("name", "out", "sparsify.")
MOMENT = "[0.93334]"


def without(parts: tuple[str, ...], *overrides: str) -> dict[str, Any]:
    config = flat_config(resolved(composed(*overrides)))
    return {key: value for key, value in config.items() if not key.startswith(parts)}


def test_rules_differ_in_their_rule_alone():
    chosen = [(f"experiment=rule/{rule}", f"schedule.removal_at={MOMENT}") for rule in RULES]
    said = [without((*NAMES, "callback.pruning.rule."), *overrides) for overrides in chosen]
    assert all(one == said[0] for one in said)
    assert len({composed(*overrides).name for overrides in chosen}) == len(RULES) == 6


def test_every_rule_takes_from_all_nodes_and_leaves_the_same_number():
    cfgs = {name: composed(f"experiment=rule/{name}", f"schedule.removal_at={MOMENT}") for name in RULES}
    rules: dict[str, Any] = {
        name: as_a(Pruning, recipe_of(cfg).callbacks["pruning"]).rule for name, cfg in cfgs.items()
    }
    assert {(rule.nodes, rule.keep) for rule in rules.values()} == {(None, 0.5)}
    kinds = {"importance": ImportanceRule, "removal": LeaveOneOutRule}
    kinds |= {"mini_splatting": MiniSplattingRule, "lightgaussian": LightGaussianRule}
    assert kinds == {name: type(rules[name]) for name in kinds}


@pytest.mark.parametrize("method", ["omnire", "pvg"])
def test_uncapped_is_plain_without_limits(method: str):
    nodes = recipe_of(composed(f"method={method}", "sparsify=uncapped")).nodes
    assert {settings.max_gaussians for settings in nodes.values()} == {None}
    apart = (*NAMES, "capacity.", *(f"node.{name}.max_gaussians" for name in nodes))
    assert without(apart, f"method={method}", "sparsify=uncapped") == without(apart, f"method={method}")


def test_a_simulators_preset_differs_in_its_moved_views_alone():
    usual, simulation = (flat_config(resolved(composed(*words))) for words in ((), ("preset=simulation",)))
    apart = {key for key in usual if usual[key] != simulation.get(key)}
    assert {key for key in apart if not key.startswith(("moved_views.", "preset."))} == {"name", "out"}
    assert usual.keys() == simulation.keys()
    settings = recipe_of(composed("preset=simulation")).moved_views
    assert settings == MovedViews(every=2, depth_weight=8.0, color_weight=8.0)


PROTOCOLS = sorted(path.stem for path in (CONF / "protocol").glob("*.yaml"))
OMNIRE = {
    "10455472356147194054_1560_000_1580_000": (0, 150),
    "12505030131868863688_1740_000_1760_000": (0, 150),
    "16951470340360921766_2840_000_2860_000": (0, 150),
    "5846229052615948000_2120_000_2140_000": (0, 140),
    "7761658966964621355_1000_000_1020_000": (0, 170),
    "1382515516588059826_780_000_800_000": (30, 180),
    "4487677815262010875_4940_000_4960_000": (0, 140),
    "9653249092275997647_980_000_1000_000": (130, -1),
}
STREETGS = {6: (0, 85), 26: (0, 100), 90: (0, 102), 105: (20, 186), 108: (20, 115), 134: (106, 198), 150: (96, 197)} | {
    181: (0, 160)
}


def scenes(name: str) -> tuple[str, list]:
    """The key and the values of the sweep, as Hydra splits them."""
    with configuration():
        params = compose("train", [f"protocol={name}", "data.root=x"], return_hydra_config=True).hydra.sweeper.params
    ((key, values),) = ((key, value) for key, value in params.items() if key.startswith("data.log."))
    parser = OverridesParser.create()
    (override,) = parser.parse_overrides([f"{key}={values}"])
    return key, [parser.parse_override(f"{key}={one}").value() for one in override.sweep_string_iterator()]


def windows(name: str) -> dict[str | int, tuple[int, int]]:
    """Scene -> first and last frame."""
    key, values = scenes(name)
    cfg, found = copy.deepcopy(composed(f"protocol={name}", "data.root=x")), {}
    for value in values:
        OmegaConf.update(cfg, key, value)
        found[value] = cfg.data.log.first_frame, cfg.data.log.last_frame
    return found


@pytest.mark.parametrize(("name", "published"), [("omnire", OMNIRE), ("streetgs", STREETGS)])
def test_each_scene_has_its_window(name, published):
    assert windows(name) == published


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["protocol=omnire"], "8 scenes, and none is named (data.log.scene or data.log.drive): name one"),
        (["protocol=omnire", "data.log.scene=123_456"], "and 123456 is none of them: name one of conf"),
        (["protocol=streetgs", "data.log.scene=7"], "for 8 scenes, and 7 is none of them: name one of conf/protocol"),
        (["protocol=drivestudio_kitti", "data.log.drive=2011_09_26_drive_0002"], "drive_0002 is none of them"),
        (["+sweep=table5_ablation"], "172, 552, 788, and none is 'x': say data.log.first"),
        (["+sweep=table5_ablation", "data.root=a/39"], "and none is '39': say data.log.first"),
        (["+sweep=table5_ablation", "data=kitti", "data.root=a/23"], "and none is '23/': say"),
        (["+sweep=table5_ablation", "data=pandaset", "data.log.scene=23"], "and none is 'x/23': say"),
    ],
)
def test_a_drive_without_a_window_is_an_error_and_not_read_whole(words, said):
    words = ["data.root=x", *words]
    with pytest.raises(ValueError, match=re.escape(said)):
        str(composed(*words).data.log.last_frame)
    log = composed(*words, "data.log.first_frame=3", "data.log.last_frame=9").data.log
    assert (log.first_frame, log.last_frame) == (3, 9)


def table_of_waymo(*words: str) -> tuple[object, ...]:
    log = composed("+sweep=table1_waymo", *words).data.log
    return log.first_frame, log.last_frame, log.width, log.cameras, log.lidar_ahead


def test_a_table_takes_a_drive_by_what_its_log_says_and_not_by_its_folder(tmp_path):
    """The same protocol of DriveStudio's folder and of Waymo's files, whose folder says nothing, or another number."""
    names = ["1382515516588059826_780_000_800_000", "9653249092275997647_980_000_1000_000"]
    for name, folder in zip(names, ("788", "segments"), strict=True):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / f"segment-{name}_with_camera_labels.tfrecord").touch()
    assert table_of_waymo("data.root=a/172") == (30, 180, 960, [0, 1, 2], [-2, 80])
    waymo = ["data=waymo", f"data.root={tmp_path}/788"]
    assert table_of_waymo(*waymo) == (30, 180, 960, None, [-2, 80])
    assert table_of_waymo("data=waymo", f"data.root={tmp_path}/segments")[:2] == (130, -1)
    (tmp_path / "list.txt").write_text("\n".join(names))
    # Hydra reads the name of a segment as a number; a number is a place in the list.
    for scene in (names[0], "0", f"'{names[0]}'"):
        assert table_of_waymo(*waymo, f"data.log.scene={scene}", f"data.log.scenes={tmp_path}/list.txt")[0] == 30
    mine = table_of_waymo("data=waymo", f"data.root={tmp_path}/788", f"+data.drives.mine=[{names[0]},5,9]")
    assert mine[:2] == (30, 180)
    other = ["data=nuscenes", "data.root=x", "data.log.first_frame=0", "data.log.last_frame=9"]
    assert table_of_waymo(*other) == (0, 9, 800, ["CAM_FRONT", "CAM_FRONT_LEFT", "CAM_FRONT_RIGHT"], None)


@pytest.mark.parametrize("name", PROTOCOLS)
def test_a_protocol_is_a_sweep_over_scenes_and_a_choice_for_one(name):
    _, values = scenes(name)
    assert len(values) == len(set(values)) > 1


SPLITS = {"omnire": (10, 10), "streetgs": (4, 4), "pvg": (4, 3), "neurad": (2, 1)}


@pytest.mark.parametrize("name", sorted(SPLITS.keys() & set(PROTOCOLS)))
def test_what_is_held_out(name):
    split = composed(f"protocol={name}", "data.root=x").split
    assert (split.stride, split.offset) == SPLITS[name]


def test_a_record_tells_what_grew_with_the_log(tmp_path, monkeypatch):
    """A value that was given stands for itself, however long the log is."""
    monkeypatch.setattr("sparsestreet.cli.runs.run.reader_of", lambda cfg: SimpleNamespace(data_hash=lambda: "log"))

    def follows(images, *words):
        return dict(identity_of(with_images(composed(*words), images), "train").follows)

    grown, given = follows(1000), follows(1000, "node.background.max_gaussians=200000")
    assert grown["node.background.max_gaussians"] == 130_000
    assert grown.keys() - given.keys() == {"node.background.max_gaussians"}
    assert "training_views.images" not in grown
    assert follows(50) == {}
