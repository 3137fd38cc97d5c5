"""What a command says of its threads before torch is imported, and what it leaves to its user."""

import os

import pytest

from sparsestreet.cli.process import SPINS, follows_another, wait_politely


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
    wait_politely()
    assert os.environ.get("GOMP_SPINCOUNT") == expected


@pytest.mark.parametrize("name", ["RANK", "LOCAL_RANK", "NODE_RANK", "SLURM_PROCID"])
def test_the_first_process_of_a_run_follows_nobody(name, monkeypatch):
    """Nor does any that shares no run: a cluster numbers jobs that know nothing of each other as well."""
    for one in ("RANK", "LOCAL_RANK", "NODE_RANK", "SLURM_PROCID"):
        monkeypatch.setenv(one, "0")
    assert not follows_another({"strategy": "ddp"})
    monkeypatch.setenv(name, "1")
    assert follows_another({"strategy": "ddp"})
    for alone in ({}, {"strategy": "auto"}, {"strategy": None}):
        assert not follows_another(alone)
