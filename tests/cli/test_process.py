"""What a command says of its threads before torch is imported, and what it leaves to its user."""

import io
import logging
import os

import pytest

from sparsestreet.cli.process import SPINS, is_worker_rank, name_beside_first, set_log_prefix, use_passive_wait


@pytest.mark.parametrize(
    ("given", "expected"),
    [({}, SPINS), ({"GOMP_SPINCOUNT": "7"}, "7"), ({"OMP_WAIT_POLICY": "ACTIVE"}, None)],
)
def test_threads_sleep_unless_the_environment_says_otherwise(monkeypatch, given, expected):
    for name in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY"):
        monkeypatch.setenv(name, "")  # so that whatever is set here is taken back
        monkeypatch.delenv(name)
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    use_passive_wait()
    assert os.environ.get("GOMP_SPINCOUNT") == expected


@pytest.mark.parametrize("name", ["RANK", "LOCAL_RANK", "NODE_RANK", "SLURM_PROCID"])
def test_the_first_process_of_a_run_follows_nobody(name, monkeypatch):
    """Nor does any that shares no run: a cluster numbers jobs that know nothing of each other as well."""
    for one in ("RANK", "LOCAL_RANK", "NODE_RANK", "SLURM_PROCID"):
        monkeypatch.setenv(one, "0")
    assert not is_worker_rank({"strategy": "ddp"})
    monkeypatch.setenv(name, "1")
    assert is_worker_rank({"strategy": "ddp"})
    for alone in ({}, {"strategy": "auto"}, {"strategy": None}):
        assert not is_worker_rank(alone)


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
