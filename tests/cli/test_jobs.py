"""What sweeps cost before they start, how their jobs are dealt into shards, and what finished jobs give back."""

import re
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import DictConfig

from sparsestreet.cli.commands import train as command
from sparsestreet.cli.commands.jobs import count_jobs
from sparsestreet.cli.commands.jobs import jobs as jobs_command
from sparsestreet.cli.commands.train import train
from sparsestreet.cli.config.compose import resolved
from sparsestreet.cli.runs import jobs as of_jobs
from sparsestreet.cli.runs.costs import Assumptions, kind_of
from sparsestreet.cli.runs.folder import give_back, resumed_overrides
from sparsestreet.cli.runs.jobs import Job, SweepFolder, dealt, give_back_trunks, trunks_done
from sparsestreet.records.configuration import flat_config
from sparsestreet.records.costs import update_costs
from sparsestreet.records.run import RUN
from tests.cli import configurations
from tests.cli.conftest import TINY_RIGID
from tests.evaluation.frames import make_run
from tests.typed import there

STEPS = "schedule.max_steps=4000"
TRUNK = ("branch_points=[0.25]", "trunk='${folder}/../streetgs_seed${seed}'")
ARMS = (STEPS, *TRUNK, "hydra.sweep.subdir='${name}_seed${seed}'", "sparsify=none,importance", "seed=0,1")


def finished_run(folder: Path, *words: str, seconds: dict[str, float], megabytes: float, steps: int, **run) -> None:
    """A record of a run of these options; its files take 1,000 bytes, its checkpoint 7,000."""
    config = flat_config(resolved(configurations.composed(*words)))
    RUN.write(folder, replace(make_run("streetgs", config=config, **run), steps=steps, max_steps=steps))
    update_costs(folder, wall_seconds=sum(seconds.values()), phases=seconds, peak_host_mb=megabytes)
    left = 1000 - sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    if left > 0:
        (folder / "pictures").mkdir()
        (folder / "pictures" / "sheet.png").write_bytes(bytes(left))
    (folder / "checkpoints").mkdir()
    (folder / "checkpoints" / "last.ckpt").write_bytes(bytes(7000))


@pytest.mark.lengthy
def test_hours_memory_and_disk_follow_two_runs_by_hand(tmp_path, capsys):
    """A run of 1,000 steps (80 s of them with its steps), and one of 2,000 (200 s); four that are not like a job."""
    first = {"start": 15.0, "train": 60.0, "validate": 10.0, "save": 10.0, "evaluate": 5.0}
    second = {"data": 50.0, "train": 190.0, "validate": 6.0, "save": 4.0}
    wrong = {"train": 1e7}
    finished_run(tmp_path / "a", "schedule.max_steps=1000", "seed=7", seconds=first, megabytes=500.0, steps=1000)
    finished_run(tmp_path / "x/b", "schedule.max_steps=2000", seconds=second, megabytes=700.0, steps=2000)
    for name, word in (
        ("size", "data.log.settings.width=96"),
        ("limits", "node.background.max_gaussians=77"),
        ("device", "trainer=gpu"),
        ("method", "method=3dgs"),
    ):
        finished_run(tmp_path / name, word, seconds=wrong, megabytes=9e6, steps=1000)
    disk = [
        sum(path.stat().st_size for path in (tmp_path / name).rglob("*") if path.is_file()) for name in ("a", "x/b")
    ]
    words = [*ARMS, f"hydra.sweep.dir={tmp_path / 'sweep'}"]
    (found,) = count_jobs(["-m"], words, Assumptions(measured=tmp_path, devices=2))
    # Whole: 20 + 80 x 4 and 50 + 200 x 2 seconds; without the first quarter of the steps 20 + 240 and 50 + 300.
    whole, branch = (340 + 450) / 2, (260 + 350) / 2
    assert (found.jobs, found.finished, found.shared) == (4, 0, 0.5)
    assert there(found.hours) == pytest.approx(2 * (whole + branch) / 3600, rel=1e-12)
    assert there(found.longest) == pytest.approx((whole + branch) / 3600, rel=1e-12)
    assert found.memory == 700e6
    assert there(found.disk) == pytest.approx(4 * (sum(disk) - 2 * 7000) / 2)
    assert jobs_command(["-m", *words, f"measured={tmp_path}", "devices=3"]) == 0
    said = capsys.readouterr().out
    assert "measured on finished runs of its label (cpu: test)" in said
    assert "measured on finished runs of its method (cpu: test)" in said
    assert re.search(r"-m +4 +0 +4 +3\.5 +0\.389 +0\.194 +0\.7 ", said)


