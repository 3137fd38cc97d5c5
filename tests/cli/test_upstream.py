"""``sparsestreet presets``: every setting of DriveStudio's beside ours, each row with its verdict and its reason."""

from typing import Any

import pytest
from omegaconf import DictConfig, OmegaConf

from sparsestreet.cli.commands.options import OptionError, parse_options
from sparsestreet.cli.commands.presets import (
    KEYS,
    SETTINGS,
    WIDTH,
    PresetsRequest,
    Row,
    alternatives,
    compare,
    compare_settings,
    lines,
    overview,
    pairs,
    presets,
    problems,
    upstream_settings,
)
from sparsestreet.cli.config.compose import CONF, resolved
from sparsestreet.records.configuration import flat_config
from tests.cli.configurations import composed

FULL = ("schedule=paper", "capacity=paper")
MAPPING: Any = OmegaConf.to_container(OmegaConf.load(KEYS))


def test_there_is_a_column_for_each_configuration_of_the_presets():
    folder = CONF / "preset" / "method"
    there = [(path.parent.name, path.stem) for path in folder.glob("drivestudio*/*.yaml")]
    assert sorted(pairs()) == sorted(there)
    assert set(MAPPING["columns"].values()) == set(upstream_settings())


@pytest.mark.parametrize(("preset", "method"), pairs())
def test_every_row_is_equal_or_has_its_one_reason(preset: str, method: str):
    assert problems(compare(preset, method).rows) == []


@pytest.mark.parametrize(("preset", "method"), pairs())
def test_every_key_of_upstream_has_one_row(preset: str, method: str):
    """Counted in the file, by columns of text."""
    found = compare(preset, method)
    lines = [line.split("\t") for line in SETTINGS.read_text().splitlines() if not line.startswith("#")]
    column = lines[0].index(found.column)
    assert [row.key for row in found.rows] == [line[0] for line in lines[1:] if line[column] != "-"]


@pytest.mark.parametrize(("preset", "method"), pairs())
def test_what_changes_results_is_said_by_a_training(preset: str, method: str):
    """Its notes are the reasons of these rows, and those without a key."""
    found = compare(preset, method)
    notes = composed(f"preset={preset}", f"method={method}", *FULL).preset.absent.values()
    assert {reason for row in found.rows if row.said for reason in row.reasons} | set(found.beyond) == set(notes)


def test_what_the_mapping_names_is_there():
    """Neither a key of ours nor one of upstream's is misspelled; no note and no sentence is left over."""
    all_of = [flat_config(resolved(composed(f"preset={p}", f"method={m}", *FULL))) for p, m in pairs()]
    ours = {key for flat in all_of for key in flat} | {f"data.log.lidar_ahead.{index}" for index in range(2)}
    entries = [entry if isinstance(entry, str) else entry["ours"] for entry in MAPPING["keys"].values()]
    assert {key for entry in entries for key in alternatives(entry)} - ours == set()
    upstream = {key for settings in upstream_settings().values() for key in settings}
    assert MAPPING["keys"].keys() - upstream == set()
    rows = [row for preset, method in pairs() for row in compare(preset, method).rows]
    assert {reason for row in rows for reason in row.reasons} >= MAPPING["because"].keys()
    assert {f"preset.absent.{name}" for name in MAPPING["lacks"]} <= {key for flat in all_of for key in flat}


def compared(upstream: Any, ours: Any, entry: Any, **reasons: Any) -> Row:
    """The row of one key."""
    cfg = OmegaConf.create({"a": ours, "schedule": {"max_steps": 200}, "preset": {"absent": {"note": "no such thing"}}})
    assert isinstance(cfg, DictConfig)
    mapping = {"keys": {"theirs": entry} if entry else {}, "lacks": {}, "because": {}, **reasons}
    (row,) = compare_settings({"theirs": upstream}, cfg, mapping)
    return row


@pytest.mark.parametrize(
    ("upstream", "ours", "entry", "verdict", "here"),
    [
        (0.3, 0.3, "a", "equal", 0.3),
        (0.3, 0.1 + 0.2, "a", "equal", 0.1 + 0.2),
        (0.3, 0.3001, "a", "differs", 0.3001),
        (1, True, "a", "differs", True),  # a number is no switch
        (4, 4.0, "a", "equal", 4.0),
        (51, 0.25, {"ours": "a", "steps": 1}, "equal", 51),
        (51, 0.25, {"ours": "a", "steps": 0}, "differs", 50),
        (0.5, 1.0, {"ours": "a", "per": 2}, "equal", 0.5),
        ("on", None, {"ours": "a", "read": {"None": "on"}}, "equal", "on"),
        ("on", 3, {"ours": "a", "read": {"None": "on"}}, "differs", 3),
        (7, {"b": 7, "c": 7}, "a.b|c|d", "equal", 7),
        (7, {"b": 7, "c": 8}, "a.b|c|d", "differs", [7, 8]),
        (7, {"b": 7}, "a.c|d", "absent", None),
        (7, [6, 7], "a.1", "equal", 7),
        (7, 7, None, "absent", None),
    ],
)
def test_the_verdict_is_computed(upstream: Any, ours: Any, entry: Any, verdict: str, here: Any):
    row = compared(upstream, ours, entry)
    assert (row.verdict, row.here) == (verdict, here)


