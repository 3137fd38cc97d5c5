"""Jobs that sweeps share are trained once; the folder of each sweep is whole."""

import math
import os
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from omegaconf import DictConfig, OmegaConf

from sparsestreet.cli import folder, reuse
from sparsestreet.cli.assemble import with_images
from sparsestreet.cli.compose import resolved
from sparsestreet.cli.jobs import SweepCount, _Job, count_jobs, jobs
from sparsestreet.cli.reuse import finished_elsewhere, take_finished
from sparsestreet.cli.sweep import finished
from sparsestreet.records.configuration import flat_config
from sparsestreet.records.costs import COSTS, update_costs
from sparsestreet.records.run import RUN, SAME_AS
from sparsestreet.records.summary import SUMMARY
from sparsestreet.report.sweep import write_report
from tests.cli import configurations
from tests.evaluation.frames import make_summary
from tests.typed import there


def composed(*words: str) -> DictConfig:
    return configurations.composed(*words)


def standing(out: Path, *words: str, steps: int = 60, ended: bool = True) -> Path:
    """What a job of another sweep left."""
    cfg = with_images(composed(*words), 7)  # it has read its log
    summary = make_summary(cfg.name, cfg.seed, 25.0, steps=steps)
    summary = replace(summary, run=replace(summary.run, config=flat_config(resolved(cfg))))
    RUN.write(out, summary.run)
    SUMMARY.write(out, summary)
    update_costs(out, wall_seconds=9.0 if ended else None, phases={"train": 9.0})
    for name in ("scene.safetensors", "views.json", "rig.json", "predictions/held_out/005_0.png", "curves/metrics.csv"):
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text(name)
    (out / "checkpoints").mkdir()
    (out / "checkpoints/last.ckpt").touch()
    return out


@pytest.fixture
def sweeps(tmp_path, monkeypatch) -> Path:
    """The folder of sweeps, with ``two`` under way."""
    hydra = {"sweep": {"dir": str(tmp_path / "two")}, "overrides": {"task": []}, "runtime": {"cwd": "/here"}}
    cfg = OmegaConf.create({"hydra": hydra})
    for module in (folder, reuse):
        monkeypatch.setattr(module.HydraConfig, "get", lambda: cfg.hydra)
    monkeypatch.setattr(folder.HydraConfig, "instance", lambda: type("Hydra", (), {"cfg": cfg}))
    (tmp_path / "two" / "job").mkdir(parents=True)
    return tmp_path


@pytest.mark.parametrize(
    ("left", "asked", "found"),
    [
        ({}, (), True),
        ({}, ("name=else", "evaluation.novel=[1]", "trainer.val_check_interval=7"), True),
        ({}, ("reuse=false",), False),
        ({}, ("overwrite=true",), False),
        ({}, ("resume=some/run",), False),
        ({}, ("seed=1",), False),
        ({}, ("schedule.max_steps=90",), False),
        ({"steps": 59}, (), False),
        ({"ended": False}, (), False),
    ],
)
def test_the_very_run_of_another_sweep_is_found(sweeps, left, asked, found):
    run = standing(sweeps / "one" / "job", **left)
    assert finished_elsewhere(composed(*asked), sweeps / "two" / "job") == (run if found else None)


def test_a_run_that_goes_on_takes_no_other(sweeps):
    standing(sweeps / "one" / "job")
    out = standing(sweeps / "two" / "job", steps=23)
    assert finished_elsewhere(composed(), out) is None
    shutil.rmtree(out / "checkpoints")
    assert finished_elsewhere(composed(), out) is not None


def test_the_one_that_measured_what_is_asked_comes_first(sweeps, monkeypatch):
    plain = standing(sweeps / "a" / "job")
    novel = standing(sweeps / "b" / "job", "evaluation.novel=[1,2]")
    (sweeps / "c" / "job").mkdir(parents=True)
    (sweeps / "c" / "job" / "run.json").write_text("{}")  # of a version that we do not know
    out = sweeps / "two" / "job"
    assert finished_elsewhere(composed("evaluation.novel=[1,2]"), out) == novel
    assert finished_elsewhere(composed(), out) == plain
    shutil.rmtree(plain)
    assert finished_elsewhere(composed(), out) == novel
    monkeypatch.setattr(reuse, "_measure", lambda cfg, out: pytest.fail("it has more than is asked"))
    take_finished(composed(), novel, out)


