"""Processes of the command: their threads and names, locks of folders, devices of jobs, and the program itself."""

import io
import logging
import os
import signal
import subprocess
import sys
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from sparsestreet.atomic import acquire_lock, release_lock
from sparsestreet.cli import READER_GONE, process
from sparsestreet.cli.commands.evaluate import _device
from sparsestreet.cli.commands.options import run_command
from sparsestreet.cli.commands.scenes import open_scene
from sparsestreet.cli.config.validate import device_of, device_problem
from sparsestreet.cli.process import (
    BUSY_SPINS,
    SPINS,
    is_worker_rank,
    name_beside_first,
    set_log_prefix,
    use_passive_wait,
)
from sparsestreet.cli.runs import locks as device_module
from sparsestreet.cli.runs.locks import LOCK, FolderTakenError, devices_of_job, sole_writer
from tests.evaluation.frames import make_run


@pytest.mark.parametrize(
    ("given", "running", "expected"),
    [
        ({}, [1] * 9, SPINS),
        ({}, [2, 1, 3, 1, 1, 2, 1, 1, 2], SPINS),  # some come and go
        ({}, [2, 1, 3, 1, 2, 2, 1, 1, 2], BUSY_SPINS),
        ({"OMP_NUM_THREADS": "3"}, [2] * 9, SPINS),  # one processor of four is left
        ({"OMP_NUM_THREADS": "3"}, [3] * 9, BUSY_SPINS),
        ({"OMP_NUM_THREADS": "1"}, [9] * 9, SPINS),  # which waits for nobody
        ({}, [], SPINS),  # a system that does not say
        ({"GOMP_SPINCOUNT": "7"}, [9] * 9, "7"),
        ({"OMP_WAIT_POLICY": "ACTIVE"}, [9] * 9, None),
    ],
)
def test_threads_sleep_at_once_where_others_run_unless_the_environment_says_otherwise(
    monkeypatch, given, running, expected
):
    """Of four processors; the system counts this process among those that run."""
    for name in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY", "OMP_NUM_THREADS"):
        monkeypatch.setenv(name, "")  # so that whatever is set here is taken back
        monkeypatch.delenv(name)
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    said = [f"0.50 1.00 2.00 {count}/345 678\n" for count in running]
    monkeypatch.setattr(process.os, "cpu_count", lambda: 4)
    monkeypatch.setattr(process.time, "sleep", lambda seconds: None)
    monkeypatch.setattr(process, "_RUNNING", SimpleNamespace(read_text=lambda: said.pop(0)))
    use_passive_wait()
    assert os.environ.get("GOMP_SPINCOUNT") == expected


DDP = {"strategy": {"_target_": "sparsestreet.training.parallel.DataParallel"}}


@pytest.mark.parametrize(
    ("environment", "name"),
    [
        ({}, None),
        ({"LOCAL_RANK": "0", "NODE_RANK": "0"}, None),
        ({"LOCAL_RANK": "2"}, "process 2"),
        ({"LOCAL_RANK": "1", "NODE_RANK": "3"}, "process 1 of node 3"),
        ({"RANK": "9", "LOCAL_RANK": "1", "NODE_RANK": "1"}, "process 9"),
        ({"SLURM_PROCID": "4"}, "process 4"),
    ],
)
def test_processes_of_a_run_have_names(environment, name, monkeypatch):
    for variable in ("RANK", "LOCAL_RANK", "NODE_RANK", "SLURM_PROCID"):
        monkeypatch.delenv(variable, raising=False)
    for variable, value in environment.items():
        monkeypatch.setenv(variable, value)
    assert name_beside_first(DDP) == name
    assert is_worker_rank(DDP) == (name is not None)
    assert name_beside_first({"strategy": "auto"}) is None  # a job of a cluster that trains alone


def test_only_the_first_process_speaks_below_warnings(monkeypatch):
    """Two handlers, as Hydra sets them; each says the name once."""
    said = [io.StringIO(), io.StringIO()]
    monkeypatch.setattr(logging.getLogger(), "handlers", [logging.StreamHandler(stream) for stream in said])
    level = logging.getLogger("lightning.fabric").level
    try:
        set_log_prefix("process 2")
        log = logging.getLogger("sparsestreet.test")
        log.setLevel(logging.INFO)
        log.info("node 'rigid' takes 5 Vehicle")
        log.warning("%d doubts", 3)
        logging.getLogger("py.warnings").warning("rows: 100 % of them")
    finally:
        logging.captureWarnings(False)
        for library in ("lightning.fabric", "lightning.pytorch"):
            logging.getLogger(library).setLevel(level)
    for stream in said:
        assert stream.getvalue() == "process 2: 3 doubts\nprocess 2: rows: 100 % of them\n"


def test_a_second_writer_is_told_who_the_first_is_and_touches_nothing(tmp_path):
    out = tmp_path / "run"
    with sole_writer(out):
        (out / "scene").write_text("whole")
        said = rf"run is being written by process {os.getpid()} on .*: wait for that run, end it, or name another place"
        with pytest.raises(FolderTakenError, match=said), sole_writer(out):
            pytest.fail("two write")
        assert sorted(path.name for path in out.iterdir()) == [LOCK, "scene"]
    assert [path.name for path in out.iterdir()] == ["scene"]
    with sole_writer(out):
        pass


