"""A run that begins with another's checkpoint ends with the bits of one that began at step 0."""

from collections.abc import Sequence
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from sparsestreet.cli.commands.train import train
from sparsestreet.cli.config.compose import resolved
from sparsestreet.cli.runs.folder import first_pruning, is_branch, moments_to_keep, start_from_trunk
from sparsestreet.records.configuration import Configuration, flat_config
from sparsestreet.records.costs import update_costs
from sparsestreet.records.run import RUN
from tests.cli import configurations
from tests.cli.conftest import TINY_RIGID
from tests.cli.test_resume import assert_equal, curve
from tests.typed import there


def flat(*words: str) -> Configuration:
    return flat_config(resolved(configurations.composed(*words)))


PAPER = ("schedule=paper", "preset=drivestudio_legacy", "capacity=paper", "method=omnire")
RULES = "schedule.removal_at=[0.4,0.6]"


@pytest.mark.parametrize(
    ("run", "trunk", "moment", "shared"),
    [
        ((*PAPER, "sparsify=importance"), PAPER, 0.93334, True),
        ((*PAPER, "sparsify=paper"), (*PAPER, "sparsify=masks"), 0.93334, True),
        ((*PAPER, "sparsify=paper"), PAPER, 0.1, False),
        # K_min is a matter of masks, where there are any.
        ((*PAPER, "experiment=table/global_pruning"), PAPER, 0.93334, True),
        ((*PAPER, "sparsify=masks", "node.background.min_gaussians=0"), (*PAPER, "sparsify=masks"), 0.5, False),
        (("experiment=rule/random", RULES), ("experiment=rule/opacity", "schedule.removal_at=[0.93334]"), 0.4, True),
        (("experiment=rule/random", RULES), ("experiment=rule/opacity", "schedule.removal_at=[0.93334]"), 0.6, False),
        (("experiment=rule/random", "schedule.removal_at=[0.93334]"), ("experiment=rule/opacity", RULES), 0.6, False),
        (("seed=1", "sparsify=importance"), (), 0.5, False),
        (("sparsify=importance", "schedule.max_steps=900"), (), 0.5, False),
        (("sparsify=importance", "branch_points=[0.2]", "checkpoint_every=7", "trunk=x"), (), 0.5, True),
    ],
)
def test_what_runs_have_in_common(run, trunk, moment, shared):
    assert is_branch(flat(*run), flat(*trunk), moment) is shared
    assert is_branch(flat(*trunk), flat(*run), moment) is shared


@pytest.mark.parametrize(
    ("words", "first", "kept"),
    [
        ((), float("inf"), (0.3, 0.6)),
        (("sparsify=importance",), 0.93334, (0.3, 0.6)),
        (("sparsify=removal", "schedule.removal_at=[0.6,0.7]"), 0.6, (0.3, 0.6)),
        (("sparsify=removal", "schedule.removal_at=[0.7,0.4]"), 0.4, (0.3,)),
        (("budget.minutes=3",), float("inf"), ()),
    ],
)
def test_a_run_keeps_what_its_own_pruning_has_not_touched(words, first, kept):
    cfg = configurations.composed(*words, "branch_points=[0.3,0.6]")
    assert first_pruning(flat_config(resolved(cfg))) == first
    assert moments_to_keep(cfg) == kept


ARM = ("sparsify=random", "callback.pruning.at=[0.7]")


def kept(out: Path, *words: str, moments: Sequence[str] = ("0.6",), ended: bool = True) -> list[Path]:
    """What a job of a sweep left: its configuration, checkpoints, and what it took."""
    cfg = configurations.composed(*words).copy()
    (out / ".hydra").mkdir(parents=True)
    OmegaConf.save(cfg, out / ".hydra" / "config.yaml")
    update_costs(out, wall_seconds=9.0 if ended else None, phases={"train": 9.0})
    (out / "checkpoints").mkdir()
    for name in ("last.ckpt", *(f"before_{moment}.ckpt" for moment in moments)):
        (out / "checkpoints" / name).touch()
    return [out / "checkpoints" / f"before_{moment}.ckpt" for moment in moments]


