"""A run's folder may come from anybody: whatever it names, only what conf/ names is made, or what the user trusts."""

import re
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from omegaconf import OmegaConf

from sparsestreet.cli.commands.evaluate import evaluate
from sparsestreet.cli.commands.export import export
from sparsestreet.cli.commands.objects import objects
from sparsestreet.cli.commands.render import render
from sparsestreet.cli.commands.serve import serve
from sparsestreet.cli.commands.train import train
from sparsestreet.cli.commands.view import view
from sparsestreet.cli.config import targets
from sparsestreet.cli.config.compose import CONF
from sparsestreet.cli.config.targets import named_by_conf, open_run_config
from sparsestreet.cli.runs.folder import resumed_overrides
from tests.cli.configurations import left_run


def attacks(mark: str) -> list[dict[str, Any]]:
    """Callables that leave a file where somebody makes them, of the standard library, others and our own."""
    touch = ["touch", mark]
    code = f"open({mark!r}, 'w')"
    path = {"_target_": "pathlib.Path", "_args_": [mark]}
    return [
        {"_target_": "os.system", "command": f"touch {mark}"},
        {"_target_": "posix.system", "_args_": [f"touch {mark}"]},
        {"_target_": "subprocess.Popen", "args": touch},
        {"_target_": "builtins.eval", "_args_": [code]},
        {"_target_": "functools.partial", "_args_": [{"_target_": "pathlib.Path.touch", "_args_": [path]}]},
        {"_target_": "builtins.list", "_args_": [[{"_target_": "os.mkdir", "path": mark}]]},
        {"_target_": "torch.save", "obj": 1, "f": mark},
        {"_target_": "lightning.pytorch.loggers.CSVLogger", "save_dir": mark},
        {"_target_": "hydra.utils.instantiate", "config": {"_target_": "os.mkdir", "path": mark}},
        {"_target_": "hydra.utils.get_object", "path": "this"},
        {"_target_": "sparsestreet.records.strict_json.write_json", "path": path, "value": 1},
        {"_target_": "sparsestreet.cli.runs.sweep.SweepFolder"},
    ]


WRAPPED: list[Callable[[dict[str, Any]], Any]] = [
    lambda part: part,
    lambda part: part | {"_partial_": True},
    lambda part: [[{"deep": part}]],
    lambda part: {"_target_": "sparsestreet.evaluation.extra.ExtraMetrics", "novel": [1, part]},
    lambda part: {**part, "_target_": "${name}"},
    lambda part: {**part, "_target_": ["os", "system"]},
    lambda part: "${of_reader:{1: {_target_: os.mkdir, path: " + "x" + "}}}",
    lambda part: "${oc.create:'{_target_: os.mkdir}'}",
    lambda part: "${oc.env:HOME}",
    lambda part: "${${name}:HOME}",
]
PLACES = ("evaluation", "data.log", "data.log.classes", "node.background", "effects.sky", "loss.sky", "anything.else")


def run_with(folder: Path, place: str, part: Any) -> Path:
    config = OmegaConf.create({"name": "os.mkdir", "folder": "x", "seed": 0})
    OmegaConf.update(config, place, OmegaConf.create(part) if isinstance(part, dict | list) else part)
    (folder / ".hydra").mkdir(parents=True, exist_ok=True)
    for name in ("scene.safetensors", "views.json"):
        (folder / name).touch()
    (folder / ".hydra" / "config.yaml").write_text(yaml.safe_dump(OmegaConf.to_container(config)))
    return folder


def opened_by(run: Path, out: Path) -> list[Callable[[], int]]:
    """Every command that opens a run."""
    return [
        lambda: evaluate([str(run)]),
        lambda: render([str(run), str(out / "a.mp4"), "device=cpu"]),
        lambda: objects([str(run), "device=cpu"]),
        lambda: export([str(run), str(out / "a.ply")]),
        lambda: export([str(run), str(out / "a.usdz")]),
        lambda: view([str(run), "device=cpu", "port=0"]),
        lambda: serve([str(run), "device=cpu", "port=0"]),
    ]


