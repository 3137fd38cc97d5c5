"""Sweeps: what composes, what is skipped, what fails and stands."""

import math

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from sparsestreet.cli.commands.jobs import count_jobs
from sparsestreet.cli.commands.train import train
from sparsestreet.cli.config.compose import CONF, as_typed
from sparsestreet.cli.config.validate import config_problem
from sparsestreet.cli.runs import sweep
from sparsestreet.cli.runs.jobs import JobComposer
from sparsestreet.cli.runs.sweep import (
    OF_DRIVES,
    as_sweep,
    finished,
    job_problem,
    run_job,
    sweep_problem,
    sweep_status,
    with_fixed_keys,
)
from sparsestreet.records.costs import update_costs
from sparsestreet.records.run import read_failures
from sparsestreet.records.summary import SUMMARY
from sparsestreet.report.paper import TABLES
from tests.cli import configurations
from tests.conftest import unchecked
from tests.evaluation.frames import make_summary
from tests.typed import there

SWEEPS = sorted(path.stem for path in (CONF / "sweep").glob("*.yaml"))
NEED_DRIVES = [name for name in SWEEPS if name.startswith(OF_DRIVES)]


def composed(*overrides: str) -> DictConfig:
    return configurations.composed_with_hydra(*overrides, folder="sweep/run")


def problem_of(cfg: DictConfig) -> str | None:
    """Without what only a running app knows."""
    return config_problem(OmegaConf.masked_copy(cfg, [str(key) for key in cfg if key != "hydra"]))


def jobs(name: str) -> list[list[str]]:
    """One job for each value of the sweep's first option."""
    params = composed(f"+sweep={name}").hydra.sweeper.params
    asked = OverridesParser.create().parse_overrides([f"{key}={value}" for key, value in params.items()])
    first, *others = (
        [f"{one.key_or_group}={value}" for value in one.sweep_string_iterator()]
        if one.is_sweep_override()
        else [there(one.input_line)]
        for one in asked
    )
    return [[value, *(values[-1] for values in others), f"+sweep={name}"] for value in first]


@pytest.fixture(scope="module")
def counted(tmp_path_factory) -> str:
    """The run that controls have their count from; a drive as well as any, by its number."""
    folder = tmp_path_factory.mktemp("counted") / "23"
    folder.mkdir()
    SUMMARY.write(folder, make_summary(gaussians={"background": 20_000, "rigid": 2000}))
    return str(folder)


def composed_jobs(name: str, counted: str, chosen: list[list[str]]) -> list[DictConfig]:
    drive = [f"data.root={counted}"] if name in NEED_DRIVES else []
    return [composed(*job, *drive, f"count_of={counted}") for job in chosen]


@pytest.mark.parametrize("name", ["claims", "drives_rules", "rules", "streets", "table5_ablation"])
def test_the_last_job_of_a_sweep_can_be(name, counted):
    with unchecked():
        (cfg,) = composed_jobs(name, counted, jobs(name)[-1:])
        assert problem_of(cfg) is None, cfg.name


@pytest.mark.slow
@pytest.mark.parametrize("name", SWEEPS)
def test_every_job_of_a_sweep_can_be(name, counted):
    with unchecked():
        for cfg in composed_jobs(name, counted, jobs(name)):
            assert problem_of(cfg) is None, cfg.name


@pytest.mark.slow
def test_the_rows_of_table_1_are_the_papers():
    """Its three sweeps write into one folder."""
    labels = []
    for name in ("table1_waymo_others", "table1_waymo", "table1_waymo_paper"):
        params, out = (sweeper := composed(f"+sweep={name}").hydra).sweeper.params, sweeper.sweep.dir
        assert out == "outputs/sweeps/table1_waymo"
        rest = [f"+sweep={name}", "data.root=/drives/172", f"sparsify={params.get('sparsify', 'none')}"]
        configurations = [composed(f"method={method}", *rest) for method in params.method.split(",")]
        labels += [cfg.name for cfg in configurations]
        # DriveStudio has no points from images.
        assert not any(cfg.image_points for cfg in configurations)
    of_objects = ["streetgs-drivestudio_legacy", "omnire-drivestudio_legacy"]
    others = ["3dgs-drivestudio", "deformgs-drivestudio", "pvg-drivestudio"]
    assert labels == [*others, *of_objects, *(f"{label}+paper" for label in of_objects)]


