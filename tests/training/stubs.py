"""Scenes of a few Gaussians to train, and a trainer reduced to what callbacks and the system ask of Lightning's."""

import copy
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from lightning import Callback, LightningDataModule, Trainer
from torch import Tensor

from sparsestreet.data.datamodule import OrderedFrames, StreetData
from sparsestreet.data.lazy import Sweeps, as_frames
from sparsestreet.data.log import DrivingLog, Split
from sparsestreet.geometry.trajectories import Trajectories
from sparsestreet.records.curves import CountChange
from sparsestreet.scene.density import DensityStatistics, DensityStrategy
from sparsestreet.scene.effects import Effect
from sparsestreet.scene.gaussians import RowPlan, Rows
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.masks import Mask, SampledMaskSettings, StaticMaskSettings
from sparsestreet.scene.nodes import Background, Node, Rigid
from sparsestreet.scene.rendering import RenderOptions
from sparsestreet.training.callbacks.density_control import RowListener
from sparsestreet.training.far_depth import FarDepthTerm
from sparsestreet.training.losses import Loss, Photometric
from sparsestreet.training.moved_views import MovedViewTerm
from sparsestreet.training.optimizer import OptimizerSettings
from sparsestreet.training.system import StreetSystem
from sparsestreet.types import Camera, Frame, Gaussians
from tests.scene.street import background_settings, rigid_settings

WIDTH, HEIGHT = 32, 16
NUM_FRAMES = 5