def test_what_is_taken_is_whole_and_its_own(sweeps, monkeypatch):
    monkeypatch.setattr(reuse, "_measure", lambda cfg, out: pytest.fail("it was measured"))
    run, out = standing(sweeps / "one" / "job"), sweeps / "two" / "job"
    cfg = composed("name=else")
    assert take_finished(cfg, run, out) == 25.0
    assert finished(cfg, out) == 25.0
    for name in ("scene.safetensors", "predictions/held_out/005_0.png"):
        assert (out / name).samefile(run / name)  # no second bytes on the disk
    assert (out / "curves/metrics.csv").read_text() == "curves/metrics.csv"
    assert not (out / "curves/metrics.csv").samefile(run / "curves/metrics.csv")  # which a logger appends to
    assert not (out / "checkpoints").exists()
    description = RUN.read(out)
    assert (description.label, description.config["name"]) == ("else", "else")
    assert SUMMARY.read(out).run == description
    assert RUN.read(run).label == composed().name
    assert there(COSTS.read(out)).wall_seconds == 9.0
    same = SAME_AS.read(out)
    assert (out / same.run).resolve() == run
    assert same.label == composed().name
    shutil.rmtree(sweeps / "one")
    shutil.copytree(sweeps / "two", sweeps / "elsewhere" / "two")
    report = write_report(sweeps / "elsewhere" / "two")
    assert "trained by another sweep, whose runs these are: job" in report.notes
    assert "else" in (report.folder / "tables.md").read_text()


def test_what_was_not_measured_is_and_a_kill_before_that_is_no_end(sweeps, monkeypatch):
    run, out, cfg = standing(sweeps / "one" / "job"), sweeps / "two" / "job", composed("evaluation.novel=[1]")

    def killed(cfg: DictConfig, out: Path) -> None:
        assert finished(cfg, out) is None
        raise KeyboardInterrupt

    monkeypatch.setattr(reuse, "_measure", killed)
    with pytest.raises(KeyboardInterrupt):
        take_finished(cfg, run, out)
    assert finished(cfg, out) is None
    assert finished_elsewhere(cfg, out) == run
    measured = []
    monkeypatch.setattr(reuse, "_measure", lambda cfg, out: measured.append(out))
    assert take_finished(cfg, run, out) == finished(cfg, out) == 25.0
    assert measured == [out]


def test_a_kill_while_files_are_taken_is_no_end(sweeps, monkeypatch):
    def killed(*arguments: object) -> None:
        raise KeyboardInterrupt

    run, out = standing(sweeps / "one" / "job"), sweeps / "two" / "job"
    monkeypatch.setattr(reuse, "_configured", killed)
    with pytest.raises(KeyboardInterrupt):
        take_finished(composed(), run, out)
    assert (out / "curves/metrics.csv").exists()
    assert not SUMMARY.exists(out)
    assert not COSTS.exists(out)


def test_files_are_copied_where_no_link_can_be(sweeps, monkeypatch):
    def refused(*paths: str) -> None:
        raise OSError("another device")

    monkeypatch.setattr(os, "link", refused)
    run, out = standing(sweeps / "one" / "job"), sweeps / "two" / "job"
    take_finished(composed(), run, out)
    assert (out / "scene.safetensors").read_text() == "scene.safetensors"
    assert not (out / "scene.safetensors").samefile(run / "scene.safetensors")


@pytest.mark.lengthy
def test_trainings_are_counted_with_and_without_those_that_repeat(capsys):
    """Tables 3 and 5 share the paper's score; what prunes late begins with what another job has trained."""
    counts = count_jobs(["table5_ablation", "table3_pruning"], ["data.root=/drives/023", "seed=0"])
    late = 0.93334
    assert counts == [SweepCount("table5_ablation", 3, 0, 0, late), SweepCount("table3_pruning", 2, 1, 0, late)]
    assert [count.trainings for count in counts] == [3, 1]
    assert counts[1].whole_runs == pytest.approx(1 - late)


def test_a_job_begins_with_the_latest_moment_before_its_own_pruning():
    kept: set[float] = set()
    moments = [0.93334, 0.93334, 0.6, 0.4, math.inf]
    begun = [_Job(0, 0, first, (0.4, 0.6) if first > 0.6 else (0.4,), False).begins(kept) for first in moments]
    assert begun == [0.0, 0.6, 0.6, 0.4, 0.0]


def test_jobs_that_cannot_be_counted_are_said(capsys):
    assert jobs([]) == 2
    assert jobs(["--help"]) == 0
    assert "What sweeps of conf/sweep, or one of the command line, would train" in capsys.readouterr().out
    assert jobs(["+sweep=tony"]) == 2
    assert "sparsestreet jobs: no option 'tony' in conf/sweep" in capsys.readouterr().err


def test_jobs_prints_a_line_a_sweep_and_their_sum(monkeypatch, capsys):
    counts = [SweepCount("one", 9, 0, 2, 1.5), SweepCount("two", 6, 3, 0)]
    monkeypatch.setattr("sparsestreet.cli.jobs.override_problem", lambda words: None)
    monkeypatch.setattr("sparsestreet.cli.jobs.count_jobs", lambda names, rest: counts if rest == ["seed=0"] else [])
    assert jobs(["+sweep=one,two", "seed=0"]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert lines[1:] == [
        ["one", "9", "0", "2", "7", "5.5"],
        ["two", "6", "3", "0", "3", "3.0"],
        ["sum", "15", "3", "2", "10", "8.5"],
    ]
