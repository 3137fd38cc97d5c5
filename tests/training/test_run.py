"""A training from Python, without a configuration: what it leaves, how it goes on, and who writes."""

import logging
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lightning import Callback, Trainer
from lightning.fabric.utilities.rank_zero import rank_zero_only
from lightning.pytorch.loggers import CSVLogger
from lightning.pytorch.strategies import SingleDeviceStrategy

from sparsestreet.data.datamodule import StreetData
from sparsestreet.evaluation.extra import ExtraMetrics
from sparsestreet.evaluation.speed import Timing
from sparsestreet.evidence.light import measured_light
from sparsestreet.ops import SplatSettings
from sparsestreet.phases import StageRecorder
from sparsestreet.ranks import ALONE
from sparsestreet.records.configuration import config_hash
from sparsestreet.records.costs import COSTS, STEP_PHASES, StepPhase
from sparsestreet.records.run import RUN, CodeVersion, EffectDecision, Machine
from sparsestreet.records.summary import SUMMARY
from sparsestreet.scene.density import GradientDensity
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.nodes import BackgroundSettings
from sparsestreet.scene.rendering import RenderOptions
from sparsestreet.scene.storage import load_scene
from sparsestreet.training import forecast, run
from sparsestreet.training import recipe as identity_module
from sparsestreet.training.callbacks import Clock, DensityControl, GracefulStop, RowLedger, TrainingProgress
from sparsestreet.training.recipe import Recipe, RunIdentity
from sparsestreet.training.run import CPU_TRAINER, fit, train
from sparsestreet.training.schedule import Interval
from tests.evaluation.frames import make_summary
from tests.training.stubs import background, make_system, street_data

pytestmark = pytest.mark.lengthy

STEPS = 12
TRAINER = partial(CPU_TRAINER, log_every_n_steps=2)


def data() -> StreetData:
    """Five instants, of which 1 and 3 are held out."""
    return street_data(5, stride=2, offset=1)


def recipe(out: Path, *watch: Callback) -> Recipe:
    """Gaussians come and go at steps 4, 8 and 12."""
    background = BackgroundSettings(
        num_points=60, min_gaussians=0, max_gaussians=None, density=GradientDensity(grad_threshold=1e-6)
    )
    return Recipe(
        nodes={"background": background},
        callbacks={
            "density_control": DensityControl(Interval(0.0, 1.0, every=4), 1.0, Interval(0.0, 0.0)),
            "row_ledger": RowLedger(out / "records" / "counts.csv"),
            **{f"watch {number}": one for number, one in enumerate(watch)},
        },
    )


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("whole") / "mine"
    summary = train(recipe(out), data(), out, max_steps=STEPS, make_trainer=TRAINER)
    assert summary.run == RUN.read(out)
    # Records keep six digits.
    assert summary.mean("psnr_full") == pytest.approx(SUMMARY.read(out).mean("psnr_full"), rel=1e-5)
    return out


def weights(run: Path) -> dict[str, torch.Tensor]:
    return torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]


def files(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.is_file()]


def test_a_run_is_called_after_its_folder_and_leaves_what_the_command_leaves(whole):
    run, summary = RUN.read(whole), SUMMARY.read(whole)
    assert (run.label, run.method, run.sparsify, run.scene) == ("mine", "python", "none", "street")
    assert (run.steps, run.max_steps, run.seed, run.split) == (STEPS, STEPS, 0, "every 2th frame from 1")
    assert run.device.startswith("cpu: ")
    assert run.threads == torch.get_num_threads()
    assert summary.images == {"held_out": 2, "training": 3}
    assert load_scene(whole).scene.counts() == summary.gaussians != {"background": 60}
    assert {"train", "evaluate", "save"} < COSTS.read(whole).phases.keys()
    for name in ("views.json", "curves/metrics.csv", "curves/counts.png", "pictures/sheet.png"):
        assert (whole / name).is_file(), name


class Steps(Callback):
    """Keeps which steps were begun, and fails in one of them."""

    def __init__(self, fails_in: int | None = None) -> None:
        self.fails_in = fails_in
        self.begun: list[int] = []

    def on_train_batch_start(self, trainer, *arguments):
        self.begun.append(trainer.global_step)
        if trainer.global_step == self.fails_in:
            raise RuntimeError("stopped by the test")