def test_global_pruning_of_table_3_is_global():
    """No floor holds it back; background pruning has the paper's of the background."""
    rest = ["+sweep=table3_pruning", "data.root=/drives/172", "method=omnire", "sparsify=importance"]
    arms = [
        composed(*rest, f"experiment={choice}") for choice in composed(*rest).hydra.sweeper.params.experiment.split(",")
    ]
    assert [arm.name for arm in arms] == [
        "omnire-drivestudio_legacy+importance",
        "omnire-drivestudio_legacy+global_pruning",
    ]
    background, everywhere = arms
    assert background.callback.pruning.rule.nodes == ["background"]
    assert background.node.background.min_gaussians == 40_000
    assert everywhere.callback.pruning.rule.nodes is None
    assert {name: node.min_gaussians for name, node in everywhere.node.items()} == dict.fromkeys(everywhere.node, 0)
    floors = [node.get("min_instance_gaussians", 0.0) for node in everywhere.node.values()]
    assert floors == [0.0] * 4
    told = [[all(word in arm.name for word in row.options) for arm in arms] for row in TABLES["table3_pruning"].rows]
    assert told == [[False, True], [True, False]]  # the report finds the published row of each
    # But for this, the arms are alike.
    rule = background.callback.pruning.rule
    assert OmegaConf.merge(rule, {"nodes": None}) == everywhere.callback.pruning.rule
    assert background.callback.pruning.at == everywhere.callback.pruning.at == [0.93334]


def test_a_control_keeps_what_the_other_run_ended_with(counted):
    capped = composed("sparsify=capped", f"count_of={counted}").node.background
    assert (capped.num_points, capped.max_gaussians) == (20_000, 20_000)
    rule = composed("sparsify=random", f"count_of={counted}").callback.pruning.rule
    assert rule.keep == {"background": 20_000, "rigid": 2000}
    assert composed("sparsify=random").callback.pruning.rule.keep == 0.5
    assert "that run has no record" in there(problem_of(composed("sparsify=opacity", f"count_of={counted}/nothing")))


def test_drives_must_be_named_and_there(tmp_path):
    assert "give their folders, data.root=DIR,DIR" in there(sweep_problem(["+sweep=table1_waymo"]))
    absent = sweep_problem(["+sweep=table1_waymo", f"data.root={tmp_path},{tmp_path}/no"])
    assert f"{tmp_path}/no, which is no folder" in there(absent)
    assert sweep_problem(["+sweep=table1_waymo", f"data.root={tmp_path}"]) is None
    assert sweep_problem(["+sweep=streets"]) is sweep_problem(["seed=1"]) is None


def test_a_named_sweep_is_one_without_its_flag():
    assert as_sweep(["+sweep=tiny"]) == ["-m", "+sweep=tiny"]
    for asked in (["seed=1"], ["-m", "+sweep=tiny"], ["+sweep=tiny", "--cfg", "job"], ["+sweep=tiny", "--cfg=job"]):
        assert as_sweep(asked) == asked


@pytest.mark.parametrize(
    ("change", "steps", "done"),
    [
        ({}, 60, 25.0),
        ({"seed": 1}, 60, None),
        ({"data.root": "/drives/2"}, 60, None),
        ({"data.log.width": 480}, 60, None),
        ({}, 59, None),
    ],
    ids=["itself", "another seed", "another drive", "another option", "interrupted"],
)
def test_a_job_is_done_where_its_folder_holds_its_complete_record(tmp_path, change, steps, done):
    summary = make_summary("plain", 0, 25.0, config={"data.root": "/drives/1"}, steps=steps)
    SUMMARY.write(tmp_path, summary)
    update_costs(tmp_path, wall_seconds=1.0, phases={"train": 1.0})
    asked = OmegaConf.create()
    for key, value in (summary.run.config | change).items():
        OmegaConf.update(asked, key, value, force_add=True)
    assert finished(asked, tmp_path) == done
    assert finished(asked, tmp_path / "elsewhere") is None
    update_costs(tmp_path, wall_seconds=None)  # killed while it was measured
    assert finished(asked, tmp_path) is None


