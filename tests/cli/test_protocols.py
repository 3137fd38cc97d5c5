"""conf/protocol: scene lists that papers use, with their windows, cameras and splits."""

import copy
import re

import pytest
from hydra import compose
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from sparsestreet.cli.config.compose import CONF, composed, configuration
from sparsestreet.cli.config.log_from_options import UsageError, configured_log

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
    cfg, found = copy.deepcopy(composed([f"protocol={name}", "data.root=x"])), {}
    for value in values:
        OmegaConf.update(cfg, key, value)
        found[value] = cfg.data.log.first_frame, cfg.data.log.last_frame
    return found


@pytest.mark.parametrize(("name", "published"), [("omnire", OMNIRE), ("streetgs", STREETGS)])
def test_each_scene_has_its_window(name, published):
    assert windows(name) == published


def test_a_name_that_hydra_takes_for_a_number_has_its_window_too():
    """Without quotes the digits are one number."""
    log = composed(["protocol=omnire", "data.root=x", "data.log.scene=1382515516588059826_780_000_800_000"]).data.log
    assert isinstance(log.scene, int)
    assert (log.first_frame, log.last_frame) == (30, 180)


def test_drives_of_kitti_are_told_by_their_names():
    assert [last for _, last in windows("drivestudio_kitti").values()] == [-1, 200, 200, 200]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["protocol=omnire"], "8 scenes, and none is named (data.log.scene or data.log.drive): name one"),
        (["protocol=omnire", "data.log.scene=123_456"], "and 123456 is none of them: name one of conf"),
        (["protocol=streetgs", "data.log.scene=7"], "for 8 scenes, and 7 is none of them: name one of conf/protocol"),
        (["protocol=drivestudio_kitti", "data.log.drive=2011_09_26_drive_0002"], "drive_0002 is none of them"),
        (
            ["+sweep=table5_ablation"],
            "and none is 'x': rename the folder to the drive's number, or say data.log.first",
        ),
        (["+sweep=table5_ablation", "data.root=a/39"], "and none is '39': rename the folder"),
    ],
)
def test_a_drive_without_a_window_is_an_error_and_not_read_whole(words, said):
    words = ["data.root=x", *words]
    with pytest.raises(ValueError, match=re.escape(said)):
        str(composed(words).data.log.last_frame)
    log = composed([*words, "data.log.first_frame=3", "data.log.last_frame=9"]).data.log
    assert (log.first_frame, log.last_frame) == (3, 9)


@pytest.mark.parametrize("name", PROTOCOLS)
def test_a_protocol_is_a_sweep_over_scenes_and_a_choice_for_one(name):
    _, values = scenes(name)
    assert len(values) == len(set(values)) > 1
    cfg = composed([f"protocol={name}", "data.root=x", "split.stride=5", "data.log.width=640"])
    assert (cfg.split.stride, cfg.data.log.width) == (5, 640)  # what is typed still counts


SPLITS = {"omnire": (10, 10), "streetgs": (4, 4), "pvg": (4, 3), "neurad": (2, 1)}


@pytest.mark.parametrize("name", sorted(SPLITS.keys() & set(PROTOCOLS)))
def test_what_is_held_out(name):
    split = composed([f"protocol={name}", "data.root=x"]).split
    assert (split.stride, split.offset) == SPLITS[name]


def test_a_check_says_in_one_line_that_a_scene_has_no_window(tmp_path):
    with pytest.raises(UsageError, match=r"^this protocol has windows of frames for 8 scenes, and none is named"):
        configured_log(["data=waymo", "protocol=omnire"], tmp_path, no_log="", one_log="")