def test_a_run_that_was_stopped_goes_on_to_the_same_bits(whole, tmp_path):
    """Between two changes of rows: their statistics go on too."""
    with pytest.raises(RuntimeError, match="stopped by the test"):
        train(recipe(tmp_path, Steps(fails_in=6)), data(), tmp_path, max_steps=STEPS, make_trainer=TRAINER)
    assert RUN.read(tmp_path).steps == 6
    with pytest.warns(UserWarning, match="is not empty"):  # Lightning's logger begins its file anew
        train(
            recipe(tmp_path, steps := Steps()), data(), tmp_path, max_steps=STEPS, make_trainer=TRAINER, resume=tmp_path
        )
    assert steps.begun == list(range(6, STEPS))
    expected, got = weights(whole), weights(tmp_path)
    assert expected.keys() == got.keys()
    for name, value in expected.items():
        assert torch.equal(value, got[name]), name
    ledger = Path("records") / "counts.csv"
    assert (tmp_path / ledger).read_text() == (whole / ledger).read_text()


def test_a_run_that_was_finished_says_so(whole, tmp_path, caplog):
    """And is measured again, without a step."""
    shutil.copytree(whole, out := tmp_path / "run")
    with caplog.at_level(logging.INFO), pytest.warns(UserWarning, match="is not empty"):
        train(recipe(out, steps := Steps()), data(), out, max_steps=STEPS, make_trainer=TRAINER, resume=out)
    assert steps.begun == []
    assert f"{out} was finished: all {STEPS} steps are done, it is measured again" in caplog.messages
    assert any(line.startswith("held-out views: PSNR ") for line in caplog.messages)


def test_a_run_that_is_not_there_is_an_error_before_anything_is_built(tmp_path):
    unbuilt = Recipe(nodes={})
    with pytest.raises(FileNotFoundError, match="has no checkpoint to go on from"):
        train(unbuilt, data(), tmp_path / "new", resume=tmp_path / "old")


class NotTheFirst(SingleDeviceStrategy):
    """As a process that is not the first of several sees itself, without the others."""

    is_global_zero: bool = False


def test_of_several_processes_the_first_alone_writes(whole, monkeypatch):
    before = {path: path.stat().st_mtime_ns for path in files(whole)}
    monkeypatch.setattr(run, "help_to_evaluate", lambda *args, **how: None)
    monkeypatch.setattr(rank_zero_only, "rank", 1)
    other = partial(TRAINER, strategy=NotTheFirst(device="cpu"), accelerator="auto")
    assert train(recipe(whole), data(), whole, max_steps=STEPS + 2, make_trainer=other, resume=whole) is None
    assert {path: path.stat().st_mtime_ns for path in files(whole)} == before


def test_a_look_whether_all_runs_measures_nothing(tmp_path):
    quick = partial(CPU_TRAINER, fast_dev_run=2)
    identity = RunIdentity(label="3dgs+ours", method="3dgs", sparsify="ours", config={"a": 1}, data_hash="12")
    assert train(recipe(tmp_path), data(), tmp_path, make_trainer=quick, identity=identity) is None
    run = RUN.read(tmp_path)
    assert (run.steps, run.max_steps) == (2, 2000)
    assert (run.label, run.method, run.sparsify, run.config) == ("3dgs+ours", "3dgs", "ours", {"a": 1})
    assert run.data_hash == "12"
    assert not SUMMARY.path(tmp_path).exists()


def test_parts_that_do_not_fit_are_an_error_before_anything_is_built(tmp_path):
    control = DensityControl(Interval(0.0, 1.0), 1.0, Interval(0.0, 0.0))
    broken = Recipe(nodes={"background": BackgroundSettings()}, callbacks={"density_control": control})
    with pytest.raises(ValueError, match="every node's density is null"):
        train(broken, data(), tmp_path)
    assert files(tmp_path) == []


class Finished(Trainer):
    """What is asked of a trainer behind its last step."""

    is_global_zero: bool = True
    fast_dev_run: bool = False
    world_size: int = 1
    accumulate_grad_batches: int = 1
    strategy: Any = SimpleNamespace(root_device=torch.device("cpu", 0))

    def __init__(self) -> None: ...