def test_a_row_without_a_reason_and_an_equal_one_with_a_reason_are_problems():
    because = {"nobody needs it": ["their*"]}
    lacks = {"note": ["theirs"], "another preset's": ["theirs"]}
    assert problems((compared(1, 1, "a"),)) == []
    assert problems((compared(1, 2, "a", because=because), compared(1, 2, "a", lacks=lacks))) == []
    assert problems((compared(1, 2, "a"),)) == ["theirs differs (upstream 1, here 2), with 0 reasons"]
    assert problems((compared(1, 2, None),)) == ["theirs absent (upstream 1, here None), with 0 reasons"]
    assert problems((compared(1, 1, "a", because=because),)) == ["theirs equal (upstream 1, here 1), with 1 reasons"]
    assert len(problems((compared(1, 1, "a", lacks=lacks), compared(1, 2, "a", lacks=lacks, because=because)))) == 2


def test_a_reason_that_changes_results_is_that_of_the_preset():
    row = compared(1, 2, "a", lacks={"note": ["theirs"]})
    assert (row.reasons, row.said) == (("no such thing",), True)
    assert not compared(1, 2, "a", because={"nobody needs it": ["theirs"]}).said


def test_a_changed_value_is_seen():
    """Of every kind of entry: as it is, steps, a factor, a word; and one node of several."""
    changed = {
        "trainer.losses.ssim.w": "loss.photometric.lambda_dssim=0.3",
        "trainer.gaussian_ctrl_general_cfg.stop_split_at": "schedule.densify_until=0.5",
        "model.RigidNodes.optim.ins_rotation.lr": "node.rigid.learning_rates.rotation_deltas.initial=1.0e-5",
        "model.Sky.type": "effects.sky.when=auto",
        "trainer.gaussian_ctrl_general_cfg.cull_alpha_thresh": "node.rigid.density.cull_opacity=0.01",
    }
    cfg = composed("preset=drivestudio_legacy", "method=streetgs", *FULL, *changed.values())
    rows = compare_settings(upstream_settings()["paper_legacy/streetgs"], cfg, MAPPING)
    found = {row.key for row in rows if row.verdict == "differs" and not row.reasons}
    assert found == {*changed, "trainer.losses.rgb.w"}


@pytest.mark.parametrize(("preset", "method"), pairs())
def test_the_table_fits_and_has_every_row(preset: str, method: str):
    found = compare(preset, method)
    text = list(lines(found))
    assert max(map(len, "\n".join(text).splitlines())) <= WIDTH
    assert f"{found.count('equal')} equal, {found.count('differs')} differ, {found.count('absent')} absent" in text[1]
    assert sum(line.startswith(("equal ", "differs ", "absent ")) for line in text) == len(found.rows)


def test_the_columns_stand_under_their_titles(capsys):
    assert presets(["streetgs", "preset=drivestudio", "only=differs"]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[0] == "preset=drivestudio method=streetgs beside configs/streetgs.yaml of DriveStudio (e59bda4)"
    title, row, reason = printed[printed.index("") + 1 :][:3]
    assert title.split() == ["logging", "upstream", "here"]
    assert row.split() == ["differs", "saveckpt_freq", "15000", "1000", "checkpoint_every"]
    assert (title.index("upstream"), title.index("here")) == (row.index("15000"), row.index("1000 "))
    assert reason.strip() == "how often a run says or keeps something"


def test_without_a_preset_both_are_shown(capsys):
    assert presets(["omnire", "only=absent"]) == 0
    printed = capsys.readouterr().out
    assert "preset=drivestudio method=omnire" in printed
    assert "preset=drivestudio_legacy method=omnire" in printed
    assert "\nabsent " in printed
    assert "\nequal " not in printed
    assert "camera poses are not refined (upstream: CamPose, rate 1e-5) (every training says so)" in printed


def test_what_there_is_is_listed(capsys):
    assert presets([]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed == list(overview())
    assert [tuple(line.split()[:2]) for line in printed[1 : 1 + len(pairs())]] == pairs()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["nerf"], "no method=nerf of DriveStudio: choose one of 3dgs, deformgs, omnire, pvg, streetgs"),
        (
            ["pvg", "preset=drivestudio_legacy"],
            "no method=pvg of preset=drivestudio_legacy: choose one of omnire, streetgs",
        ),
        (["pvg", "only=same"], "only must be one of equal, differs, absent, got 'same'"),
    ],
)
def test_a_slip_is_one_line(words: list[str], said: str):
    with pytest.raises(OptionError) as error:
        parse_options(words, PresetsRequest, ("method",))
    assert str(error.value) == said


def test_the_page_has_the_counts_that_the_command_prints():
    page = (CONF.parent / "docs" / "baselines.md").read_text()
    assert "\n".join(overview()).partition("\n\n")[0] in page