def make_rows(count: int, seed: int = 0, columns: Mapping[str, Tensor] | None = None, **buffers: Tensor) -> Rows:
    """Rows in front of the camera of ``frame_at``, about 0.1 m large; the buffer ``label`` is the row's number."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    means = torch.rand(count, 3, generator=generator) * torch.tensor([3.0, 1.5, 2.0]) + torch.tensor([-1.5, -0.7, 2.0])
    parameters = {
        "means": means,
        "log_scales": torch.full((count, 3), 0.1).log() + 0.2 * normal(count, 3),
        "quaternions": normal(count, 4),
        "opacity_logits": normal(count),
        "sh_dc": normal(count, 1, 3),
        "sh_rest": 0.1 * normal(count, 15, 3),
    }
    extra = dict(columns or {})
    return Rows(parameters | extra, {"label": torch.arange(count), **buffers}, transient=extra.keys())


Masks = StaticMaskSettings | SampledMaskSettings | None


def masked_rows(count: int, seed: int, mask: Masks, floor: int, **buffers: Tensor) -> tuple[Rows, Mask | None]:
    trained = None if mask is None else mask.build(floor)
    return make_rows(count, seed, {} if trained is None else trained.initial_columns(count), **buffers), trained


def background(count: int = 20, *, seed: int = 0, mask: Masks = None, **changes: Any) -> Background:
    settings = background_settings(mask=mask, masked=mask is not None, **changes)
    return Background(settings, *masked_rows(count, seed, mask, settings.min_gaussians))


def rigid(count: int = 10, *, seed: int = 1, mask: Masks = None, **changes: Any) -> Rigid:
    """Two objects of 4 x 2 x 1.5 m and 1 x 1 x 2 m that stand at the origin; rows take turns between them."""
    settings = rigid_settings(mask=mask, masked=mask is not None, **{"prunable": True, "box_margin": 0.1} | changes)
    rows, trained = masked_rows(count, seed, mask, settings.min_gaussians, instances=torch.arange(count) % 2)
    still = Trajectories(
        torch.tensor([[0.0, 1.0]] * 2),
        torch.tensor([[[1.0, 0.0, 0.0, 0.0]] * 2] * 2),
        torch.tensor([[[0.0, 0.0, 3.0]] * 2] * 2),
        torch.ones(2, 2, dtype=torch.bool),
        torch.tensor([[0.0, 1.0]] * 2),
    )
    sizes = torch.tensor([[4.0, 2.0, 1.5], [1.0, 1.0, 2.0]])
    return Rigid(settings, rows, still, sizes, names=("truck", "person"), max_gap=1.0, mask=trained)


def no_gaussians() -> Gaussians:
    """What a rendering that is made by hand has drawn."""
    return Gaussians(*(torch.zeros(0, *shape) for shape in ((3,), (4,), (3,), (), (1, 3))))


def labels(node: Node) -> list[int]:
    """Which of the first rows a node still has."""
    return node.rows.label.tolist()


def set_rows(node: Node, column: str, entries: Mapping[int, float]) -> None:
    """Give rows by number other values."""
    with torch.no_grad():
        for row, value in entries.items():
            node.rows.columns()[column][row] = value


def frame_at(index: int = 0, width: int = WIDTH, height: int = HEIGHT, **known: Any) -> Frame:
    """A random image seen from the origin along +z, with 90 degrees of horizontal view."""
    focal = width / 2
    intrinsics = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    generator = torch.Generator().manual_seed(index)
    image = torch.randint(0, 256, (height, width, 3), dtype=torch.uint8, generator=generator)
    return Frame(
        Camera(torch.eye(4), intrinsics, width, height), index / (NUM_FRAMES - 1), index, 0, image=image, **known
    )


def street_data(instants: int, stride: int, offset: int = 0) -> StreetData:
    """So many instants of ``frame_at``, without lidar and boxes."""
    frames = as_frames([frame_at(index) for index in range(instants)])
    log = DrivingLog("street", frames, Sweeps.of(()), (), instants, 1, torch.eye(4).double())
    return StreetData(log, stride=stride, offset=offset)


def make_system(
    nodes: Mapping[str, Node],
    losses: Mapping[str, Loss] | None = None,
    optimizer: OptimizerSettings | None = None,
    *,
    effects: Mapping[str, Effect] | None = None,
    radius: float = 10.0,
    options: RenderOptions | None = None,
    sh_interval: float = 0.1,
    sh_every: int = 1,
    sh_every_from: float = 0.0,
    moved_views: MovedViewTerm | None = None,
    far_depth: FarDepthTerm | None = None,
) -> StreetSystem:
    return StreetSystem(
        SceneGraph(nodes, effects),
        {"photometric": Photometric()} if losses is None else losses,
        OptimizerSettings() if optimizer is None else optimizer,
        radius=radius,
        options=RenderOptions() if options is None else options,
        sh_interval=sh_interval,
        sh_every=sh_every,
        sh_every_from=sh_every_from,
        moved_views=moved_views,
        far_depth=far_depth,
    )


class SplitFrames(StreetData):
    """Frames that are split already, without their log."""

    def __init__(self, split: Split) -> None:
        LightningDataModule.__init__(self)
        self.split = split


class StubTrainer(Trainer):
    """Takes steps and calls hooks in Lightning's order, without loops, loggers or devices (test_stubs compares)."""

    # In place of Lightning's properties.
    global_step: int = 0
    current_epoch: int = 0
    max_steps: int = 0
    log_every_n_steps: int = 1
    optimizers: Sequence[torch.optim.Optimizer] = ()
    datamodule: Any = None
    is_global_zero: bool = True
    sanity_checking: bool = False
    interrupted: bool = False
    callback_metrics: Any = None
    world_size: int = 1
    accumulate_grad_batches: int = 1
    strategy: Any = SimpleNamespace(broadcast=lambda value: value)
    loggers: Sequence[Any] = ()

    def __init__(
        self,
        system: StreetSystem,
        callbacks: Iterable[Callback] = (),
        *,
        max_steps: int = 100,
        train: tuple[Frame, ...] = (),
        held_out: tuple[Frame, ...] = (),
    ) -> None:
        # Not Lightning's __init__: nothing of its machinery is there.
        self.system, self.callbacks, self.max_steps = system, list(callbacks), max_steps
        self.datamodule = SplitFrames(Split(as_frames(train), as_frames(held_out)))
        self.callback_metrics = {}
        self.log_calls: list[tuple[str, float, dict[str, Any]]] = []
        system.trainer = self
        self.optimizers = [system.configure_optimizers()]
        system.log = self._log
        for callback in self.callbacks:
            callback.setup(self, system, "fit")

    @property
    def fit_loop(self) -> SimpleNamespace:
        """Nothing is validated, and every batch was a step."""
        return SimpleNamespace(_data_fetcher=None, epoch_loop=SimpleNamespace(_batches_that_stepped=self.global_step))

    @property
    def _logger_connector(self) -> SimpleNamespace:
        every = self.log_every_n_steps
        logs = every > 0 and (self.global_step + 1) % every == 0
        return SimpleNamespace(should_update_logs=logs, log_metrics=self._log_metrics)

    def start(self) -> None:
        for callback in self.callbacks:
            callback.on_train_start(self, self.system)

    def train(self, steps: int, frame: Frame) -> None:
        """Optimizer steps on one frame."""
        for _ in range(steps):
            self._start_step(frame)
            self.system.on_train_batch_start(frame, 0)
            loss = self.system.training_step(frame, 0)
            self.optimizers[0].zero_grad()
            loss.backward()
            for callback in self.callbacks:
                callback.on_after_backward(self, self.system)
            self.optimizers[0].step()
            self._end_step(frame)

    def walk(self, until: int) -> None:
        """Let the steps up to ``until`` pass: callbacks hear that they ended, nothing is rendered."""
        while self.global_step < until:
            self._start_step(None)
            self._end_step(None)

    def _start_step(self, frame: Frame | None) -> None:
        for callback in self.callbacks:
            callback.on_train_batch_start(self, self.system, frame, 0)

    def save_checkpoint(self, filepath: Path, weights_only: bool | None = None, storage_options: Any = None) -> None:
        """The step, in place of all that Lightning writes."""
        filepath.write_text(str(self.global_step))

    def _end_step(self, frame: Frame | None) -> None:
        self.global_step += 1
        for callback in self.callbacks:
            callback.on_train_batch_end(self, self.system, None, frame, 0)
        if frame is not None:
            self.system.on_train_batch_end(None, frame, 0)

    def _log(self, name: str, value: Any, *places: Any, **how: Any) -> None:
        self.log_calls.append((name, float(value), how))
        self.callback_metrics[name] = torch.as_tensor(float(value))

    def _log_metrics(self, metrics: Mapping[str, float], step: int) -> None:
        """What the loggers of Lightning's trainer get."""
        self.log_calls += [(name, value, {"step": step}) for name, value in metrics.items()]