@pytest.mark.parametrize(
    ("left", "run", "found"),
    [
        ({}, (), True),
        ({"ended": False}, (), False),
        ({"moments": ["0.8"]}, (), False),
        ({}, ("trunk=null",), False),
        ({}, ("overwrite=true",), False),
        ({}, ("seed=1",), False),
        ({}, ("budget.minutes=3",), False),
        ({}, ("trainer=ddp",), False),
        ({}, ("sparsify=none",), False),
    ],
    ids=["", "unfinished", "too late", "none is named", "overwrite", "seed", "minutes", "ddp", "plain"],
)
def test_the_start_from_trunk_a_job_is_the_run_that_it_names(tmp_path, left, run, found):
    (checkpoint,) = kept(tmp_path / "one" / "job", **left)
    words = run if "sparsify=none" in run else (*ARM, *run)
    cfg = configurations.composed(f"trunk={tmp_path / 'one' / 'job'}", *words)
    assert start_from_trunk(cfg, tmp_path / "two" / "job") == (checkpoint if found else None)


def test_the_latest_moment_comes_first_and_ones_own_folder_is_none(tmp_path):
    early, late, _ = kept(tmp_path / "trunk", moments=["0.5", "0.65", "0.9"])
    cfg = configurations.composed(*ARM, f"trunk={tmp_path / 'trunk'}")
    assert start_from_trunk(cfg, tmp_path / "job") == late
    assert start_from_trunk(cfg, tmp_path / "trunk") is None
    late.unlink()
    assert start_from_trunk(cfg, tmp_path / "job") == early
    (tmp_path / "trunk" / ".hydra" / "config.yaml").write_text("a: [")
    assert start_from_trunk(cfg, tmp_path / "job") is None


SHORT = ["schedule.max_steps=20", "trainer.val_check_interval=7", *TINY_RIGID]
LATE = ["sparsify=importance", "callback.pruning.at=[0.6,0.8]"]


@pytest.fixture(scope="module")
def sweep(tiny_street, tmp_path_factory) -> Path:
    """A plain run, then one that prunes."""
    folder = tmp_path_factory.mktemp("branches") / "sweep"
    assert train([*tiny_street, *SHORT, "branch_points=[0.6]", f"out={folder / 'none'}"]) == 0
    place = [f"hydra.sweep.dir={folder}", "hydra.sweep.subdir=${sparsify.name}", "trunk='${folder}/../none'"]
    assert train(["-m", *tiny_street, *SHORT, *LATE, *place]) == 0
    return folder


@pytest.mark.slow
def test_a_job_begins_with_the_checkpoint_of_its_trunk_and_ends_as_if_it_had_not(sweep, tiny_street, tmp_path, capsys):
    assert "before_0.6.ckpt, with which it has all steps" in (sweep / "importance" / "train.log").read_text()
    whole = tmp_path / "whole"
    assert train([*tiny_street, *SHORT, *LATE, f"out={whole}"]) == 0
    assert_equal(whole, sweep / "importance")
    assert curve(whole) == curve(sweep / "importance")
    for name in ("records/counts.csv", "scene.safetensors"):
        assert (whole / name).read_bytes() == (sweep / "importance" / name).read_bytes(), name
    counts = (whole / "records/counts.csv").read_text()
    assert "\n12,background" in counts  # the pruning of the very step behind the checkpoint
    arm, trunk = RUN.read(sweep / "importance"), RUN.read(sweep / "none")
    assert arm.config_hash == RUN.read(whole).config_hash
    # What the trunk took until then is part of what the branch took.
    assert there(arm.training_seconds) > 0.3 * there(trunk.training_seconds)


@pytest.mark.slow
def test_a_branch_that_is_none_is_refused_and_touches_nothing(sweep, tmp_path, capsys):
    checkpoint = sweep / "none" / "checkpoints" / "before_0.6.ckpt"
    before = {path: path.stat().st_mtime_ns for path in sweep.rglob("*")}
    for words, said in (
        ([*LATE, f"out={sweep / 'none'}"], "a run goes on as it began, but"),
        (["sparsify=importance", "callback.pruning.at=[0.5]", f"out={tmp_path / 'early'}"], "callback.pruning"),
        (["sparsify=masks", f"out={tmp_path / 'masks'}"], "a run goes on as it began, but"),
    ):
        assert train([f"resume={checkpoint}", *words]) == 2
        assert said in capsys.readouterr().err
    assert {path: path.stat().st_mtime_ns for path in sweep.rglob("*")} == before
