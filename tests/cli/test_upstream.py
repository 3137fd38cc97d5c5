"""``sparsestreet presets``: every setting of DriveStudio's beside ours, as the table has them."""

import ast
import itertools
from typing import Any

import pytest

from sparsestreet.cli.commands.options import OptionError, parse_options
from sparsestreet.cli.commands.presets import SAID, WIDTH, PresetsRequest, lines, overview, pairs, presets, rows_of
from sparsestreet.cli.config.compose import CONF, resolved
from sparsestreet.records.configuration import flat_config
from tests.cli.configurations import composed


def alternatives(ours: str) -> list[str]:
    """``node.a|b.rate`` as the keys that it stands for."""
    return [".".join(parts) for parts in itertools.product(*(part.split("|") for part in ours.split(".")))]


def literal(cell: str) -> Any:
    try:
        return ast.literal_eval(cell)
    except (ValueError, SyntaxError):
        return cell


@pytest.mark.parametrize(("preset", "method"), pairs())
def test_our_values_are_those_that_the_preset_composes(preset: str, method: str):
    cfg = composed(f"preset={preset}", f"method={method}", "schedule=paper", "capacity=paper")
    flat: dict[str, Any] = dict(flat_config(resolved(cfg)))
    lists = {key: value for key, value in flat.items() if isinstance(value, list)}
    flat |= {f"{key}.{index}": item for key, items in lists.items() for index, item in enumerate(items)}
    rows = rows_of(preset, method)
    ours = [row for row in rows if row.ours != "-"]
    assert len(ours) > 60
    for row in ours:
        found = [flat[key] for key in alternatives(row.ours)]
        assert found == [literal(row.value)] * len(found), row.key
    notes = [row.reason.removesuffix(SAID).strip() for row in rows if row.verdict == "said" or SAID in row.reason]
    said = set(cfg.preset.absent.values())
    assert said == {note for note in said if any(note in one for one in notes)}
    assert all(any(note in one for note in said) for one in notes)


@pytest.mark.parametrize(("preset", "method"), pairs())
def test_every_key_has_one_row_and_every_difference_its_reason(preset: str, method: str):
    rows = [row for row in rows_of(preset, method) if row.verdict != "said"]
    assert len({row.key for row in rows}) == len(rows) > 100
    assert all((row.verdict == "equal") == (row.reason == "") for row in rows)
    assert all((row.verdict == "absent") == (row.ours == "-") for row in rows)
    text = list(lines(rows_of(preset, method)))
    assert max(map(len, "\n".join(text).splitlines())) <= WIDTH
    assert sum(line.startswith(("equal ", "differs ", "absent ")) for line in text) == len(rows)


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
