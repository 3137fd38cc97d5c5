"""A bundle agrees with itself, and each way in which it can be wrong is a line."""

import shutil
import stat
import zipfile
from functools import partial
from pathlib import Path

import pytest

from sparsestreet.report import bundle_check
from sparsestreet.report.bundle import write_bundle
from sparsestreet.report.bundle_check import unpacked
from sparsestreet.report.sweep import sweep_records
from tests.report.bundles import bundled, changed, members, packed, two_runs, with_entry
from tests.report.sweep_folder import write_sweep

RECORD, IMAGES = "runs/0001/records/summary.json", "runs/0001/records/quality.csv"


@pytest.fixture
def bundle(tmp_path) -> Path:
    return bundled(two_runs(tmp_path / "runs"), tmp_path / "table.zip")


def faults(path: Path) -> list[str]:
    with unpacked(path) as found:
        return list(found.faults())


def test_a_bundle_agrees_with_itself_and_has_the_same_bytes_wherever_it_is_made(bundle, tmp_path):
    assert faults(bundle) == []
    shutil.copytree(tmp_path / "runs", tmp_path / "elsewhere" / "runs")
    assert bundled(tmp_path / "elsewhere", tmp_path / "again.zip").read_bytes() == bundle.read_bytes()
    found = members(bundle)
    assert b"| streetgs+paper against streetgs |" in found["tables.md"]
    assert b"data.root=drive" in found["bundle.json"]
    assert not any(b"/home" in content for content in found.values())
    assert bundle.stat().st_size < 20_000


def test_a_sweep_has_its_own_tables(tmp_path):
    sweep, path = write_sweep(tmp_path / "sweep"), tmp_path / "sweep.zip"
    write_bundle(sweep_records(sweep), path, protocol="strict", of_sweep=True, sweep="table5_ablation")
    assert b"### Table 5 of the paper" in members(path)["tables.md"]
    assert "runs/0009/records/cost.json" in members(path)
    assert faults(path) == []


def set_to(*keys: str, value: object):
    return partial(lambda text, keys, value: with_entry(text, *keys, value=value), keys=keys, value=value)


