"""Whose folder a run writes into: nobody else's unless asked, and none for a start that fails."""

import math
import shutil
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
from omegaconf import DictConfig, OmegaConf

from sparsestreet.cli.config.compose import composed, resolved
from sparsestreet.cli.runs import folder
from sparsestreet.cli.runs.folder import (
    OF_A_RUN,
    folder_problem,
    leave_folder,
    resumed_overrides,
    start_of,
    take_folder,
)
from sparsestreet.cli.runs.locks import sole_writer
from sparsestreet.cli.runs.sweep import run_job
from sparsestreet.data.datamodule import StreetData
from sparsestreet.evaluation.extra import ExtraMetrics
from sparsestreet.records.configuration import flat_config
from sparsestreet.records.costs import update_costs
from sparsestreet.records.run import RUN
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import RenderOptions
from sparsestreet.training.run import evaluate
from tests.evaluation.frames import make_summary
from tests.typed import there


def a_run(out: Path, *overrides: str, steps: int | None = 60, measured: bool = True) -> Path:
    """A folder as training leaves it, after so many of 60 steps; None: killed before it could say how many."""
    cfg = composed(overrides)
    (out / "checkpoints").mkdir(parents=True)
    (out / "checkpoints/last.ckpt").touch()
    (out / ".hydra").mkdir()
    OmegaConf.save(cfg, out / ".hydra/config.yaml")
    OmegaConf.save(list(overrides), out / ".hydra/overrides.yaml")
    if steps is not None:
        config = flat_config(resolved(cfg))
        RUN.write(out, make_summary(cfg.name, cfg.seed, config=config, steps=steps).run)
    if steps == 60:
        update_costs(out, wall_seconds=1.0 if measured else None, phases={"train": 1.0})
    return out


@pytest.mark.parametrize(
    ("made", "asked", "goes_on"),
    [
        ({"steps": 23}, (), True),
        ({"steps": None}, (), True),  # killed between two checkpoints
        ({"measured": False}, (), True),  # killed while it was measured
        ({"steps": 23}, ("overwrite=true",), False),
        ({"steps": 23}, ("seed=1",), False),
    ],
)
def test_this_very_run_goes_on_without_being_asked(made, asked, goes_on, tmp_path):
    out = a_run(tmp_path / "run", **made)
    assert start_of(composed(asked), out) == (out if goes_on else None)
    assert start_of(composed(asked), tmp_path / "new") is None


def test_a_run_that_was_ended_before_its_first_checkpoint_begins_again(tmp_path, caplog):
    out = a_run(tmp_path / "run", steps=None)
    (out / "checkpoints/last.ckpt").rename(out / "checkpoints/.last.99.tmp.ckpt")
    assert folder_problem(composed(()), out) is None
    with caplog.at_level("INFO"):
        assert start_of(composed(()), out) is None
    assert "ended before its first checkpoint: it begins again" in caplog.text


def test_a_drive_is_the_same_by_another_path(tmp_path, monkeypatch):
    """A configuration is read back with whole paths."""
    monkeypatch.chdir(tmp_path)
    words = ("data=drivestudio", "data.root=drives/1")
    a_run(Path("run"), *words, steps=23)
    OmegaConf.save({"hydra": {"runtime": {"cwd": str(tmp_path)}}}, "run/.hydra/hydra.yaml")
    assert start_of(composed(words), Path("run")) == Path("run")
    assert "holds another run" in there(folder_problem(composed([words[0], "data.root=drives/2"]), Path("run")))


def contents(out: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in out.rglob("*")}


@pytest.mark.parametrize(
    ("words", "steps", "said"),
    [
        ((), 60, "holds this very run, finished: sparsestreet evaluate run={out}, or replace it: overwrite=true"),
        ((), 23, None),  # it goes on
        ((), None, None),
        (("seed=1",), 60, "holds another run (streetgs, seed 0): name another place with out=..., or replace it: over"),
        (("sparsify=paper",), 23, "holds another run (streetgs, seed 0)"),
        (("data=drivestudio", "data.root=/drives/1"), None, "holds another run: name"),
        (("overwrite=true", "sparsify=paper"), 60, None),
    ],
)
def test_a_folder_with_a_run_is_refused_unless_asked(words, steps, said, tmp_path):
    out = a_run(tmp_path / "run", steps=steps)
    problem = folder_problem(composed(words), out)
    assert problem == said if said is None else said.format(out=out) in there(problem)


def test_a_run_goes_on_in_its_own_folder_and_in_no_other_runs(tmp_path):
    run, other = a_run(tmp_path / "run", steps=23), a_run(tmp_path / "other", "seed=1")
    for text in (run, run / "checkpoints/last.ckpt"):
        cfg = composed([f"resume={text}"])
        assert folder_problem(cfg, run) is None
        assert "holds another run" in there(folder_problem(cfg, other))
    a_run(tmp_path / "asked", "overwrite=true", steps=23)
    assert "overwrite=true" not in resumed_overrides([f"resume={tmp_path / 'asked'}"])  # it would lose its checkpoints


