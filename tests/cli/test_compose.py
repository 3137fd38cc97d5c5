"""What the command line makes of words before Hydra sees them, and each slip in one line."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

import sparsestreet.training.run  # noqa: F401 - its import takes seconds, which are of no test
from sparsestreet.cli.commands.train import train
from sparsestreet.cli.config.compose import as_typed, composed, load_run_config, value_of
from sparsestreet.cli.config.validate import (
    LOGGER_PACKAGES,
    config_problem,
    limit_problem,
    override_problem,
    with_effect_keys,
)
from tests.typed import there


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["foo"], "'foo' is no override: write key=value"),
        (["+surprise=1"], "no key 'surprise'"),
        (["out=runs/seed=1"], "'out=runs/seed=1' cannot be read"),
        (["seed=0,1"], "seed=0,1 asks for several runs: add -m, or choose one"),
        (["folder=outputs/mine"], "give out=DIR"),
        (["data.log.min_lens_shift=0.5"], "no key 'data.log.min_lens_shift': it is 'effects.lens.min_shift' now"),
        (["nod.background.num_points=5"], "did you mean 'node.background.num_points'"),
        (
            ["sparsify=papr"],
            "no option 'papr' in conf/sparsify: choose one of capped, importance, maskgaussian, masks, mcmc",
        ),
        (["data/lidr=hdl64"], "did you mean 'data/lidar'"),
        (["data=drivestudio", "data/lidar=hdl64"], "no key 'data/lidar' with these choices: leave it out"),
        (["image_points=null"], "choose one of none, sift, swept"),
        (["methd=3dgs"], "did you mean 'method'? Its options are 3dgs, deformgs, omnire, pvg, streetgs"),
        (["experiment=row/3dgs"], "no option 'row/3dgs' in conf/experiment: choose one of one_schedule"),
        (["experiment=rule"], "experiment/rule holds several options: choose one of importance, lightgaussian"),
        (["density=gradient"], "did you mean density@node.background.density or density@node.rigid.density? Its opt"),
        (["render=fast"], "set one of render.backend, render.replay, render.preset, render.settings"),
        (["trainer.max_step=5"], "did you mean 'schedule.max_steps'?"),  # which that one follows
        (["steps=60"], "did you mean 'schedule.max_steps'?"),
        (["llr=0.1"], "no key 'llr'; sparsestreet train --cfg job prints all"),
        (["weight=1"], "loss.photometric.weight, loss.sky.weight or loss.depth.weight?"),
        (["schedule.lambda_m=3"], "has no effect with sparsify=none: choose sparsify=maskgaussian, masks"),
        (["sparsify=paper", "loss.mask_sparsity.weigh=0.2"], "did you mean 'loss.mask_sparsity.weight'?"),
        (["hydra/launcher=ray"], "pip install hydra-ray-launcher"),
    ],
)
def test_a_slip_is_one_line_that_says_what_was_meant(overrides, said):
    problem = override_problem(overrides)
    assert said in problem
    assert len(problem.splitlines()) == 1


def changed(*assignments: str) -> DictConfig:
    """A copy of the default configuration with other values, which is not composed anew."""
    cfg = composed(()).copy()
    for text in assignments:
        key, _, value = text.partition("=")
        OmegaConf.update(cfg, key, yaml.safe_load(value), force_add=True)
    return cfg


@pytest.mark.parametrize(
    ("assignment", "said"),
    [
        ("schedule.max_steps=0", "schedule.max_steps must be a whole number, 1 or more, got 0"),
        ("schedule.max_steps=abc", "schedule.max_steps must be a whole number, 1 or more, got 'abc'"),
        ("schedule.max_steps=true", "schedule.max_steps must be a whole number, 1 or more, got True"),
        ("seed=4294967296", "seed must be a whole number, 0 to 4294967295, got 4294967296"),
        ("branch_points=[0.5,1.0]", "branch_points are fractions of the run, above 0 and below 1, got 1.0"),
        ("trainer.max_steps=60", "of 2,000 steps says: give schedule.max_steps=60, or trainer.fast_dev_run=60 to try"),
        ("logger._target_=a.TensorBoardLogger", "pip install 'sparsestreet[nosuch]', or choose logger=csv"),
    ],
)
def test_numbers_out_of_their_limits_are_found_before_torch_is_imported(assignment, said, monkeypatch):
    monkeypatch.setitem(LOGGER_PACKAGES, "TensorBoardLogger", ("nosuch",))  # here, whatever is installed
    problem = there(limit_problem(changed(assignment)))
    assert said in problem
    assert len(problem.splitlines()) == 1
    assert config_problem(changed(assignment)) == problem  # of a job of a sweep


def test_the_first_checks_import_no_torch():
    code = (
        "import sys; from sparsestreet.cli.commands.train import train; status = train(['schedule.max_steps=0'])\n"
        "assert status == 2 and not {'torch', 'lightning'} & set(sys.modules), status"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("-m seed=0,1 --cfg job", "--cfg and --info show one configuration: leave out -m"),
        ("--multirun --info=all", "--cfg and --info show one configuration: leave out -m"),
        ("--resolve", "--resolve changes what --cfg prints: write --cfg job --resolve"),
        ("--resolve --info", "--resolve changes what --cfg prints: write --cfg job --resolve"),
        ("-p loss", "-p changes what --cfg prints: write --cfg job -p loss"),
        ("--max_steps 60", "no flag, and there is no key 'max_steps'; did you mean 'schedule.max_steps'?"),
        ("--seed=3", "--seed is no flag: write seed=VALUE"),
    ],
)
def test_flags_that_cannot_be_are_one_line(arguments, said, capsys):
    """Those of Hydra were a traceback, a page of usage, or a training of two thousand steps (-p)."""
    assert train(arguments.split()) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("sparsestreet train: ")
    assert line.endswith(said)


@pytest.mark.parametrize(
    ("assignment", "said"),
    [
        ("node.background.num_points=many", "node.background.num_points must be int, got 'many'"),
        ("node.background.sources.images.order=any", "sources.images.order must be Literal"),
        ("node.background.learning_rates.means.initial=[1]", "learning_rates.means.initial must be float"),
        ("node.rigid.learning_rates.means.inital=1", "no key 'node.rigid.learning_rates.means.inital': LearningRate"),
        ("node.background.density.split_scale=${node.background.cycle}", "density.split_scale follows from"),
        ("effects.sky=none", "effects.sky has keys of its own, got 'none': set one of them, or say ~effects.sky"),
        ("loss.sky.weight=true", "loss.sky.weight must be float, got True"),
        ("node.rigid.classes=Car", "node.rigid.classes must be"),
        ("data.log.settings.lens=[a,0.1,0,0,0,0,0,0,0,0,0,0,0,0,0,0,0,0,0]", "data.log.settings.lens must be"),
        ("data.lidar=hdl64", "data.log.settings.lidar must be LidarSensor, got 'hdl64'"),
        ("data.log.root=???", "data.log.root has no value: give data.log.root=..."),
        ("trainer.devices=2", "training runs on one device, got trainer.devices=2"),
        (
            "loss.sky._target_=mypaper.Loss",
            "loss.sky._target_: there is no module mypaper; is its folder in PYTHONPATH?",
        ),
        ("loss.sky._target_=tests.cli.toy.Kite", "loss.sky._target_ names tests.cli.toy.Kite, which cannot be"),
        ("node.background.max_gaussians=null", None),
        ("loss.sky.weight=1", None),
    ],
)
def test_a_value_that_cannot_be_is_found_before_any_data_is_read(assignment, said):
    problem = config_problem(changed(assignment))
    assert problem == said if said is None else said in there(problem)


def test_flags_may_stand_between_overrides(capsys):
    assert train(["seed=3", "--cfg", "job", "checkpoint_every=5"]) == 0
    shown = capsys.readouterr().out
    assert "seed: 3\n" in shown
    assert "checkpoint_every: 5\n" in shown


def test_the_whole_configuration_can_be_shown_resolved(capsys):
    """With the run's folder, which no app knows yet, and lists that follow from others; what cannot be is one line."""
    assert train(["seed=3", "--cfg", "job", "--resolve", "out=runs/a", "method=omnire"]) == 0
    shown = OmegaConf.create(capsys.readouterr().out)
    assert (shown.seed, shown.folder, shown.node.smpl.classes) == (3, "runs/a", ["Pedestrian"])
    assert shown.callback.row_ledger.path == "runs/a/records/counts.csv"
    assert train(["--cfg", "job", "--resolve", "sparsify=random", "count_of=/nowhere"]) == 2
    assert "that run has no record" in capsys.readouterr().err