OF_A_STEP = 3 * 236 + 44 + 24 + 68 + 3.3 * 15 + (236 + 48 + 3.3 * 48)
"""Bytes a Gaussian of 59 numbers: three copies, what is drawn, statistics, one view, and gradients of its splats."""


@pytest.mark.lengthy
def test_what_is_counted_names_what_it_assumes(capsys):
    said = Assumptions(gaussians=2_000_000, image="960x640", ms_per_step=20.0, devices=8)
    (found,) = count_jobs(["table1_waymo"], ["data.root=/d/23,/d/114,/d/327"], said)
    # Three drives, three seeds, two methods, two splits; no two need each other: the longest shard has five.
    assert found.jobs == 36
    assert found.hours == pytest.approx(36 * 30_000 * 0.020 / 3600)
    assert found.longest == pytest.approx(5 * 30_000 * 0.020 / 3600)
    assert found.memory == pytest.approx(2e6 * OF_A_STEP + 110 * 960 * 640)
    assert found.disk == 36 * 2e6 * 236
    # Without limits of Gaussians, and without a rate, nothing is known of a table.
    assert jobs_command(["+sweep=table1_waymo", "data.root=/d/23", "seed=0"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert re.search(r"table1_waymo +4 +0 +4 +4\.0 +- +- +-", lines[-4])
    assert "hours of 4 jobs: unknown" in lines[-3]
    assert "measured=DIR, or ms_per_step=N" in lines[-3]
    assert "gaussians=N with image=WIDTHxHEIGHT" in lines[-2]


def test_the_kind_of_a_job_knows_what_follows_from_the_log():
    kind = kind_of(configurations.composed("method=pvg"))
    # Short runs: steps and limits grow with the images. PVG's Gaussians have five numbers more.
    assert (kind.steps, kind.limits, kind.unlimited, kind.row_bytes) == (None, (), ("background",), 4 * 64)
    said = configurations.composed("method=pvg", "node.background.max_gaussians=9000", "schedule.max_steps=70")
    kind = kind_of(said)
    assert (kind.steps, kind.limits, kind.unlimited) == (70, (("background", 9000),), ())
    assert kind_of(configurations.composed("budget.minutes=3", "schedule.max_steps=70")).steps is None


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["sparsify=none"], "sparsestreet jobs +sweep=NAME"),
        (["-m", "seed=0,1", "devices=0"], "devices must be above 0, got 0"),
        (["-m", "seed=0,1", "image=960"], "image must be WIDTHxHEIGHT, such as 960x640, got '960'"),
        (["-m", "seed=0,1", "measured=/no/where"], "measured=/no/where is no folder"),
        (["-m", "seed=0,1", "gaussian=3"], "no key 'gaussian'"),
    ],
)
def test_a_slip_is_one_line(words, said, capsys):
    assert jobs_command(words) == 2
    out, err = capsys.readouterr()
    assert said in out + err


KIND = kind_of(configurations.composed())


def planted(number: int, trunk: int | None = None, counted: int | None = None, folder: Path = Path("s")) -> Job:
    places = {"trunk": trunk, "counted": counted}
    needs = {name: None if one is None else folder / str(one) for name, one in places.items()}
    own = {"out": folder / str(number), "within": str(number)}
    return Job(words=(), prefix=(), first=0.0, keeps=(), kept=False, done=False, kind=KIND, **own, **needs)  # pyright: ignore[reportArgumentType]


def test_seven_jobs_in_three_shards():
    """4 begins with 1, and 6 counts 4: they go where 1 goes. 5 names a run of another sweep, 3 itself."""
    jobs = [
        *map(planted, (0, 1, 2)),
        planted(3, trunk=3),
        planted(4, trunk=1),
        planted(5, trunk=99),
        planted(6, counted=4),
    ]
    numbers = [[job.within for job in shard] for shard in dealt(jobs, 3)]
    assert numbers == [["0", "3"], ["1", "4", "5", "6"], ["2"]]
    # A trunk that comes later draws its branch along, and one shard or more than there are jobs do.
    late = [planted(0, trunk=2), planted(1), planted(2)]
    assert [[job.within for job in shard] for shard in dealt(late, 4)] == [["0", "2"], ["1"], [], []]
    assert dealt(late, 1) == [late]


