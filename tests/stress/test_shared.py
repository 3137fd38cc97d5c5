"""Runs that begin at once, and make the same street and the same points."""

import os
from functools import partial
from pathlib import Path

import pytest

from sparsestreet.cli import main
from sparsestreet.triangulation import street
from tests.cli.conftest import street_at
from tests.cli.test_killed_sweep import content
from tests.stress.forked import Forked
from tests.stress.runs import SHORT, contents
from tests.triangulation.test_street import POINTS, _get

RUNS = 8


def words(folder: Path, out: Path) -> list[str]:
    """Of one run; the street is not there yet."""
    return ["train", *street_at(folder / "street"), *SHORT, f"cache={folder / 'kept'}", f"out={out}"]


@pytest.mark.stress
def test_eight_runs_share_their_caches(tmp_path):
    """On two cores; each leaves what it would leave alone."""
    alone, shared = tmp_path / "alone", tmp_path / "shared"
    cores = sorted(os.sched_getaffinity(0))[-2:]  # a record says how many there are
    ended = Forked(partial(main, words(shared, shared / "run")), tmp_path / "log", cores=cores).join()
    assert ended.status == 0, ended.said
    expected = content(shared / "run")
    shared.rename(alone)
    runs = [shared / f"run{number}" for number in range(RUNS)]
    started = [Forked(partial(main, words(shared, run)), tmp_path / f"log {run.name}", cores=cores) for run in runs]
    for found in [one.join() for one in started]:
        assert found.status == 0, found.said
        assert "Traceback" not in found.said
        assert "is damaged" not in found.said
    assert sorted(path.name for path in shared.iterdir()) == ["kept", *(run.name for run in runs), "street"]
    assert contents(alone / "street") == contents(shared / "street")
    # Names tell streets of other folders and times apart.
    kept = [sorted(_answers(folder / "kept")) for folder in (alone, shared)]
    assert kept[0] == kept[1]
    for run in runs:
        got = content(run)
        assert sorted(expected) == sorted(got)
        assert [name for name in expected if expected[name] != got[name]] == []


def _answers(folder: Path) -> list[tuple[str, bytes]]:
    """Names of what is kept, without what they depend on, and contents."""
    return [(path.name.partition("-")[0], path.read_bytes()) for path in folder.iterdir()]


@pytest.mark.lengthy
def test_the_short_form(tmp_path, monkeypatch):
    """Two processes ask for the same points, and find or make them."""
    monkeypatch.setattr(street, "street_points", lambda *inputs: POINTS)

    def ask() -> None:
        for _ in range(20):
            assert len(_get(tmp_path / "points").static) == len(POINTS.static)
            for path in (tmp_path / "points").glob("[!.]*.npz"):
                path.unlink(missing_ok=True)

    for found in [one.join() for one in [Forked(ask, tmp_path / f"log{number}") for number in range(2)]]:
        assert found.status == 0, found.said
        assert "damaged" not in found.said