def test_a_job_of_a_sweep_replaces_itself_alone(tmp_path, capsys):
    out = a_run(tmp_path / "run", steps=23)
    assert run_job(composed(()), out, lambda: 25.0) == 25.0  # unfinished: the same command runs it again
    before = contents(out)
    with pytest.raises(SystemExit) as ended:
        run_job(composed(["sparsify=paper"]), out, lambda: pytest.fail("it trained"))
    assert ended.value.code == 2
    assert "holds another run (streetgs, seed 0)" in capsys.readouterr().err
    assert contents(out) == before  # no failed.json either, which would take the record out of reports
    assert run_job(composed(["sparsify=paper", "overwrite=true"]), out, lambda: 26.0) == 26.0


def test_a_job_that_another_process_is_at_is_left_to_it(tmp_path, caplog):
    """Without a word in its folder, which would take that run out of reports."""

    def trains() -> float:
        with sole_writer(tmp_path):
            return 25.0

    with sole_writer(tmp_path):
        assert math.isnan(there(run_job(composed(()), tmp_path, trains)))
        assert [path.name for path in tmp_path.iterdir()] == [".lock"]
    assert "is being written by process" in caplog.text


@pytest.fixture
def within_hydra(monkeypatch):
    """As within its app."""
    cfg = OmegaConf.create({"hydra": {"overrides": {"task": ["seed=1"]}, "runtime": {"cwd": "/here"}}})
    monkeypatch.setattr(folder.HydraConfig, "instance", lambda: type("Hydra", (), {"cfg": cfg}))
    monkeypatch.setattr(folder.HydraConfig, "get", lambda: cfg.hydra)


@pytest.mark.usefixtures("within_hydra")
def test_nothing_of_a_replaced_run_stays_beside_the_new_one(tmp_path, monkeypatch):
    out = a_run(tmp_path / "run")
    for name in ("records", "pictures", "curves", "predictions"):
        (out / name).mkdir(exist_ok=True)
        (out / name / "old").touch()
    (out / "notes.txt").touch()
    monkeypatch.setenv("SEED_OF_RUN", "1")
    take_folder(composed(["overwrite=true", "seed='${oc.decode:${oc.env:SEED_OF_RUN}}'"]), out, goes_on=False)
    assert not [name for name in OF_A_RUN if (out / name).exists()]
    assert (out / "notes.txt").is_file()
    config, hydra, overrides = (
        OmegaConf.load(out / f".hydra/{name}.yaml") for name in ("config", "hydra", "overrides")
    )
    assert isinstance(config, DictConfig)
    assert config.seed == 1
    assert "out: outputs/${now:" in (out / ".hydra/config.yaml").read_text()  # as it was composed
    assert hydra.hydra.runtime.cwd == "/here"
    assert overrides == ["seed=1"]


@pytest.mark.usefixtures("within_hydra")
@pytest.mark.parametrize("name", ["predictions", ".hydra", "train.log"])
def test_nothing_is_written_or_removed_through_a_link(name, tmp_path, capsys):
    """By training, going on and evaluation: a run may come from anybody."""
    out, victim = a_run(tmp_path / "run", steps=23), tmp_path / "victim"
    victim.mkdir()
    (victim / "config.yaml").write_text((out / ".hydra/config.yaml").read_text())
    (victim / "001_0.png").touch()
    before = contents(victim)
    if name == ".hydra":
        shutil.rmtree(out / name)
    (out / name).symlink_to(victim)
    said = f"{out / name} is a link out of the run's folder"
    assert said in there(folder_problem(composed(["overwrite=true"]), out))
    with pytest.raises(OSError, match=f"{name} is a link out of the run's folder"):
        take_folder(composed(["overwrite=true", "seed=1"]), out, goes_on=False)
    with pytest.raises(OSError, match=f"{name} is a link out of the run's folder"):
        scene, options, data = Mock(spec=SceneGraph), Mock(spec=RenderOptions), Mock(spec=StreetData)
        evaluate(scene, options, data, out, device=torch.device("cpu"), command="", extra=ExtraMetrics())
    assert contents(victim) == before
    assert (out / "checkpoints/last.ckpt").is_file()


@pytest.mark.usefixtures("within_hydra")
@pytest.mark.parametrize("goes_on", [True, False])
def test_what_a_kill_left_half_written_goes(goes_on, tmp_path):
    out = a_run(tmp_path / "run", steps=23)
    (out / "pictures").mkdir()
    half = [
        out / "pictures/.effects.7995.tmp.png",
        out / ".scene.31.tmp.safetensors",
        out / "checkpoints/.last.9.tmp.ckpt",
    ]
    others = [out / ".notes.tmp", out / "a.7.tmp.png"]
    for path in (*half, *others):
        path.touch()
    take_folder(composed(["overwrite=true", "seed=1"]), out, goes_on=goes_on)
    assert not [path for path in half if path.exists()]
    assert all(path.exists() for path in others)


def test_a_start_that_failed_leaves_nothing_and_a_run_everything(tmp_path):
    failed, run = tmp_path / "failed", a_run(tmp_path / "run")
    (failed / ".hydra").mkdir(parents=True)
    (failed / "train.log").touch()
    (run / "train.log").touch()
    before = contents(run)
    for out in (failed, run, tmp_path / "absent"):
        leave_folder(out, "train.log")
    assert not failed.exists()
    assert contents(run) == before
