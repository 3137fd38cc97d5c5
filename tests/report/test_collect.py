"""Records are found, once each, and what is wrong is named."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from sparsestreet.records.strict_json import RecordError
from sparsestreet.records.summary import SUMMARY
from sparsestreet.report.collect import RunRecord, collect, keep_records
from tests.evaluation.frames import make_summary, with_ranges


def test_collect_finds_each_run_once(tmp_path):
    for name in ("a/run", "b"):
        SUMMARY.write(tmp_path / name, make_summary(name))
    found = collect([tmp_path, tmp_path / "a", tmp_path / "a" / ".." / "b"])
    assert [record.summary.run.label for record in found] == ["a/run", "b"]
    assert found[1].folder == (tmp_path / "b").resolve()
    assert collect([tmp_path / "b"])[0].summary.run.label == "b"  # the run's folder itself


def test_a_kept_record_has_the_errors_of_ranges(tmp_path):
    for name, run in (("a", make_summary()), ("b", with_ranges(make_summary(), 0.125, 0.5))):
        keep_records([RunRecord(Path(name), run)], tmp_path / name)
    without, heard = (json.loads((tmp_path / name).read_text()) for name in "ab")
    assert "geometry" not in without
    assert (heard["geometry"]["seen"]["median"], heard["geometry"]["all"]["median"]) == (0.125, 9.0)


def test_collect_names_what_is_wrong(tmp_path):
    with pytest.raises(FileNotFoundError, match="nosuch is not there: name a folder of runs"):
        collect([tmp_path / "nosuch"])
    (tmp_path / "a.txt").touch()
    with pytest.raises(FileNotFoundError, match=r"a\.txt is a file: name a folder of runs"):
        collect([tmp_path / "a.txt"])
    with pytest.raises(FileNotFoundError, match=r"holds no records/summary\.json"):
        collect([tmp_path])
    SUMMARY.write(tmp_path / "good", make_summary())
    broken = SUMMARY.path(tmp_path / "broken")
    broken.parent.mkdir(parents=True)
    broken.write_text("{}")
    with pytest.raises(RecordError, match=r"broken/records/summary\.json"):
        collect([tmp_path])


@pytest.mark.lengthy
def test_a_report_imports_no_torch():
    """What import contracts cannot see: imports inside of functions, and the command."""
    code = "import sys, sparsestreet.cli.commands.report; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
