"""From words to the objects of a run: every value of a configuration arrives where it belongs."""

import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from hydra.core.hydra_config import HydraConfig
from lightning import Callback
from omegaconf import DictConfig, OmegaConf

from sparsestreet.cli.commands import evaluate as evaluate_module
from sparsestreet.cli.commands.evaluate import evaluate
from sparsestreet.cli.config.compose import resolved, with_images
from sparsestreet.cli.runs import run as run_module
from sparsestreet.cli.runs import run as step_module
from sparsestreet.cli.runs.run import NEVER, data_of, recipe_of, run, train_with
from sparsestreet.data.synthetic.reader import StreetReader
from sparsestreet.evaluation.extra import ExtraMetrics
from sparsestreet.evaluation.speed import Timing
from sparsestreet.records.configuration import flat_config
from sparsestreet.records.run import RUN
from sparsestreet.scene.effects import SkySettings
from sparsestreet.training.callbacks import DensityControl, PhaseTimes, RowLedger
from tests.cli.configurations import composed
from tests.data.plan import make_log
from tests.evaluation.frames import make_run, make_summary
from tests.training.stubs import background, make_system
from tests.typed import as_a

WORDS = (
    "seed=7",
    "name=mine",
    "method=3dgs",
    "sparsify=removal",
    "split.stride=4",
    "split.offset=1",
    "split.val_frames=2",
    "schedule.max_steps=90",
    "schedule.sh_interval=0.17",
    "checkpoint_every=30",
    "optimizer.eps=1e-9",
    "optimizer.visible_only=true",
    "render.backend=reference",
    "render.preset=fine",
    "render.settings.near_plane=0.7",
    "evaluation.novel=[1.5]",
    "evaluation.timing.rounds=3",
    "effects.sky.resolution=8",
    "trainer.log_every_n_steps=4",
)


@pytest.fixture
def log(monkeypatch) -> Any:
    """In place of a street that would be traced."""
    log = make_log()
    monkeypatch.setattr(StreetReader, "read", lambda self: log)
    monkeypatch.setattr(StreetReader, "data_hash", lambda self: "c0ffee")
    return log


def test_every_value_of_a_recipe():
    cfg = composed(*WORDS)
    recipe = recipe_of(cfg)
    assert (recipe.seed, recipe.sh_interval) == (7, 0.17)
    assert (recipe.optimizer.eps, recipe.optimizer.visible_only) == (1e-9, True)
    assert (recipe.options.backend, recipe.options.settings.near_plane) == ("reference", 0.7)
    assert set(recipe.nodes) == set(cfg.node)
    assert set(recipe.losses) == set(cfg.loss)
    assert list(recipe.callbacks) == list(cfg.callback)
    assert set(recipe.effects) == set(cfg.effects)
    assert as_a(SkySettings, recipe.effects["sky"]).resolution == 8
    assert recipe.image_points is not None
    assert recipe_of(composed(*(f"~effects.{name}" for name in cfg.effects))).effects == {}


def test_a_key_of_an_earlier_version_has_one_clear_error(log):
    """As a run has it that is evaluated again; also where its value is nothing."""
    old = OmegaConf.merge(composed(*WORDS), OmegaConf.create({"data": {"log": {}}}))
    OmegaConf.set_struct(old, False)
    old.data.log.min_lens_shift = None
    with pytest.raises(ValueError, match=r"has data\.log\.min_lens_shift, which is effects\.lens\.min_shift now"):
        data_of(as_a(DictConfig, old))


@pytest.mark.parametrize(("resume", "summary"), [(None, make_summary(psnr=21.5)), ("run", None)])
def test_a_run_hands_on_what_its_configuration_says(log, monkeypatch, tmp_path, tmp_path_factory, resume, summary):
    monkeypatch.chdir(tmp_path_factory.mktemp("elsewhere"))
    Path("run").mkdir()
    words = [*WORDS, *([f"resume={resume}"] if resume else [])]
    called: list[tuple[tuple[Any, ...], dict[str, Any]]] = []
    order: list[str] = []
    for name in ("keep_freed_memory", "forget_peaks", "silence_known_noise"):
        monkeypatch.setattr(run_module, name, lambda name=name: order.append(name))
    monkeypatch.setattr(run_module, "train", lambda *args, **how: called.append((args, how)) or summary)
    monkeypatch.setattr(run_module, "take_folder", lambda cfg, out, goes_on: order.append(f"take {out.name} {goes_on}"))
    task = OmegaConf.create({"mode": None, "overrides": {"task": ["seed=7", "out=a b"]}})
    monkeypatch.setattr(HydraConfig, "get", lambda: task)
    started = time.perf_counter() - 3
    assert run(composed(*words), tmp_path, started) == (21.5 if summary else 0.0)
    (((recipe, data, out), how),) = called
    assert (data.seed, data.val_frames, data.split_in_words) == (7, 2, "every 4th frame from 1")
    assert data.split.held_out_indices == {1, 5, 9}
    assert order == [
        "keep_freed_memory",
        "forget_peaks",
        "silence_known_noise",
        f"take {tmp_path.name} False",  # the other run lies elsewhere
    ]
    assert (recipe.seed, data.driving_log, out) == (7, log, tmp_path)
    assert (how["max_steps"], how["checkpoint_every"]) == (90, 30)
    assert how["make_trainer"].keywords["log_every_n_steps"] == 4
    assert Path(how["logger"].root_dir) == Path()
    identity, known = how["identity"], with_images(composed(*words), len(data.split.train))
    assert (identity.label, identity.method, identity.sparsify) == ("mine", "3dgs", "removal")
    assert (identity.data_hash, identity.command) == ("c0ffee", "sparsestreet train seed=7 'out=a b'")
    assert identity.config == flat_config(resolved(known))
    assert how["extra"] == ExtraMetrics(novel=[1.5], presets=[], timing=Timing(20, 50, 3))
    assert how["resume"] == (Path(resume) if resume else None)
    seconds = how["stages"].seconds()
    assert list(seconds) == ["start", "other", "data"]
    assert 3 <= seconds["start"] < 60


