"""A process group that loses a process: the others end with one sentence, and the same command goes on."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.cli.conftest import TINY_RIGID
from tests.cli.test_killed_sweep import content

STEPS = 400
WITHIN = 30.0
"""Seconds until the others have ended."""


def started(words: list[str], log: Path) -> subprocess.Popen:
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONWARNINGS": "default"}
    with log.open("w") as file:
        command = [sys.executable, "-m", "sparsestreet", "train", *words]
        return subprocess.Popen(command, env=environment, stdout=file, stderr=file, start_new_session=True)


def children(pid: int) -> list[int]:
    return [int(text) for text in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


@pytest.mark.stress
def test_a_lost_process_of_a_command(tiny_street, tmp_path):
    words = [*tiny_street, *TINY_RIGID, "trainer=ddp", "trainer.devices=2", f"schedule.max_steps={2 * STEPS}"]
    words += ["checkpoint_every=40", "trainer.val_check_interval=100", "trainer.strategy.patience=60"]
    whole, lost, log = tmp_path / "whole", tmp_path / "lost", tmp_path / "log"
    process = started([*words, f"out={whole}"], log)
    assert process.wait(300) == 0, log.read_text()
    for once in ("node 'rigid' takes", "Gaussians, about", "stay in memory once they are decoded", "held-out views:"):
        assert log.read_text().count(once) == 1, once

    process = started([*words, f"out={lost}"], log)
    while "step 120 of" not in log.read_text():
        assert process.poll() is None, log.read_text()
        time.sleep(0.05)
    (other,) = [pid for pid in children(process.pid) if "sparsestreet" in Path(f"/proc/{pid}/cmdline").read_text()]
    os.kill(other, signal.SIGKILL)
    killed = time.monotonic()
    status = process.wait(120)
    print(f"the other ended {time.monotonic() - killed:.1f} s later with status {status}")
    assert time.monotonic() - killed < WITHIN
    said = log.read_text()
    # Our own sentence, unless Lightning, which looks at its processes every few seconds, was faster.
    sentences = [line for line in said.splitlines() if "no longer answers process 0" in line]
    assert (status, len(sentences)) == (1, 1) or (status == -9 and "Child process with PID" in said), said
    assert "Traceback" not in said
    assert not (lost / "scene.safetensors").exists()

    process = started([*words, f"out={lost}"], log)
    assert process.wait(300) == 0, log.read_text()
    assert "it goes on from its newest checkpoint" in log.read_text()
    expected, got = (
        {name: value for name, value in content(run).items() if not name.endswith(".log")} for run in (whole, lost)
    )
    assert sorted(expected) == sorted(got)
    assert [name for name in expected if expected[name] != got[name]] == []