def test_the_lock_of_a_killed_process_is_free(tmp_path):
    """Its file is still there; a link in its place is no way to another file."""
    code = "import sys, time; from sparsestreet.atomic import acquire_lock; from pathlib import Path; "
    code += "acquire_lock(Path(sys.argv[1])); print('held', flush=True); time.sleep(60)"
    path = tmp_path / "slot"
    process = subprocess.Popen([sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "held\n"
    assert acquire_lock(path) is None
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert path.exists()
    held = acquire_lock(path)
    assert held is not None
    release_lock(path, held)
    assert not path.exists()
    path.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OSError, match="slot"):
        acquire_lock(path)
    assert not (tmp_path / "elsewhere").exists()


@pytest.fixture
def without_gpu(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)


def test_devices_are_named_and_commands_say_what_asked_for_one(without_gpu, monkeypatch, tmp_path):
    assert device_of("cpu", "this", "") == torch.device("cpu")
    for name in ("tpu", "mps"):
        with pytest.raises(ValueError, match=f"device must be cpu or cuda, got '{name}'"):
            device_of(name, "this", "")
    with pytest.raises(ValueError, match="this needs a CUDA device and torch sees none: buy one"):
        device_of("cuda", "this", "buy one")
    with pytest.raises(ValueError, match=r"device=cuda needs a CUDA device .*: say device=cpu"):
        open_scene(tmp_path, "cuda")
    run = replace(make_run(), device="cuda: NVIDIA H100")
    with pytest.raises(ValueError, match=r"trained on cuda: NVIDIA H100 needs .* another machine's; say device=cpu"):
        _device(run, None)
    assert _device(run, "cpu") == torch.device("cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert device_of("cuda:1", "this", "") == torch.device("cuda", 1)


@pytest.fixture
def four_gpus(monkeypatch, tmp_path):
    """As torch would see them, and a folder of locks that is this test's."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 4)
    monkeypatch.setattr(device_module.tempfile, "gettempdir", lambda: str(tmp_path))
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)


def trainer(**options: Any):
    return OmegaConf.create({"accelerator": "gpu", "devices": 1, **options})


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({}, None),
        ({"devices": "auto"}, None),
        ({"devices": "3,"}, None),
        ({"devices": [4]}, r"trainer.devices=[4] is not there: torch sees 4 of them, numbered from 0"),
        ({"devices": 2}, "training runs on one device, got trainer.devices=2: trainer=ddp shares a run among several"),
        ({"devices": [0, 1]}, "training runs on one device"),
        ({"devices": 4, "strategy": "ddp"}, None),
        ({"devices": 2, "strategy": "auto"}, "training runs on one device"),
        ({"devices": [3], "accelerator": "cpu"}, "names a GPU, and this run has none: say trainer=gpu"),
        ({"devices": "auto", "accelerator": "cpu"}, None),
        ({"devices": [3], "accelerator": "auto"}, None),
    ],
)
def test_what_is_asked_of_devices(options, said, four_gpus):
    problem = device_problem(trainer(**options))
    assert problem == said if said is None else said in str(problem)


def given(**options: Any):
    return devices_of_job(trainer(**options))


def test_jobs_beside_each_other_get_a_device_each(four_gpus):
    with given() as one, given(devices="auto") as two, given(devices=[2]) as three:
        assert (one, two, three) == ([0], [1], [2])
        with given() as four, given() as five, given() as six:  # more jobs than devices share them evenly
            assert (four, five, six) == ([3], [0], [1])
        with given() as again, given(devices=[1]) as named:
            assert (again, named) == ([3], [1])
    with given() as free:
        assert free == [0]


def test_a_device_has_one_name_whoever_sees_it(four_gpus, monkeypatch):
    with given(devices=[1]):
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "1,2")
        monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
        with given() as other:
            assert other == [1]


PROGRAM = [sys.executable, "-m", "sparsestreet"]


@pytest.mark.parametrize("words", [["--help"], ["render", "--help"]])
def test_a_reader_that_has_enough_ends_it_quietly(words):
    """As ``| head -1`` does."""
    read, write = os.pipe()
    os.close(read)
    ended = subprocess.run([*PROGRAM, *words], stdout=write, stderr=subprocess.PIPE, text=True, check=False)
    os.close(write)
    assert (ended.returncode, ended.stderr) == (READER_GONE, "")


def test_a_broken_pipe_of_another_program_is_told(capsys, monkeypatch):
    @dataclass(frozen=True)
    class Nothing:
        word: str

    def break_pipe(nothing):
        raise BrokenPipeError(32, "ffmpeg ended")

    read, write = os.pipe()
    with open(read), open(write, "w") as pipe:
        monkeypatch.setattr(sys, "stdout", pipe)
        assert run_command("render", "usage", ["word=x"], Nothing, break_pipe) == 1
    assert "ffmpeg ended" in capsys.readouterr().err


def test_an_unknown_command_is_named(capfd):
    assert subprocess.run([*PROGRAM, "trian"], check=False).returncode == 2
    assert "no command 'trian'; did you mean 'train'?" in capfd.readouterr().err
