"""What the command line makes of overrides before Hydra sees them."""

import subprocess
import sys
from pathlib import Path

import pytest
from hydra import compose
from hydra.utils import instantiate
from omegaconf import OmegaConf

import sparsestreet.training.run  # noqa: F401 - its import takes seconds, which are of no test
from sparsestreet.cli.commands.train import train
from sparsestreet.cli.config.compose import as_typed, composed, configuration, load_run_config, value_of
from sparsestreet.cli.config.validate import LOGGER_PACKAGES, config_problem, override_problem
from tests.typed import there


def test_the_same_overrides_are_composed_once():
    assert composed(["seed=1"]) is composed(("seed=1",)) is not composed(["seed=2"])


@pytest.mark.parametrize(
    ("words", "place"),
    [((), "outputs/points"), (("out=/there/run",), "/there/points"), (("image_points.cache=/mine",), "/mine")],
)
def test_points_of_images_lie_beside_the_folders_of_runs(words, place):
    assert composed(words).image_points.cache == place


@pytest.mark.parametrize("flags", [["--cfg", "job"], ["-c", "hydra"], ["--info", "defaults"], ["-m"]])
def test_flags_of_hydra_and_their_words_pass(flags):
    assert override_problem([*flags, "seed=1"]) is None


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["foo"], "'foo' is no override: write key=value"),
        (["trainer.fast_dev_runx=true"], "did you mean 'trainer.fast_dev_run'"),
        (["data.log.min_lens_shift=0.5"], "no key 'data.log.min_lens_shift': it is 'effects.lens.min_shift' now"),
        (["schedule.max_step=5"], "did you mean 'schedule.max_steps'"),
        (["capacity=huge"], "no option 'huge' in conf/capacity: choose one of paper, small"),
        (["nod.background.num_points=5"], "did you mean 'node.background.num_points'"),
        (
            ["sparsify=papr"],
            "no option 'papr' in conf/sparsify: choose one of capped, importance, maskgaussian, masks, mcmc",
        ),
        (["experimant=capped"], "did you mean 'experiment'"),
        (["data/lidar=hdl65"], "no option 'hdl65' in conf/data/lidar: choose one of hdl32, hdl64, ideal, waymo_top"),
        (["data/lidr=hdl64"], "did you mean 'data/lidar'"),
        (["data.lidar.dropot=0.1"], "did you mean 'data.lidar.dropout'"),
        (["data=drivestudio", "data/lidar=hdl64"], "no key 'data/lidar' with these choices: leave it out"),
        (["data=drivestudio", "data.lidar.noise=0.1"], "no key 'data.lidar.noise' with these choices: leave it out"),
        (["+surprise=1"], "no key 'surprise'"),
        (["seed=x"], "seed"),
        (["out=runs/seed=1"], "'out=runs/seed=1' cannot be read"),
        (
            ["node.background.mask.sparsity_weight=1e-3"],
            "has no effect with sparsify=none: choose sparsify=maskgaussian, masks",
        ),
        (["schedule.lambda_m=3"], "has no effect with sparsify=none"),
        (["effects=none"], "no option 'none' in conf/effects: choose one of affine, box_poses, camera_poses, "),
        (["image_points=null"], "choose one of none, sift"),
        (["node.background.sources.nera.part=0.1"], "did you mean 'node.background.sources.near.part'"),
        (["logger=null"], "choose one of csv, none"),
        (["methd=3dgs"], "did you mean 'method'? Its options are 3dgs, deformgs, omnire, pvg, streetgs"),
        (["experiment=row/3dgs"], "no option 'row/3dgs' in conf/experiment: choose one of one_schedule"),
        (
            ["sparsify=paper", "pruning@callback.pruning.rule=foo"],
            "in conf/pruning: choose one of importance",
        ),
        (["pruning@callback.pruning.rule=removal"], "with these choices: leave it out, or choose the option that has"),
        (["density@node.background.density=foo"], "no option 'foo' in conf/density: choose one of gradient, mcmc"),
        (["density=gradient"], "did you mean density@node.background.density or density@node.rigid.density? Its opt"),
        (["mask@node.rigd.mask=temporal"], "mask@node.rigid.mask? Its options are sampled, static, temporal"),
        (["render=fast"], "set one of render.backend, render.preset, render.settings"),
        (
            ["optimizer=visible_adam"],
            "largest_radius, optimizer.relative_length, optimizer.batch_rule, optimizer.visible_only",
        ),
        (["render=null"], "render is no choice but has keys of its own"),
        (["trainer.max_step=5"], "did you mean 'schedule.max_steps'?"),  # which that one follows
        (["max_steps=60"], "did you mean 'schedule.max_steps'?"),
        (["steps=60"], "did you mean 'schedule.max_steps'?"),
        (["lr=0.1"], "no key 'lr'; did you mean 'schedule.rates'?"),
        (["llr=0.1"], "no key 'llr'; sparsestreet train --cfg job prints all"),
        (["device=cuda"], "did you mean 'trainer'? Its options are cpu, ddp, gpu"),
        (["weight=1"], "loss.photometric.weight, loss.sky.weight or loss.depth.weight?"),
        (["cutoff=1"], "no key 'cutoff'; "),
        (["seed=0,1"], "seed=0,1 asks for several runs: add -m, or choose one"),
    ],
)
def test_a_slip_is_one_line_that_says_what_was_meant(overrides, said):
    problem = override_problem(overrides)
    assert said in problem
    assert len(problem.splitlines()) == 1


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("schedule.max_steps=0", "schedule.max_steps must be a whole number, 1 or more, got 0"),
        ("schedule.max_steps=-5", "schedule.max_steps must be a whole number, 1 or more, got -5"),
        ("schedule.max_steps=abc", "schedule.max_steps must be a whole number, 1 or more, got 'abc'"),
        ("schedule.max_steps=1e3", "schedule.max_steps must be a whole number, 1 or more, got 1000.0"),
        ("schedule.max_steps=true", "schedule.max_steps must be a whole number, 1 or more, got True"),
        ("seed=-1", "seed must be a whole number, 0 to 4294967295, got -1"),
        ("seed=4294967296", "seed must be a whole number, 0 to 4294967295, got 4294967296"),
        ("seed=abc", "seed must be a whole number, 0 to 4294967295, got 'abc'"),
        ("checkpoint_every=0", "checkpoint_every must be a whole number, 1 or more, got 0"),
        ("split.stride=-1", "split.stride must be a whole number, 0 or more, got -1"),
        ("trainer.max_steps=60", "of 2,000 steps says: give schedule.max_steps=60, or trainer.fast_dev_run=60 to try"),
        ("logger=nosuch", "pip install 'sparsestreet[nosuch]', or choose logger=csv"),
    ],
)
def test_numbers_out_of_their_limits_are_found_before_torch_is_imported(override, said, monkeypatch):
    monkeypatch.setitem(LOGGER_PACKAGES, "TensorBoardLogger", ("nosuch",))  # here, whatever is installed
    override = override.replace("logger=nosuch", "logger=tensorboard")
    problem = there(override_problem([override]))
    assert said in problem
    assert len(problem.splitlines()) == 1
    assert config_problem(composed([override])) == problem  # of a job of a sweep