@given(
    st.lists(st.tuples(st.none() | st.integers(0, 12), st.none() | st.integers(0, 12)), max_size=12), st.integers(1, 9)
)
def test_shards_are_disjoint_complete_and_keep_together_what_needs_each_other(needs, count):
    jobs = [planted(number, *of) for number, of in enumerate(needs)]
    shards = dealt(jobs, count)
    place = {job.out: index for index, shard in enumerate(shards) for job in shard}
    assert len(shards) == count
    assert sum(map(len, shards)) == len(place) == len(jobs)
    for job in jobs:
        assert {place.get(one, place[job.out]) for one in (job.trunk, job.counted) if one} <= {place[job.out]}
    assert all([int(job.within) for job in shard] == sorted(int(job.within) for job in shard) for shard in shards)


@pytest.mark.lengthy
def test_each_job_of_a_sweep_is_in_one_shard_and_has_the_folder_that_it_has_in_the_whole(tmp_path, monkeypatch, capsys):
    begun: list[list[str]] = []
    monkeypatch.setattr(command, "app", lambda: begun.append(sys.argv[1:]))
    folder = f"hydra.sweep.dir='{tmp_path}/a sweep, of seven'"
    for number, seeds in ((1, 3), (2, 2), (3, 2)):
        assert train(["-m", "seed=0,1,2,3,4,5,6", folder, f"shard={number}/3"]) == 0
        assert f"shard {number} of 3 has {seeds} of 7 jobs" in capsys.readouterr().err
    # Without hydra.job.num, which counts within a shard.
    dealt_seeds = (0, 3, 6, 1, 4, 2, 5)
    assert [words[-1] for words in begun] == [f"hydra.sweep.subdir={seed}_streetgs_seed{seed}" for seed in dealt_seeds]
    for seed, words in zip(dealt_seeds, begun, strict=True):
        assert {"-m", folder, f"seed={seed}"} <= set(words)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["-m", "seed=0,1", "shard=0/3"], "shard=0/3 is none: give shard=K/N with 1 <= K <= N"),
        (["-m", "seed=0,1", "shard=4/3"], "shard=4/3 is none"),
        (["-m", "seed=0,1", "shard=a"], "shard=a is none: give shard=K/N, such as shard=3/16"),
        (["seed=0", "shard=1/2"], "shard=K/N takes jobs of a sweep"),
        (["-m", "seed=0,1", "shard=1/2", "hydra/launcher=joblib"], "leave out the launcher, or shard=K/N"),
        (["-m", "seed=0,1", "shard=1/2"], "give hydra.sweep.dir=DIR"),
    ],
)
def test_a_shard_that_cannot_be_is_one_line(words, said, capsys):
    assert train(words) == 2
    assert said in capsys.readouterr().err


def left(out: Path, ended: bool = True, names=("last", "before_0.25", "before_0.6")) -> list[Path]:
    """A run's costs and checkpoints."""
    update_costs(out, wall_seconds=9.0 if ended else None, phases={"train": 9.0})
    (out / "checkpoints").mkdir()
    for name in names:
        (out / "checkpoints" / f"{name}.ckpt").write_bytes(bytes(3))
    return list((out / "checkpoints").iterdir())


@pytest.mark.parametrize(
    ("cfg", "of_sweep", "ended", "stay"),
    [
        ({}, False, True, {"before_0.25", "before_0.6"}),
        ({}, True, True, set()),
        ({"trunk": "sweep/../run"}, True, True, {"before_0.25", "before_0.6"}),
        ({"trunk": "elsewhere"}, True, True, set()),
        ({}, True, False, {"last", "before_0.25", "before_0.6"}),
        ({"keep_checkpoints": True}, True, True, {"last", "before_0.25", "before_0.6"}),
    ],
    ids=["by hand", "sweep", "trunk", "branch", "unfinished", "kept"],
)
def test_a_finished_run_gives_back_what_no_run_needs(tmp_path, monkeypatch, cfg, of_sweep, ended, stay):
    monkeypatch.chdir(tmp_path)
    left(tmp_path / "run", ended)
    asked = DictConfig({"keep_checkpoints": False, "trunk": None} | cfg)
    for _ in range(2):  # once more, as where the sweep is given again
        give_back(asked, Path("run"), of_sweep=of_sweep)
        assert {path.stem for path in (tmp_path / "run" / "checkpoints").iterdir()} == stay


