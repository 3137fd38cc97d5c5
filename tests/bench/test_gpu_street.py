"""The street of real size on a device: what a call does with its time, and what it brings home."""

import os
import shutil
import subprocess
import sys
import tarfile
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "scripts" / "gpu_street.sh"
SWEEP = Path("outputs", "sweeps", "real_size")

PRETENDS = """
import os, sys, time
from pathlib import Path

given = " ".join(sys.argv[1:])
with Path("calls").open("a") as file:
    file.write(given + chr(10))
if " train " in given:
    for run in ("streetgs_seed0", "streetgs+paper_seed0"):
        for name in ("run.json", "scene.safetensors", "records/summary.json", "curves/metrics.csv", "checkpoints/a"):
            path = Path("outputs/sweeps/real_size", run, name)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
    if MODE == "long":
        time.sleep(30)
    sys.exit(1 if MODE == "failing" else 0)
"""


def run(folder: Path, mode: str, *arguments: str) -> tuple[subprocess.CompletedProcess[str], list[str]]:
    """The script in a folder of its own, with a Python that notes what it is called with; the calls."""
    (folder / "scripts").mkdir(exist_ok=True)
    shutil.copy(SCRIPT, folder / "scripts")
    python = folder / "python"
    python.write_text(f"#!{sys.executable} -S\nMODE = {mode!r}\n{PRETENDS}", encoding="utf-8")
    python.chmod(0o755)
    said = subprocess.run(
        [str(folder / "scripts" / SCRIPT.name), *arguments],
        env={"PATH": os.environ["PATH"], "PYTHON": str(python), "OUT": str(folder / "out"), "LIMIT": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    return said, [
        line for line in (folder / "calls").read_text(encoding="utf-8").splitlines() if "gpu_needs" not in line
    ]


def brought_home(folder: Path) -> set[str]:
    with tarfile.open(folder / "out" / "real_size.tar.gz") as archive:
        return {str(Path(name).relative_to(SWEEP)) for name in archive.getnames()}


def test_a_finished_sweep_is_reported_and_each_run_is_timed_once(tmp_path):
    said, calls = run(tmp_path, "finished", "seed=1")
    assert said.returncode == 0, said.stderr
    assert calls[0] == "-m sparsestreet train +sweep=real_size trainer=gpu seed=1"
    assert calls[1] == f"-m sparsestreet report sweep={SWEEP}"
    timed = {call.split("street=")[1].split()[0] for call in calls[2:]}
    assert timed == {f"{SWEEP}/streetgs_seed0", f"{SWEEP}/streetgs+paper_seed0"}
    assert all("-m benchmarks.gpu" in call and "enlarge=2" in call for call in calls[2:])
    of_a_run = {"run.json", "records/summary.json", "curves/metrics.csv"}
    expected = {f"{name}/{file}" for name in ("streetgs_seed0", "streetgs+paper_seed0") for file in of_a_run}
    assert brought_home(tmp_path) == expected  # no scene, no checkpoint
    (tmp_path / "out" / "streetgs_seed0").mkdir()
    (tmp_path / "out" / "streetgs_seed0" / "gpu.jsonl").touch()
    _, again = run(tmp_path, "finished")
    assert len(again) - len(calls) == 3  # training, report and the run that has no times


@pytest.mark.parametrize(("mode", "status", "words"), [("long", 75, "call this again to go on"), ("failing", 1, "")])
def test_a_sweep_that_is_not_finished_brings_its_records_home_and_says_so(tmp_path, mode, status, words):
    said, calls = run(tmp_path, mode)
    assert said.returncode == status
    assert words in said.stdout
    assert len(calls) == 1
    assert "streetgs_seed0/records/summary.json" in brought_home(tmp_path)