WRONG = {
    "a record": (RECORD, lambda text: text.replace("25.7412", "26.2412"), False, [f"{RECORD} has the SHA-256"]),
    "a record, hashed again": (
        RECORD,
        set_to("quality", "held_out", "psnr_full", "mean", value=26.2412),
        True,
        ["row 1: its images have a mean psnr_full of 25.7412 (held_out), its record says 26.2412", "tables.md, line "],
    ),
    "images": (IMAGES, lambda text: text.replace("24.1235", "24.2235"), True, ["row 1: its images have a mean psnr_f"]),
    "a count": (RECORD, set_to("gaussians", "rigid", value=1), True, ["gaussians_total is 1200, its parts sum to 100"]),
    "a table": ("tables.md", lambda text: text.replace("25.74", "26.74"), True, ["tables.md, line 5 is '| streetgs |"]),
    "an option": (
        RECORD,
        set_to("run", "config", "schedule.max_steps", value=600),
        True,
        ["row 1: its configuration has the hash "],
    ),
    "a seed": (RECORD, set_to("run", "seed", value=1), True, ["has seed 1, bundle.json 0", "configuration has seed 0"]),
    "a hash of data": (
        "bundle.json",
        set_to("runs", "1", "data_hash", value="f" * 12),
        False,
        ["row 2: its record has data_hash 0123456789ab, bundle.json ffffffffffff"],
    ),
    "no number": (RECORD, lambda text: text.replace("25.7412", "NaN"), True, [f"{RECORD}: is not strict JSON"]),
    "an earlier record": (RECORD, set_to("format", value=3), True, ["the record has format 3, this version reads 4"]),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_was_changed_is_a_line(bundle, case):
    name, change, rehash, expected = WRONG[case]
    said = faults(changed(bundle, name, change, rehash))
    for words in expected:
        assert sum(words in line for line in said) == 1, said
    assert not any("\n" in line or "/tmp" in line for line in said)


def test_members_that_are_lost_or_added_are_a_line(bundle):
    found = members(bundle)
    found["runs/0002/records/cost.json"] = b"{}"
    del found[IMAGES]
    said = faults(packed(bundle, found))
    assert f"{IMAGES} is listed and not there" in said
    assert "runs/0002/records/cost.json is not listed" in said


@pytest.mark.parametrize(
    "name", ["../out.json", "/out.json", "runs/0001/../../x", "runs/0001/.hydra/config.yaml", "a\nb"]
)
def test_a_member_that_no_bundle_has_is_refused(bundle, tmp_path, name):
    packed(bundle, {**members(bundle), name: b"{}"})
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(
        ValueError, match=r"table.zip is no bundle or is damaged \(a member is named '.*: fetch it"
    ) as told:
        faults(bundle)
    assert "\n" not in str(told.value)
    assert sorted(tmp_path.rglob("*")) == before


def test_links_and_names_that_come_twice_are_refused(bundle):
    link = zipfile.ZipInfo("runs/0001/scene.street")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(bundle, "a") as archive:
        archive.writestr(link, "/etc/passwd")
    with pytest.raises(ValueError, match=r"scene.street is a link or a device"):
        faults(bundle)
    bundled(bundle.parent / "runs", bundle)
    with zipfile.ZipFile(bundle, "a") as archive, pytest.warns(UserWarning, match="Duplicate"):
        archive.writestr("tables.md", "")
    with pytest.raises(ValueError, match=r"a member is named 'tables.md'"):
        faults(bundle)


def test_what_would_grow_beyond_limits_is_refused(bundle, monkeypatch):
    monkeypatch.setattr(bundle_check, "MAX_RECORD", 2000)
    with pytest.raises(ValueError, match=r"summary.json would have [\d,]+ bytes, 2,000 at most are read"):
        faults(bundle)
    monkeypatch.undo()
    monkeypatch.setattr(bundle_check, "MAX_RECORDS", 2000)
    with pytest.raises(ValueError, match=r"its records would have [\d,]+ bytes, 2,000"):
        faults(bundle)


def test_a_size_that_the_archive_belies_is_not_read(bundle):
    """A bomb says that it is small: no more than it says is read, and then it is damaged."""
    found = members(bundle)
    with zipfile.ZipFile(bundle, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in found.items():
            archive.writestr(name, content + b" " * 10_000_000 if name == RECORD else content)
        archive.getinfo(RECORD).file_size = 500  # as the list at the end says
    with pytest.raises(ValueError, match=r"is damaged \(Bad CRC-32 for file 'runs/0001"):
        faults(bundle)


@pytest.mark.parametrize("kept", [0, 10, 0.5, 0.99])
def test_what_is_cut_or_no_zip_is_refused(bundle, kept):
    content = bundle.read_bytes()
    bundle.write_bytes(content[: kept if isinstance(kept, int) else int(kept * len(content))])
    with pytest.raises(ValueError, match=r"table.zip is no bundle or is damaged \(.*\): fetch it again"):
        faults(bundle)


def test_another_version_of_the_list_says_what_to_do(bundle):
    changed(bundle, "bundle.json", set_to("format", value=2), rehash=False)
    with pytest.raises(ValueError, match=r"bundle.json: the record has format 2, this version reads 1: check"):
        faults(bundle)


def test_a_row_is_named_by_number_or_label(bundle):
    with unpacked(bundle) as found:
        assert [found.bundle.row(name) for name in ("2", "streetgs")] == [2, 1]
        for name, said in (
            ("3", "no rows are named '3'"),
            ("streetgs+pape", "1: streetgs, street, seed 0; 2: streetgs"),
        ):
            with pytest.raises(ValueError, match=said):
                found.bundle.row(name)


def test_two_rows_of_a_label_need_a_number(tmp_path):
    two_runs(tmp_path / "x")
    shutil.copytree(tmp_path / "x/a", tmp_path / "x/c")
    with (
        unpacked(bundled(tmp_path / "x", tmp_path / "b.zip")) as found,
        pytest.raises(ValueError, match="2 rows are named"),
    ):
        found.bundle.row("streetgs")
