"""A training from Python, without a configuration: what it leaves, how it goes on, and who writes."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from lightning import Callback
from lightning.fabric.utilities.rank_zero import rank_zero_only
from lightning.pytorch.strategies import SingleDeviceStrategy

from sparsestreet.data.datamodule import StreetData
from sparsestreet.data.lazy import Frames, Sweeps
from sparsestreet.data.log import DrivingLog
from sparsestreet.records.costs import COSTS
from sparsestreet.records.run import RUN
from sparsestreet.records.summary import SUMMARY
from sparsestreet.scene.density import GradientDensity
from sparsestreet.scene.nodes import BackgroundSettings
from sparsestreet.scene.storage import load_scene
from sparsestreet.training.callbacks import DensityControl, RowLedger
from sparsestreet.training.identity import RunIdentity
from sparsestreet.training.recipe import Recipe
from sparsestreet.training.run import CPU_TRAINER, train
from sparsestreet.training.schedule import Interval
from tests.training.stubs import frame_at

pytestmark = pytest.mark.lengthy

STEPS = 12
TRAINER = partial(CPU_TRAINER, log_every_n_steps=2)


def data() -> StreetData:
    """Five instants, of which 1 and 3 are held out."""
    frames = Frames.of([frame_at(index) for index in range(5)])
    log = DrivingLog("five", frames, Sweeps.of(()), (), 5, 1, torch.eye(4).double())
    return StreetData(log, stride=2, offset=1)


def recipe(out: Path, *watch: Callback) -> Recipe:
    """Gaussians come and go at steps 4, 8 and 12."""
    background = BackgroundSettings(num_points=60, density=GradientDensity(grad_threshold=1e-6))
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
    assert (run.label, run.method, run.sparsify, run.scene) == ("mine", "python", "none", "five")
    assert (run.steps, run.max_steps, run.seed, run.split) == (STEPS, STEPS, 0, "every 2th frame from 1")
    assert run.device.startswith("cpu: ")
    assert run.threads == torch.get_num_threads()
    assert summary.images == {"held_out": 2, "training": 3}
    assert load_scene(whole).scene.counts() == summary.gaussians != {"background": 60}
    assert {"train", "evaluate", "save"} < COSTS.read(whole).phases.keys()
    for name in ("views.json", "curves/metrics.csv", "curves/counts.png", "pictures/sheet.png"):
        assert (whole / name).is_file(), name


def test_the_seed_of_a_run_is_that_of_its_recipe(tmp_path):
    described = RunIdentity(label="mine").describe(replace(recipe(tmp_path), seed=3), data(), STEPS)
    assert described.seed == 3


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


def test_a_run_that_is_not_there_is_an_error_before_anything_is_built(tmp_path):
    unbuilt = Recipe(nodes={})
    with pytest.raises(FileNotFoundError, match="has no checkpoint to go on from"):
        train(unbuilt, data(), tmp_path / "new", resume=tmp_path / "old")


class NotTheFirst(SingleDeviceStrategy):
    """As a process that is not the first of several sees itself, without the others."""

    is_global_zero: bool = False


def test_of_several_processes_the_first_alone_writes(tmp_path, monkeypatch):
    monkeypatch.setattr(rank_zero_only, "rank", 1)
    other = partial(TRAINER, strategy=NotTheFirst(device="cpu"), accelerator="auto")
    assert train(recipe(tmp_path), data(), tmp_path, max_steps=4, make_trainer=other) is None
    assert files(tmp_path) == []


def test_another_process_leaves_what_the_first_one_wrote(whole, monkeypatch):
    before = {path: path.stat().st_mtime_ns for path in files(whole)}
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