def test_a_trainer_is_made_of_what_fit_is_given(tmp_path):
    """From the start and from a checkpoint; its own files stay off."""
    made, fitted = [], []

    class Made(Finished):
        def __init__(self, **given: Any) -> None:
            made.append(given)

        def fit(self, *system: Any, **how: Any) -> None:
            fitted.append((system, how))

    system, frames, watch = make_system({"background": background(1)}), data(), [RowLedger(tmp_path / "a.csv")]
    logger = CSVLogger(tmp_path, name="n")
    given = {"max_steps": 7, "logger": logger}
    assert isinstance(fit(system, frames, watch, Made, tmp_path / "o", **given), Made)
    expected = {"max_steps": 7, "max_epochs": -1, "callbacks": watch, "logger": logger}
    expected |= {"default_root_dir": str(tmp_path / "o")}
    off = dict.fromkeys(("enable_model_summary", "enable_progress_bar", "enable_checkpointing"), False)
    assert made == [expected | off]
    assert fitted == [((system,), {"datamodule": frames})]
    torch.save({"global_step": 3}, tmp_path / "c.ckpt")
    curves = tmp_path / "o" / "curves" / "metrics.csv"
    curves.parent.mkdir(parents=True)
    curves.write_text("psnr,step\n10,2\n11,3\n")
    fit(system, frames, watch, Made, tmp_path / "o", **given, start=tmp_path / "c.ckpt")
    assert fitted[1] == ((system,), {"datamodule": frames, "ckpt_path": tmp_path / "c.ckpt", "weights_only": True})
    assert curves.read_text() == "psnr,step\n10,2\n11,3\n"  # nobody began the file anew


def test_an_evaluation_is_handed_all_that_it_is_given(tmp_path, monkeypatch):
    called = []
    summary = make_summary()
    monkeypatch.setattr(run, "evaluate_scene", lambda *args, **how: called.append((args, how)) or summary)
    monkeypatch.setattr(run, "draw_history", lambda out: called.append(out))
    monkeypatch.setattr(ExtraMetrics, "measure", lambda self, *args, **how: called.append((self, args, how)))
    RUN.write(tmp_path, summary.run)
    scene, frames = SceneGraph({"background": background(1)}), data()
    extra = ExtraMetrics(timing=Timing(3, 4, 5), training_lpips=True)
    options, device, said = RenderOptions(SplatSettings(near_plane=0.3)), torch.device("cpu", 0), print
    told = {"out": tmp_path, "device": device, "command": "typed"}
    with StageRecorder() as stages:
        assert run.evaluate(scene, options, frames, **told, extra=extra, say=said) is summary
    held_out, training = frames.split.held_out, frames.split.train
    measured = {"run": summary.run, "options": options, "timing": extra.timing, "ranks": ALONE} | told
    measured |= {"log": frames.driving_log, "training_lpips": True}
    assert called == [
        ((scene, held_out, training), measured),
        (extra, (scene, frames, options), {"out": tmp_path, "command": "typed", "say": said}),
        tmp_path,
    ]
    assert set(stages.seconds()) == {"other", "evaluate", "pictures"}


def test_a_training_hands_on_what_it_is_given(tmp_path, monkeypatch):
    """To the trainer, to the callbacks, to the evaluation and to the costs."""
    called: dict[str, tuple[tuple[Any, ...], dict[str, Any]]] = {}
    system, device = make_system({"background": background(1)}), torch.device("cpu", 0)
    trainer = Finished()

    def replaced(name, answer):
        monkeypatch.setattr(run, name, lambda *args, **how: called.update({name: (args, how)}) or answer)

    summary = make_summary()
    for name, answer in (("build", system), ("fit", trainer), ("evaluate", summary), ("record_costs", None)):
        replaced(name, answer)
    parts, frames, extra = recipe(tmp_path), data(), ExtraMetrics(timing=Timing(3, 4, 5))
    stages, checkpoint = StageRecorder(), tmp_path / "some.ckpt"
    checkpoint.touch()
    identity = RunIdentity(label="mine", command="typed")
    told = {"max_steps": 9, "make_trainer": TRAINER, "logger": False, "identity": identity, "extra": extra}
    told["minutes"] = 0.5
    assert train(parts, frames, tmp_path / "o", **told, resume=checkpoint, stages=stages) is summary
    assert called["build"] == ((parts, frames, parts.plan(frames)), {})
    (one, of, callbacks, make, out), how = called["fit"]
    assert (one, of, make, out) == (system, frames, TRAINER, tmp_path / "o")
    assert how == {"max_steps": 9, "logger": False, "start": checkpoint}
    evaluated = {"device": device, "command": "typed", "extra": extra, "ranks": ALONE}
    assert called["evaluate"] == ((system.scene, system.options, frames, tmp_path / "o"), evaluated)
    assert called["record_costs"] == ((tmp_path / "o", stages, device), {})
    # In this order: a clock first, then those of the recipe, a signal last.
    clock, *own, times, pace, curve, progress, files, checkpoints, stop = callbacks
    assert own == list(parts.callbacks.values())
    assert isinstance(clock, Clock)
    assert (times.recorder, curve.run, curve.clock) == (stages, tmp_path / "o", clock)
    assert (pace.stages, pace.minutes, pace.timing) == (stages, 0.5, Timing(3, 4, 5))
    assert isinstance(progress, TrainingProgress)
    assert (files.folder, files.clock, files.description) == (
        tmp_path / "o", clock, identity.describe(parts, frames, 9),
    )  # fmt: skip
    assert (checkpoints.folder, checkpoints.every) == (tmp_path / "o" / "checkpoints", 1000)
    assert isinstance(stop, GracefulStop)