class _OneFrame(LightningDataModule):
    def __init__(self, frame: Frame) -> None:
        super().__init__()
        self.frames = OrderedFrames(as_frames((frame,)))

    def train_dataloader(self) -> OrderedFrames:
        return self.frames

    def val_dataloader(self) -> OrderedFrames:
        return self.frames

    def transfer_batch_to_device(self, batch: Frame, device: torch.device, dataloader_idx: int) -> Frame:
        return batch


def fit(system: StreetSystem, callbacks: Sequence[Callback], max_steps: int, frame: Frame, **settings: Any) -> Trainer:
    """Lightning's own training on one frame, and its trainer; without validation unless ``settings`` ask for it."""
    trainer = Trainer(
        **{
            "accelerator": "cpu",
            "max_steps": max_steps,
            "logger": False,
            "enable_checkpointing": False,
            "enable_progress_bar": False,
            "enable_model_summary": False,
            "limit_val_batches": 0,
            "callbacks": list(callbacks),
            **settings,
        }
    )
    trainer.fit(system, datamodule=_OneFrame(frame))
    return trainer


class Listener(Callback, RowListener):
    """Writes down what it hears of rows."""

    def __init__(self) -> None:
        self.heard: list[tuple[CountChange, RowPlan]] = []

    def on_rows_changed(self, change: CountChange, plan: RowPlan) -> None:
        self.heard.append((change, plan))

    @property
    def reasons(self) -> list[tuple[int, str, str]]:
        return [(change.step, change.node, change.reason) for change, _ in self.heard]


class AskedStrategy(DensityStrategy):
    """A density strategy that writes down what it is asked, and changes nothing."""

    watched = ()

    def __init__(self) -> None:
        self.asked: list[dict[str, Any]] = []

    def densify(
        self,
        rows: Rows,
        statistics: DensityStatistics,
        *,
        radius: float,
        progress: float,
        max_gaussians: int | None,
        generator: torch.Generator,
    ) -> RowPlan:
        given = {"radius": radius, "progress": progress, "max_gaussians": max_gaussians, "generator": generator}
        return self._keep("densify", rows, statistics=copy.deepcopy(statistics), **given)

    def cull(self, rows: Rows, statistics: DensityStatistics, *, radius: float, progress: float) -> RowPlan:
        return self._keep("cull", rows, statistics=copy.deepcopy(statistics), radius=radius, progress=progress)

    def reset(self, rows: Rows) -> RowPlan:
        return self._keep("reset", rows)

    def _keep(self, what: str, rows: Rows, **given: Any) -> RowPlan:
        self.asked.append({"what": what, **given})
        return RowPlan.keep(torch.ones(len(rows), dtype=torch.bool))


def group_of(optimizer: torch.optim.Optimizer, parameter: torch.Tensor) -> dict[str, Any]:
    """The group that steps a parameter."""
    (group,) = (g for g in optimizer.param_groups if any(parameter is other for other in g["params"]))
    return group