@pytest.mark.lengthy
def test_checkpoints_of_a_trunk_stay_until_all_its_branches_stand_finished(tmp_path, monkeypatch):
    """Of two seeds the second lacks a branch, at first."""
    monkeypatch.setattr(SweepFolder, "folder", tmp_path)
    words = ["-m", *ARMS, f"hydra.sweep.dir={tmp_path}"]
    trunks = [left(tmp_path / f"streetgs_seed{seed}", names=["before_0.25"])[0] for seed in (0, 1)]
    left(tmp_path / "streetgs+importance_seed0")
    left(tmp_path / "streetgs+importance_seed1", ended=False)
    give_back_trunks(words, None)
    assert [path.exists() for path in trunks] == [False, True]
    update_costs(tmp_path / "streetgs+importance_seed1", wall_seconds=9.0)
    give_back_trunks(words, None)
    assert not trunks[1].exists()
    monkeypatch.setattr(of_jobs, "trunks_done", lambda jobs: pytest.fail("it is no sweep, or names no trunk"))
    give_back_trunks(words[1:], None)
    give_back_trunks(["-m", "seed=0,1"], None)


def test_a_trunk_that_is_kept_unfinished_or_of_another_sweep_stays_as_it_is(tmp_path):
    trunk, branch, stranger = (planted(number, trunk=0, folder=tmp_path) for number in (0, 1, 2))
    for job in (trunk, branch):
        left(job.out)
    assert trunks_done([trunk, branch]) == [trunk.out]
    assert trunks_done([branch]) == trunks_done([trunk, branch, stranger]) == []
    assert trunks_done([replace(trunk, kept=True), branch]) == []
    update_costs(trunk.out, wall_seconds=None)
    assert trunks_done([replace(trunk, trunk=None), branch]) == []


def test_a_branch_of_a_finished_trunk_begins_with_what_is_there(tmp_path):
    trunk = replace(planted(0, folder=tmp_path), prefix=("a",), keeps=(0.25, 0.6), done=True)
    branch = replace(planted(1, trunk=0, folder=tmp_path), prefix=("a",), first=0.7)
    assert branch.begins(trunk) == 0.0
    assert branch.begins(replace(trunk, done=False)) == 0.6
    left(trunk.out, names=["before_0.25"])
    assert branch.begins(trunk) == 0.25


@pytest.mark.lengthy
def test_a_finished_run_without_its_checkpoint_is_not_gone_on_with(tmp_path):
    """Though a moment's checkpoint is there: a run would take its last steps again."""
    run = configurations.left_run(tmp_path / "run", "seed=3", config=configurations.composed())
    update_costs(run, wall_seconds=9.0, phases={"train": 9.0})
    assert "seed=3" in resumed_overrides([f"resume={run}"])
    (run / "checkpoints" / "last.ckpt").rename(run / "checkpoints" / "before_0.6.ckpt")
    with pytest.raises(FileNotFoundError, match="finished and gave its checkpoint back: sparsestreet evaluate run="):
        resumed_overrides([f"resume={run}"])
    assert "seed=3" in resumed_overrides([f"resume={run}/checkpoints/before_0.6.ckpt", "out=x"])


@pytest.mark.slow
def test_a_sweep_in_shards_ends_as_the_whole_and_leaves_no_checkpoint(tiny_street, tmp_path):
    """The second shard has no job."""
    words = ["-m", *tiny_street, *TINY_RIGID, "schedule.max_steps=20", *ARMS[1:-1], "seed=0"]
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert train([*words, f"hydra.sweep.dir={whole}"]) == 0
    for shard in ("shard=2/2", "shard=1/2"):
        assert train([*words, f"hydra.sweep.dir={parts}", "keep_checkpoints=false", shard]) == 0
        assert not list(parts.rglob("*.ckpt"))
    assert len(list(whole.rglob("last.ckpt"))) == 2
    for run in whole.glob("streetgs*"):
        assert (run / "scene.safetensors").read_bytes() == (parts / run.name / "scene.safetensors").read_bytes()
        branch = "importance" in run.name
        assert ("before_0.25.ckpt, with which" in (parts / run.name / "train.log").read_text()) is branch