def test_a_folder_that_would_lead_nowhere_is_refused():
    assert "give out=DIR" in there(override_problem(["folder=outputs/mine"]))


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
    ("override", "said"),
    [
        ("node.background.num_points=many", "node.background.num_points must be int, got 'many'"),
        ("node.background.sources.images.order=any", "sources.images.order must be Literal"),
        ("node.background.learning_rates.means.initial=[1]", "learning_rates.means.initial must be float"),
        ("++node.rigid.learning_rates.means.inital=1", "no key 'node.rigid.learning_rates.means.inital': LearningRate"),
        ("density@node.background.density=vibrating", "density.cycle follows from 'cycle', which these choices"),
        ("node.rigid.prunable=3", "node.rigid.prunable must be bool, got 3"),
        ("effects.sky.when=never", "effects.sky.when must be Literal['auto', 'on', 'off'], got 'never'"),
        ("effects.sky=none", "effects.sky has keys of its own, got 'none': set one of them, or say ~effects.sky"),
        ("loss.depth=3", "loss.depth has keys of its own, got 3"),
        ("loss.sky.weight=true", "loss.sky.weight must be float, got True"),
        ("node.rigid.classes=Car", "node.rigid.classes must be"),
        ("data.log.settings.lens=[a,0.1,0,0,0,0,0,0,0,0,0,0,0,0,0,0,0,0,0]", "data.log.settings.lens must be"),
        ("evaluation.presets=[fast,1,fast,fast,fast,fast,fast,fast,fast]", "evaluation.presets must be"),
        ("data.lidar.dropout=often", "data.lidar.dropout must be float, got 'often'"),
        ("data.lidar=hdl64", "data.log.settings.lidar must be LidarSensor, got 'hdl64'"),
        ("data=drivestudio", "data.root has no value: give data.root=..."),
        ("trainer.devices=2", "training runs on one device, got trainer.devices=2"),
    ],
)
def test_a_value_that_cannot_be_is_found_before_any_data_is_read(override, said):
    assert said in config_problem(composed([override]))