def test_curves_go_into_the_folder_unless_a_logger_is_given(tmp_path, monkeypatch):
    given: dict[str, Any] = {}
    monkeypatch.setattr(run, "build", lambda *parts: make_system({"background": background(1)}))
    trainer = Finished()
    monkeypatch.setattr(run, "help_to_evaluate", lambda *args, **how: None)
    trainer.is_global_zero = False
    monkeypatch.setattr(run, "fit", lambda *args, **how: given.update(how) or trainer)
    assert train(recipe(tmp_path), data(), tmp_path / "o") is None
    assert Path(given["logger"].log_dir) == tmp_path / "o" / "curves"
    assert (given["max_steps"], given["start"]) == (2000, None)


def test_a_run_is_described_by_its_parts(monkeypatch):
    machine, source = Machine("p", 3, "s", "v", "t"), CodeVersion("abc", True)
    monkeypatch.setattr(identity_module, "this_machine", lambda: machine)
    monkeypatch.setattr(identity_module, "this_source", lambda: source)
    config = {"seed": 4, "a": 1}
    who = RunIdentity(label="l", method="m", sparsify="s", config=config, follows={"a": 0}, data_hash="h", command="c")
    sky = EffectDecision(
        name="sky", on=True, source="measured", reason="r", value=1.0, unit="", threshold=None, noise=None, numbers=6,
        ms=0.1, gain=None,
    )  # fmt: skip
    street = data()
    street.driving_log = replace(street.driving_log, masks={"human": "given", "ego": "shipped"})
    found = who.describe(Recipe(nodes={}, seed=6), street, 17, (sky,))
    expected = {"label": "l", "method": "m", "sparsify": "s", "config": config, "data_hash": "h", "command": "c"}
    expected |= {"follows": {"a": 0}}
    expected |= {"config_hash": config_hash(config), "scene": "street", "seed": 6, "split": "every 2th frame from 1"}
    expected |= {"max_steps": 17, "machine": machine, "source": source, "steps": 0, "threads": 0, "device": ""}
    expected |= {"training_seconds": None, "noise": None, "caps": {}, "format": 2, "cameras": ("0 32x16",)}
    expected |= {"effects": (sky,), "rested": {}, "held_back": {}}
    expected |= {"masks": {"sky": "none", "human": "given", "vehicle": "none"}}
    assert who.describe(Recipe(nodes={}, seed=6), data(), 17, (sky,)).masks == {}  # a log that does not tell
    expected |= {"light": measured_light(data().split.train).numbers()}
    assert vars(found) == expected


def test_costs_are_those_of_the_stages_and_the_device(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(forecast, "peak_megabytes", lambda device: asked.append(device) or (800.0, 6000.0))
    stages, spent = StageRecorder(), {"train": 5.0, "prune/Rule at step 7": 1.5, "other": 0.25}
    monkeypatch.setattr(stages, "seconds", lambda: spent)
    STEP_PHASES.write(tmp_path, [StepPhase(3, "splat", 2.5)])
    forecast.record_costs(tmp_path, stages, torch.device("cpu", 0))
    found = COSTS.read(tmp_path)
    assert (found.wall_seconds, found.phases) == (6.75, {"train": 5.0, "prune": 1.5, "other": 0.25})
    assert (found.passes, found.step_ms) == ({"Rule at step 7": 1.5}, {"splat": 2.5})
    assert (found.peak_host_mb, found.peak_device_mb, asked) == (800.0, 6000.0, [torch.device("cpu", 0)])