def folder_of_the_log(run: Path, started: Path, *overrides: str) -> Path:
    """Where a run that was started in a folder is taken to have its log."""
    (run / ".hydra").mkdir(parents=True)
    OmegaConf.save(composed(overrides), run / ".hydra" / "config.yaml")
    OmegaConf.save({"hydra": {"runtime": {"cwd": str(started)}}}, run / ".hydra" / "hydra.yaml")
    return instantiate(load_run_config(run).data.log, _convert_="all").folder


def test_the_log_of_a_run_is_looked_for_where_the_run_had_it(tmp_path):
    recorded = ("data=drivestudio", "data.root=logs/7")
    assert folder_of_the_log(tmp_path / "a", tmp_path, *recorded) == tmp_path / "logs/7"
    assert folder_of_the_log(tmp_path / "b", tmp_path).parent == tmp_path / "outputs/streets"
    assert folder_of_the_log(tmp_path / "c", tmp_path, "data.log.root=mine") == tmp_path / "mine"
    assert folder_of_the_log(tmp_path / "d", tmp_path, "data.log.root=/mine") == Path("/mine")
    # Where the run came from elsewhere, the words are all there is.
    assert folder_of_the_log(tmp_path / "e", tmp_path / "gone", *recorded) == Path("logs/7")


PATHS = ("/l/ö", "/l/a,b", "/l/it's", "/l/50%&#x", "/l/[x]", "l\\b'c\\", '日本/ä "q"', "123", "true", "/l/a ")
"""Folders as a shell hands them over: without its own quotes."""