@pytest.mark.parametrize(
    "override", ["node.background.max_gaussians=null", "loss.sky.weight=1", "schedule.max_steps=5"]
)
def test_values_that_can_be_pass(override):
    assert config_problem(composed([override])) is None


def test_the_whole_configuration_can_be_shown_resolved(capsys):
    """With the run's folder, which no app knows yet, and lists that follow from others; what cannot be is one line."""
    assert train(["seed=3", "--cfg", "job", "--resolve", "out=runs/a", "method=omnire"]) == 0
    shown = OmegaConf.create(capsys.readouterr().out)
    assert (shown.seed, shown.folder, shown.node.smpl.classes) == (3, "runs/a", ["Pedestrian"])
    assert shown.callback.row_ledger.path == "runs/a/records/counts.csv"
    assert train(["--cfg", "job", "--resolve", "sparsify=random", "count_of=/nowhere"]) == 2
    assert "that run has no record" in capsys.readouterr().err


def test_a_gpu_that_is_not_there(monkeypatch):
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert "trainer=gpu needs a CUDA device and torch sees none: sparsestreet check says why" in there(
        config_problem(composed(["trainer=gpu"]))
    )


def folder_of_the_log(run: Path, started: Path, *overrides: str) -> Path:
    """Where a run that was started in a folder is taken to have its log."""
    (run / ".hydra").mkdir(parents=True)
    with configuration():
        OmegaConf.save(compose("train", list(overrides)), run / ".hydra" / "config.yaml")
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


PATHS = (
    "/l/ö",
    "/l/a,b",
    "/l/a b=c",
    "/l/it's",
    "/l/{x}",
    "/l/(x)",
    "/l/50%&#x",
    "/l/[x]",
    "l\\b'c\\",
    '日本/ä "q"',
    "123",
    "true",
    "/l/a ",
)
"""Folders as a shell hands them over: without its own quotes."""


@pytest.mark.parametrize("path", PATHS)
def test_a_path_is_taken_as_it_was_typed(path, monkeypatch):
    # A comma in a folder that is not there is a list without its -m.
    monkeypatch.setattr(Path, "exists", lambda self: True)
    (root, out) = as_typed([f"data.root={path}", f"out={path}"])
    assert (value_of(root), value_of(out)) == (path, path)
    assert as_typed([root]) == [root]
    monkeypatch.undo()
    assert override_problem(["data=rig_json", root, out]) is None
    assert as_typed(["out=/l/a,b"]) == ["out='/l/a,b'"]


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


def test_a_suggestion_is_of_the_choices_that_were_made():
    """The key is of a loss that the default configuration lacks."""
    said = override_problem(["sparsify=paper", "loss.mask_sparsity.weigh=0.2"])
    assert said == "no key 'loss.mask_sparsity.weigh'; did you mean 'loss.mask_sparsity.weight'?"


FILES = {
    "defaults: [paper_short, override /loss/mask_sparsity@loss: ramped]": (
        "sparsify/mine.yaml: 'override /loss/mask_sparsity' needs a group, and loss/mask_sparsity is an option: "
        "set loss.mask_sparsity.KEY in your file"
    ),
    "defaults: [paper_short, override /pruning@callback.pruning.rules: removal]": (
        "sparsify/mine.yaml: no key 'pruning@callback.pruning.rules'; did you mean pruning@callback.pruning.rule?"
    ),
    "defaults: [paper_short, /loss/ramped@loss]": "sparsify/mine.yaml: no option 'ramped' in conf/loss",
    "defaults: [paper_short]\nschedul: {max_steps: 3}": "sparsify/mine.yaml: no key 'schedul'; did you mean",
    "sparsify: {name: [}": "while parsing a flow node",
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