def test_a_bench_trains_without_what_a_run_leaves(log, monkeypatch, tmp_path):
    """As its options say, with one callback more and one less."""
    given: list[Any] = []
    system = make_system({"background": background(1)})
    monkeypatch.setattr(step_module, "build", lambda recipe, data, plan: given.append((recipe, data, plan)) or system)
    monkeypatch.setattr(step_module, "fit", lambda *args, **how: given.append((args, how)))
    watch = Callback()
    assert train_with(WORDS, tmp_path)(watch) is system
    (recipe, data, plan), ((one, of, callbacks, make, folder), how) = given
    assert [each.name for each in plan.effects] == list(recipe.effects)
    assert (recipe.seed, data.driving_log, one, of) == (7, log, system, data)
    assert (folder, how) == (tmp_path, {"max_steps": 90})
    assert callbacks[-1] is watch
    kinds = [type(callback) for callback in recipe.callbacks.values()]
    assert PhaseTimes in kinds
    assert [type(callback) for callback in callbacks[:-1]] == [kind for kind in kinds if kind is not PhaseTimes]
    assert {DensityControl, RowLedger} <= set(kinds)
    assert make.keywords["val_check_interval"] == NEVER
    assert make.keywords["log_every_n_steps"] == 4
    with pytest.raises(ValueError, match=r"got trainer\.devices=2"):
        train_with(["trainer.devices=2"], tmp_path)


@pytest.mark.parametrize("threads", [1, 10_000])
def test_an_evaluation_hands_on_what_it_is_told(log, monkeypatch, tmp_path, capsys, threads):
    """As many threads as trained, and never more than there are cores."""
    RUN.write(tmp_path, make_run(device="cpu: other", threads=threads))
    scene, options = object(), object()
    opened, asked, numbers = [], [], []
    cfg = OmegaConf.merge(composed(*WORDS), {})
    monkeypatch.setattr(evaluate_module, "open_run_config", lambda run, parts: opened.append(run) or cfg)
    stored = SimpleNamespace(scene=scene, options=options)
    monkeypatch.setattr(evaluate_module, "open_scene", lambda *place: opened.append(place) or stored)
    monkeypatch.setattr(torch, "set_num_threads", numbers.append)
    monkeypatch.setattr(evaluate_module, "this_machine", lambda: SimpleNamespace(cores=6))
    summary = make_summary(psnr=21.5, training_psnr=31.25, milliseconds=7.25, gaussians={"a": 1234})
    monkeypatch.setattr(evaluate_module, "evaluate_run", lambda *args, **how: asked.append((args, how)) or summary)
    assert evaluate([f"run={tmp_path}", "presets=fast,fine"]) == 0
    (((one, way, data, out), how),) = asked
    assert (one, way, data.driving_log, out) == (scene, options, log, tmp_path)
    assert data.split_in_words == "every 4th frame from 1"
    extra = ExtraMetrics(novel=[1.5], presets=("fast", "fine"), timing=Timing(20, 50, 3))
    command = f"sparsestreet evaluate run={tmp_path} novel=1.5 presets=fast,fine"
    assert how == {"device": torch.device("cpu"), "command": command, "extra": extra, "say": print}
    assert opened == [tmp_path, (tmp_path, "cpu", ())]
    assert numbers == [min(threads, 6)]
    assert capsys.readouterr().out.splitlines() == [
        "held-out views: PSNR 21.50 dB, vehicles 22.00 dB, SSIM 0.800",
        "training views: PSNR 31.25 dB, vehicles 22.00 dB, SSIM 0.800",
        "1,234 Gaussians, 0.29 MB, 100 s of training, 7.2 ms a frame",
        f"pictures: {tmp_path}/pictures/sheet.png; curves: {tmp_path}/curves; numbers: {tmp_path}/records",
    ]