@pytest.mark.parametrize("path", PATHS)
def test_a_path_is_taken_as_it_was_typed(path, monkeypatch):
    # A comma in a folder that is not there is a list without its -m.
    monkeypatch.setattr(Path, "exists", lambda self: True)
    (root, out) = as_typed([f"data.root={path}", f"out={path}"])
    assert (value_of(root), value_of(out)) == (path, path)
    assert as_typed([root]) == [root]


def test_lists_and_quotes_stay_as_they_were_typed(tmp_path):
    (tmp_path / "a,b").mkdir()
    words = [
        "-m",
        "data.root=x,y",
        "seed=0,1",
        "loss=[sky,depth]",
        "data.root='a, b'",
        "resume=null",
        "out=${x}",
        "schedule.max_steps=[1",
    ]
    assert as_typed(words) == words
    assert as_typed(["-m", f"data.root={tmp_path}/a,b"])[1] == f"data.root='{tmp_path}/a,b'"
    assert as_typed(["name=Röhrig"]) == ["name='Röhrig'"]


FILES = {
    "defaults: [paper_short, override /loss/mask_sparsity@loss: ramped]": (
        "sparsify/mine.yaml: 'override /loss/mask_sparsity' needs a group, and loss/mask_sparsity is an option: "
        "set loss.mask_sparsity.KEY in your file"
    ),
    "defaults: [paper_short, override /pruning@callback.pruning.rules: removal]": (
        "sparsify/mine.yaml: no key 'pruning@callback.pruning.rules'; did you mean pruning@callback.pruning.rule?"
    ),
    "defaults: [paper_short]\nschedul: {max_steps: 3}": "sparsify/mine.yaml: no key 'schedul'; did you mean",
}
"""What stands in a file of the user's -> what is said."""


@pytest.mark.parametrize("text", FILES)
def test_what_is_wrong_in_a_file_names_the_file(text, tmp_path):
    (tmp_path / "sparsify").mkdir()
    (tmp_path / "sparsify" / "mine.yaml").write_text(f"# @package _global_\n{text}\n")
    said = there(override_problem([f"hydra.searchpath=[{tmp_path}]", "sparsify=mine"]))
    assert said.startswith(FILES[text])
    assert "mine.yaml" in said
    assert "\n" not in said


@pytest.mark.parametrize(
    ("typed", "written"),
    [
        ("effects.lens=on", "effects.lens.when=on"),
        ("effects.sky=off,auto", "effects.sky.when=off,auto"),
        # What has another meaning stays.
        ("effects.sky.resolution=8", "effects.sky.resolution=8"),
        ("effects=[sky]", "effects=[sky]"),
        ("moved_views=none", "moved_views=none"),
        ("-m", "-m"),
    ],
)
def test_one_effect(typed: str, written: str):
    assert with_effect_keys(["seed=1", typed]) == ["seed=1", written]


def test_all_effects_at_once():
    names = list(composed(())["effects"])
    assert with_effect_keys(["effects=off"]) == [f"effects.{name}.when=off" for name in names]
    off = composed(tuple(with_effect_keys(["effects=off"])))
    assert {one.when for one in off.effects.values()} == {"off"}


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["schedule.max_step=5"], "schedule.max_steps"),
        (["resume=/nowhere/at/all"], "there is nothing"),
        (["--experimental-rerun=run/.hydra/config.pickle"], "--experimental-rerun is no flag"),
        (["out=/proc/nope/run"], "/proc/nope/run cannot be written ("),
        ([f"out=/tmp/{'x' * 300}"], "cannot be written (File name too long): name another place"),
    ],
)
def test_a_slip_is_one_line_before_hydra_sees_it(overrides, said, tmp_path, capsys):
    assert train([f"out={tmp_path / 'run'}", *overrides]) == 2
    written = capsys.readouterr().err
    assert said in written
    assert written.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_a_log_that_cannot_be_read_is_one_line(tmp_path, capsys):
    """It is found inside of Hydra, whose report of an error must not be seen."""
    with pytest.raises(SystemExit) as ended:
        train(["data=drivestudio", "data.root=/nowhere/at/all", f"out={tmp_path / 'run'}"])
    assert ended.value.code == 1
    written = capsys.readouterr().err
    assert "/nowhere/at/all" in written
    assert "Traceback" not in written
    assert "Error in call" not in written
    assert not (tmp_path / "run").exists()


def test_where_memory_does_not_do_it_is_one_line(tmp_path, capsys, monkeypatch):
    def out_of_memory(*told):
        raise torch.OutOfMemoryError("CUDA out of memory.\nTried to allocate 2.00 GiB")

    monkeypatch.setattr("sparsestreet.cli.runs.run.run", out_of_memory)
    with pytest.raises(SystemExit) as ended:
        train([f"out={tmp_path / 'run'}"])
    assert ended.value.code == 1
    assert capsys.readouterr().err.splitlines() == [
        "sparsestreet train: memory is out (CUDA out of memory. Tried to allocate 2.00 GiB): ask for smaller images or "
        "fewer Gaussians"
    ]