def test_nothing_that_a_received_run_names_is_made_by_any_command(tmp_path, monkeypatch, capfd):
    """Each callable by some command, each command with several; the check comes before anything is made or imported."""
    for name in ("instantiate", "_locate"):
        monkeypatch.setattr(targets, name, lambda *given, **_: pytest.fail(f"{given} was made"))
    monkeypatch.setattr("sparsestreet.scene.storage.load_scene", lambda *given: pytest.fail("it was opened"))
    monkeypatch.setattr("sparsestreet.serving.renderer.Scenes.rig", lambda *given: SimpleNamespace(cameras=()))
    mark = tmp_path / "it_ran"
    for number, part in enumerate(attacks(str(mark)) * 3):
        wrap = WRAPPED[(number + number // len(WRAPPED)) % len(WRAPPED)]
        run = run_with(tmp_path / "run", PLACES[number % len(PLACES)], wrap(part))
        commands = opened_by(run, tmp_path)
        status = commands[number % len(commands)]()
        said = capfd.readouterr().err
        assert status not in (0, 2), (part, wrap, said)
        assert f"{run}/.hydra/config.yaml" in said, (part, said)
        assert said.count("\n") <= 1
        assert not mark.exists()
    assert "this" not in sys.modules


def test_nobody_makes_parts_of_a_configuration_that_was_not_looked_at():
    """Who reads a run's configuration by ``load_run_config`` compares it; who makes its parts opens it here."""
    sources = {path.name: path.read_text() for path in Path(targets.__file__).parents[1].rglob("*.py")}
    reads = {name for name, text in sources.items() if "load_run_config" in text}
    assert reads == {"compose.py", "targets.py", "folder.py"}
    makers = r"instantiate\(|_locate\(|get_object\(|located\(|get_class\(|import_module\(|reader_of\(|made\("
    assert {name for name in reads if re.search(makers, sources[name])} == {"targets.py"}


def test_the_closed_list_has_what_conf_names():
    """Found once more, by the letters; what stands under hydra is no part of a run."""
    found = {name for path in CONF.rglob("*.yaml") for name in re.findall(r"_target_: ([\w.]+)", path.read_text())}
    assert found - {"sparsestreet.cli.runs.sweep.SweepFolder"} == set(named_by_conf().targets)
    assert len(found) > 60
    texts = "".join(path.read_text() for path in CONF.rglob("*.yaml"))
    assert texts.count("_target_") == len(re.findall(r"_target_: [\w.]+", texts))  # none is hidden in a text
    outside = {name: roots for name, roots in named_by_conf().targets.items() if not name.startswith("sparsestreet.")}
    assert outside == {
        "lightning.Trainer": {"trainer"},
        **{f"lightning.pytorch.loggers.{name}Logger": {"logger"} for name in ("CSV", "TensorBoard", "Wandb")},
    }


@pytest.mark.parametrize(
    "where", ["node.kite", "node.background.sources.kites", "node.background.mask", "effects.haze"]
)
def test_a_part_from_outside_is_imported_where_the_user_trusts_its_module(where, tmp_path, monkeypatch):
    name = f"outside_{where.rpartition('.')[2]}"
    (tmp_path / f"{name}.py").write_text("class Settings: ...\n")
    monkeypatch.syspath_prepend(tmp_path)
    run = run_with(tmp_path / "run", f"{where}._target_", f"{name}.Settings")
    said = (
        rf"config\.yaml: {where}\._target_ names '{name}\.Settings', which conf/ does not: say parts=\[{name}\] if its"
    )
    for parts in ((), (f"{name}s",), (name[:-1],)):
        with pytest.raises(ValueError, match=said):
            open_run_config(run, parts)
    assert name not in sys.modules
    open_run_config(run, (name,))
    assert sys.modules.pop(name).Settings
    with pytest.raises(ValueError, match=r"parts=\[\.\.\.\] names modules, such as parts=\[mypaper\], got '\.\.'"):
        open_run_config(run, ("..",))


received = partial(left_run, config={"seed": 0})


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("++node.background.zzz={_target_:numpy.testing.measure,code_str:x}", "names 'numpy.testing.measure', which"),
        ("hydra.searchpath=[pkg://this]", "nothing of Hydra's"),
        ("hydra/launcher=joblib", "nothing of Hydra's"),
        ("--config-dir=/tmp", "no flag"),
        ("++folder=/tmp", "no folder"),
        ("++data.root=${oc.env:HOME}", "data.root is .*asks for what conf/ never asks for: write its value"),
        ("logger.save_dir=/tmp/elsewhere", "does not choose where it writes or whom it calls"),
        ("++trainer.profiler=advanced", "trainer.profiler is 'advanced'"),
        ("++callback.row_ledger._args_=[/tmp/x]", "Hydra's _args_"),
    ],
)
def test_words_of_a_received_run_choose_no_code_and_no_place(word, said, tmp_path):
    run = received(tmp_path / "run", "seed=3", word)
    with pytest.raises(ValueError, match=said) as told:
        resumed_overrides([f"resume={run}"])
    assert str(told.value).startswith(f"{run}/.hydra/overrides.yaml")
    assert "\n" not in str(told.value)


@pytest.mark.parametrize(
    ("package", "content", "key"),
    [
        ("hydra.job_logging.handlers.file", "{class: os.system, command: touch here}", "job_logging"),
    ],
)
def test_a_file_outside_of_conf_reaches_hydra_no_more_than_a_word(package, content, key, tmp_path):
    """A group's option may lead out of conf/."""
    (tmp_path / "evil.yaml").write_text(f"# @package {package}\n{content}\n")
    up = "../" * (len(CONF.parts) + 3)
    run = received(tmp_path / "run", f"experiment={up}{tmp_path.relative_to('/')}/evil")
    with pytest.raises(ValueError, match=rf"overrides\.yaml changes hydra\.{key}, which a run that was received does"):
        resumed_overrides([f"resume={run}"])


def test_words_of_a_received_run_begin_no_sweep(tmp_path, monkeypatch):
    """The values that a sweep varies are composed job by job, where nobody looks any more."""
    run, asked = received(tmp_path / "run", "+sweep=tiny"), []
    monkeypatch.setattr(
        "sparsestreet.cli.commands.train.override_problem", lambda words: asked.append(words) or "enough"
    )
    assert train([f"resume={run}"]) == 2
    assert asked == [["+sweep=tiny", f"resume={run}", f"out={run}"]]
    assert train([f"resume={run}", "+sweep=tiny"]) == 2
    assert len(asked) == 1


@pytest.mark.lengthy
def test_what_the_user_says_now_is_the_users(tmp_path, capsys):
    part = "++loss.mine={_target_:tests.cli.toy.loss.MeanColor,weight:0.1}"
    run = received(tmp_path / "run", "seed=3", part, "logger=wandb", "++trainer.accumulate_grad_batches=2")
    asked = [f"resume={run}"]
    own = ["seed=3", part, "logger=wandb", "++trainer.accumulate_grad_batches=2", *asked, f"out={run}"]
    assert resumed_overrides(asked, ["tests.cli.toy"]) == own
    assert part in resumed_overrides([*asked, part])
    with pytest.raises(ValueError, match=r"say parts=\[tests\.cli\.toy\.loss\] if its code is trusted"):
        resumed_overrides(asked, ["tests.cli.toys"])