def test_a_failure_stands_until_its_job_succeeds(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sweep.SweepFolder, "folder", tmp_path)
    monkeypatch.setattr(sweep.HydraConfig, "get", lambda: OmegaConf.create({"overrides": {"task": ["seed=3"]}}))
    cfg, out = OmegaConf.create({"name": "plain", "seed": 3}), tmp_path / "plain_seed3"

    def fails() -> float:
        raise ValueError("no room")

    assert math.isnan(there(run_job(cfg, out, fails)))
    ((folder, failure),) = read_failures(tmp_path)
    assert (folder, failure.label, failure.seed, failure.error) == (out, "plain", 3, "no room")
    assert sweep_status() == 1
    assert f"{out} failed: no room" in capsys.readouterr().err
    assert run_job(cfg, out, lambda: 25.0) == 25.0
    assert read_failures(tmp_path) == []
    assert sweep_status() == 0


def test_a_slip_in_a_sweep_is_one_line(capsys):
    assert train(["+sweep=tony"]) == 2
    assert f"no option 'tony' in conf/sweep: choose one of {', '.join(SWEEPS)}" in capsys.readouterr().err


def test_arms_that_differ_have_folders_that_say_so():
    """The groups and values that the sweep varies, and nothing that all jobs share or the label tells."""
    asked = ["-m", "sparsify=paper_short,importance", "pruning@callback.pruning.rule=importance,removal", "seed=0,1",
             "schedule.max_steps=40", "loss.depth.weight=0.5,1"]  # fmt: skip
    fixed = with_fixed_keys(asked)[-1]
    job = ["sparsify=paper_short", "pruning@callback.pruning.rule=removal", "seed=1", "schedule.max_steps=40"]
    cfg = composed(*job, "loss.depth.weight=0.5", fixed, "hydra.job.num=3")
    assert cfg.hydra.sweep.subdir == "3_streetgs+paper_short_pruning=removal_weight=0.5_seed1"
    assert with_fixed_keys(asked[1:]) == asked[1:]


def test_a_job_that_cannot_be_ends_a_sweep_before_its_first_training(capsys):
    """The first arm is good, the second has a degree that is none; controls wait for the runs that they count."""
    asked = ["-m", "seed=0,1", "node.background.sh_degree=3,many"]
    assert train(asked) == 2
    said = capsys.readouterr().err
    assert "job 2 of 4 (seed=0 node.background.sh_degree=many): " in said
    assert "node.background.sh_degree must be int, got 'many'; nothing was trained" in said
    assert job_problem(["-m", "sparsify=removal,random", "count_of=of/nothing"]) is None
    assert job_problem(["sparsify=none"]) is None


@pytest.mark.lengthy
def test_drives_of_a_file_are_counted_as_if_each_were_composed(tmp_path, monkeypatch):
    """Jobs that differ in drive and seed are composed once; the second drive has no window, so it shares nothing."""
    names = ["23", "a drive, with a comma", "114"]
    (tmp_path / "drives.txt").write_text(f"{tmp_path / names[0]}  # the first\n\n" + "\n".join(
        str(tmp_path / name) for name in names[1:]
    ))  # fmt: skip
    words = as_typed([f"data.root=@{tmp_path / 'drives.txt'}", "seed=0,1"])
    found = count_jobs(["table3_pruning"], words)
    monkeypatch.setattr(JobComposer, "_like", lambda *_: None)
    assert found == count_jobs(["table3_pruning"], words)
    (counted,) = found
    # Of two drives and seeds the second arm begins at 0.93334 of the first.
    assert (counted.jobs, counted.shared) == (12, pytest.approx(4 * 0.93334))
    assert as_typed(["data.root=@nothing"]) == ["data.root=@nothing"]  # no file: it is no folder either
