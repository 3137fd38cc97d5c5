"""What the check of a GPU leaves out where packages of the tests are missing, and what it says of its training."""

import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from sparsestreet.evaluation.records import write_summary
from sparsestreet.ops.cpu import library
from tests.evaluation.frames import make_summary
from tests.ops import scenes

ROOT = Path(__file__).parents[2]
SCRIPTS = ROOT / "scripts"


@pytest.mark.lengthy
def test_files_without_their_packages_are_left_out_and_named(tmp_path):
    files = {
        "good": "",
        "lacking": "import nowhere_to_be_found.part",
        "broken": "from sparsestreet.ops import nothing_of_this_name",
        "typo": "import sparsestreet.opps",
    }
    for name, text in files.items():
        (tmp_path / f"test_{name}.py").write_text(f"{text}\ndef test_it(): pass\n", encoding="utf-8")
    # Names of files are relative to the folder of the settings.
    (tmp_path / "pytest.ini").write_text("[pytest]\n", encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "leave_out_missing", "-p", "no:cacheprovider"]
    path = os.pathsep.join([str(SCRIPTS), os.environ.get("PYTHONPATH", "")])
    for more, broken in (([], 0), (["--continue-on-collection-errors"], 2)):
        run = subprocess.run(
            [*command, *more, *(() if broken else ("test_good.py", "test_lacking.py"))],
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": path},
            capture_output=True,
            text=True,
            check=False,
        )
        lines = run.stdout.splitlines()
        assert [line for line in lines if line.startswith("left out:")] == [
            "left out: test_lacking.py (no nowhere_to_be_found)"
        ], run.stdout + run.stderr
        assert "1 passed, 1 skipped" in lines[-1]
        assert (f"{broken} errors" in lines[-1], run.returncode) == (broken > 0, int(broken > 0))


def test_the_line_about_the_training_is_of_todays_records(tmp_path):
    write_summary(tmp_path / "train.json", make_summary())
    (program,) = re.findall(r"SUMMARIZE='\n(.*?)'\n", (SCRIPTS / "gpu_check.sh").read_text(), flags=re.S)
    said = subprocess.run([sys.executable, "-c", program, tmp_path / "train.json"], capture_output=True, text=True)
    assert said.stdout == "100.0 s of training, held-out PSNR 25.00 dB\n", said.stderr


def test_without_the_library_its_backend_is_left_out(monkeypatch):
    monkeypatch.setattr(library, "find_library", lambda: None)
    found = runpy.run_path(str(ROOT / "tests" / "ops" / "scenes.py"))
    assert "cpu" not in found["BACKENDS"]
    assert found["BACKENDS"][0] == "reference"
    assert "cpu" in scenes.BACKENDS
