"""A run that begins with another's checkpoint ends with the bits of one that began at step 0."""

from collections.abc import Sequence
from pathlib import Path

import pytest
from hydra.types import RunMode
from omegaconf import OmegaConf

from sparsestreet.cli import branch
from sparsestreet.cli.branch import first_pruning, is_branch, moments_to_keep, trunk_of
from sparsestreet.cli.compose import override_problem, resolved
from sparsestreet.cli.train import train
from sparsestreet.records.configuration import Configuration, flat_config
from sparsestreet.records.costs import update_costs
from sparsestreet.records.run import BRANCH_OF, RUN, BranchOf
from sparsestreet.report.collect import collect
from sparsestreet.report.sweep import _branches
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
        ((*PAPER, "sparsify=importance"), PAPER, 0.94, False),
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
        (("sparsify=importance", "node.rigid.max_gaussians=900"), (), 0.5, False),
        (("sparsify=importance", "branch_points=[0.2]", "checkpoint_every=7", "reuse=false"), (), 0.5, True),
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


@pytest.mark.parametrize("moment", ["0.0", "1.0", "-0.5"])
def test_a_moment_lies_inside_the_run(moment):
    said = override_problem([f"branch_points=[0.5,{moment}]"])
    assert said == f"branch_points are fractions of the run, above 0 and below 1, got {moment}"


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


@pytest.fixture
def sweeps(tmp_path, monkeypatch) -> Path:
    """The folder of sweeps, with ``two`` under way."""
    asked = OmegaConf.create({"mode": RunMode.MULTIRUN, "sweep": {"dir": str(tmp_path / "two")}})
    monkeypatch.setattr(branch.HydraConfig, "get", lambda: asked)
    return tmp_path


@pytest.mark.parametrize(
    ("trunk", "run", "found"),
    [
        ({}, (), True),
        ({"ended": False}, (), False),
        ({"moments": ["0.8"]}, (), False),
        ({}, ("reuse=false",), False),
        ({}, ("overwrite=true",), False),
        ({}, ("seed=1",), False),
        ({}, ("budget.minutes=3",), False),
        ({}, ("trainer=ddp",), False),
        ({}, ("sparsify=none",), False),
    ],
    ids=["", "unfinished", "too late", "reuse=false", "overwrite", "seed", "minutes", "ddp", "plain"],
)
def test_the_trunk_of_a_job_is_found(sweeps, trunk, run, found):
    (left,) = kept(sweeps / "one" / "job", **trunk)
    words = run if "sparsify=none" in run else (*ARM, *run)
    assert trunk_of(configurations.composed(*words), sweeps / "two" / "job") == (left if found else None)


def test_the_latest_moment_comes_first_and_ones_own_folder_is_none(sweeps):
    (early,) = kept(sweeps / "one" / "early", moments=["0.5"])
    late = kept(sweeps / "two" / "late", moments=["0.65", "0.9"])
    out = sweeps / "two" / "job"
    kept(out, *ARM, moments=["0.7"])
    cfg = configurations.composed(*ARM)
    assert trunk_of(cfg, out) == late[0]
    (sweeps / "two" / "late" / ".hydra" / "config.yaml").write_text("a: [")
    assert trunk_of(cfg, out) == early


SHORT = ["schedule.max_steps=20", "trainer.val_check_interval=7", *TINY_RIGID]
LATE = ["sparsify=importance", "callback.pruning.at=[0.6,0.8]"]


@pytest.fixture(scope="module")
def sweep(tiny_street, tmp_path_factory) -> Path:
    """A plain run, then one that prunes."""
    folder = tmp_path_factory.mktemp("branches") / "sweep"
    assert train([*tiny_street, *SHORT, "branch_points=[0.6]", f"out={folder / 'none'}"]) == 0
    place = [f"hydra.sweep.dir={folder}", "hydra.sweep.subdir=${sparsify.name}"]
    assert train(["-m", *tiny_street, *SHORT, *LATE, *place]) == 0
    return folder


def test_a_job_begins_with_the_checkpoint_of_its_trunk_and_ends_as_if_it_had_not(sweep, tiny_street, tmp_path, capsys):
    assert BRANCH_OF.read(sweep / "importance") == BranchOf(run="../none", label="streetgs", moment=0.6)
    assert not BRANCH_OF.exists(sweep / "none")
    (note,) = _branches(collect([sweep]))
    assert note.endswith(": importance")
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


@pytest.mark.slow
def test_a_branch_may_be_named(sweep, tmp_path):
    checkpoint, out = sweep / "none" / "checkpoints" / "before_0.6.ckpt", tmp_path / "named"
    assert train([f"resume={checkpoint}", *LATE, f"out={out}"]) == 0
    assert_equal(sweep / "importance", out)
    assert curve(out) == curve(sweep / "importance")
    assert (out / BRANCH_OF.read(out).run).resolve() == sweep / "none"
