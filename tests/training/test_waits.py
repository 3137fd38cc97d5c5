"""A training step waits for its device once a rendering, for the number of pairs; where it waits again is listed here.

The steps are whole: the scene, the op's host side, losses, regularizers, logging, backward, statistics, optimizer.
"""

import csv
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning import Callback, Trainer
from lightning.pytorch.accelerators.cpu import CPUAccelerator
from lightning.pytorch.loggers import CSVLogger
from lightning.pytorch.strategies import SingleDeviceStrategy
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from sparsestreet.data.frame_cache import to_device
from sparsestreet.ops.triton import graphs
from sparsestreet.scene.density import GradientDensity
from sparsestreet.scene.density.vibrating import VibratingDensity
from sparsestreet.scene.effects import (
    Affine,
    AffineSettings,
    CameraPoses,
    CameraPosesSettings,
    Effect,
    Exposure,
    ExposureSettings,
    Sky,
    SkySettings,
)
from sparsestreet.scene.effects.poses import RecordedPoses
from sparsestreet.scene.learning_rate import LearningRate
from sparsestreet.scene.masks import (
    MaskSettings,
    SampledMask,
    SampledMaskSettings,
    StaticMaskSettings,
    TemporalMaskSettings,
)
from sparsestreet.scene.nodes import Node
from sparsestreet.scene.rendering import RenderOptions
from sparsestreet.training import losses
from sparsestreet.training.callbacks import DensityControl
from sparsestreet.training.far_depth import FarDepthTerm
from sparsestreet.training.losses import MaskSparsity, Photometric
from sparsestreet.training.moved_views import MovedViews, MovedViewTerm
from sparsestreet.training.optimizer import OptimizerSettings
from sparsestreet.training.schedule import Interval
from sparsestreet.training.system import StreetSystem
from sparsestreet.triangulation import SweepSettings
from sparsestreet.types import Frame, Shutter
from tests.scene.nodes.test_deformable import objects
from tests.scene.nodes.test_field import street as field
from tests.scene.nodes.test_vibrating import vibrating
from tests.scene.people import smpl, walker
from tests.scene.street import POSE_RATES, RATES, triangulated
from tests.training.moved_views.test_term import street, wall
from tests.training.stubs import StubTrainer, background, fit, frame_at, make_system, rigid
from tests.training.waiting import META, SPLAT, Waits, pretended, waits

SIZE = (16, 32)
RATE = LearningRate(0.01)
STATIC = StaticMaskSettings(1.0)
ALL_LOSSES = {name: kind() for name, kind in vars(losses).items() if losses.Loss in getattr(kind, "__bases__", ())}

__all__ = ["pretended"]  # a fixture


def masked(settings: MaskSettings = STATIC) -> dict[str, Node]:
    mask = {"mask": settings, "min_gaussians": 8}
    return {"background": background(20, **mask), "rigid": rigid(10, **mask)}


def nodes(sharp_shape: float = 0.0) -> dict[str, Node]:
    shared = {"density": GradientDensity(), "sharp_shape": sharp_shape}
    return {"background": background(20, **shared), "rigid": rigid(10, **shared)}


def poses() -> CameraPoses:
    recorded = RecordedPoses([(0, 0), (1, 0)], [0.0, 0.25], torch.eye(4).repeat(2, 1, 1))
    settings = CameraPosesSettings(learning_rates={"translations": RATE, "rotations": RATE}, weight=1.0)
    return CameraPoses(settings, recorded, torch.zeros(2, 6), torch.ones(2))


def seen_through(**effects: Effect) -> StreetSystem:
    return make_system(nodes(), effects=effects)


CASES: Mapping[str, tuple[Callable[[], StreetSystem], list[str]]] = {
    "plain": (lambda: make_system(nodes()), [SPLAT]),
    "regularizers": (lambda: make_system(nodes(sharp_shape=1.0)), [SPLAT]),
    "masks with K_min": (
        lambda: make_system(masked(), {"photometric": Photometric(), "sparsity": MaskSparsity()}),
        [SPLAT],
    ),
    "rows that were seen": (lambda: make_system(nodes(), optimizer=OptimizerSettings(visible_only=True)), [SPLAT]),
    "sky": (lambda: seen_through(sky=Sky(SkySettings(resolution=4))), [SPLAT]),
    "affine": (lambda: seen_through(affine=Affine(AffineSettings(weight=1.0, decay=1.0))), [SPLAT]),
    "exposure": (
        lambda: seen_through(exposure=Exposure(ExposureSettings(level=1.0, smooth=1.0), {0: [0.0, 0.25, 0.5]})),
        [SPLAT],
    ),
    "deformable": (lambda: make_system({"objects": objects()}), [SPLAT]),
    "vibrating": (lambda: make_system({"street": vibrating(density=VibratingDensity())}), [SPLAT]),
    "people": (lambda: make_system({"people": smpl(walker())}), [SPLAT]),
    "field": (lambda: make_system({"field": field(reach=None, deform_from=0.0)}), [SPLAT]),
    # The network is most of the step, and rows that are not near would cost more than a look at their number.
    "field with reach": (
        lambda: make_system({"field": field(deform_from=0.0)}),
        ["scene/nodes/deformable.py:_near: nonzero", SPLAT],
    ),
    # The camera is read on the host, and follows from what the optimizer wrote last.
    "camera poses": (
        lambda: seen_through(poses=poses()),
        ["scene/effects/poses.py:corrections: copy to the host", SPLAT],
    ),
    # Objects are rendered once more, alone.
    "all losses": (lambda: make_system(masked(), ALL_LOSSES), [SPLAT, SPLAT]),
    "moved views": (
        lambda: make_system(nodes(), moved_views=MovedViewTerm(MovedViews(every=1), street(wall(4.0)), seed=7)),
        [SPLAT, SPLAT],
    ),
    "far depth": (lambda: make_system(nodes(), far_depth=far_depth()), [SPLAT]),
}


def far_depth() -> FarDepthTerm:
    """Of two points that the view of frame 1 sees."""
    seen = [(0, 0, 1.5, 2.5), (1, 0, 3.0, 0.5)]
    return FarDepthTerm(triangulated([[0.0, 0.0, 30.0]] * 2, seen), [frame_at(1)], SweepSettings())


def frame_with(**changes: Any) -> Frame:
    return frame_at(1, depth=torch.ones(SIZE), sky=torch.zeros(SIZE, dtype=torch.bool), **changes)


def places_of_a_step(system: StreetSystem, frame: Frame, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Where the second step waits: the first makes tables that stay."""
    every = Interval(0.0, 1.0, 100)
    trainer = StubTrainer(system.to(META), [DensityControl(every, 1.0, Interval(0.0, 1.0, 1000))], max_steps=12)
    trainer.global_step = 9
    with waits(monkeypatch) as found:
        frame = to_device(frame, META)
        trainer.start()
        trainer.train(1, frame)
        found.places.clear()
        trainer.train(1, frame)
    assert [how["step"] for name, _, how in trainer.log_calls if name == "psnr"] == [9]
    assert system.screen_gradients == any(node.settings.density for node in system.scene.nodes.values())
    return found.places


@pytest.mark.parametrize("case", CASES)
def test_a_step_waits_once_a_rendering(case: str, pretended: None, monkeypatch: pytest.MonkeyPatch):
    make, expected = CASES[case]
    assert places_of_a_step(make(), frame_with(), monkeypatch) == expected


@pytest.mark.parametrize("case", ["lens", "shutter", "hood"])
def test_cameras_and_masks_of_the_car_wait_for_nothing(case: str, pretended: None, monkeypatch: pytest.MonkeyPatch):
    frame = frame_with()
    if case == "hood":
        frame = replace(frame, ego=torch.ones(SIZE, dtype=torch.bool))
    elif case == "lens":
        frame = replace(frame, camera=replace(frame.camera, distortion=torch.tensor([0.1, 0.0, 0.0, 0.0, 0.0])))
    else:
        shutter = Shutter(torch.ones(3), torch.zeros(3), seconds=0.1, span=0.1)
        frame = replace(frame, camera=replace(frame.camera, shutter=shutter))
    system = make_system(nodes(), effects={"sky": Sky(SkySettings(resolution=4))})
    assert places_of_a_step(system, frame, monkeypatch) == [SPLAT]


class HostCopies(TorchDispatchMode):
    """Operations that write the device's memory from the host's, or the reverse."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        answer = func(*args, **(kwargs or {}))
        name, given = func.overloadpacket.__name__, [one for one in tree_leaves(args) if isinstance(one, Tensor)]
        crosses = {one.device for one in [*given, answer] if isinstance(one, Tensor)} == {META, torch.device("cpu")}
        self.found += [name] * (crosses and name in ("_to_copy", "copy_"))
        return answer


def test_what_graphs_capture_waits_for_nothing(pretended: None, monkeypatch: pytest.MonkeyPatch):
    """A shutter and a moved view: two kinds of views, of two graphs forward and one backward. Nor does the host copy
    anything, which a capture refuses even where nobody waits."""
    captures: list[list[str]] = []

    class Captures:
        def captured(self, run: Callable[[], Any]) -> tuple[Callable[[], None], Any]:
            run()
            before = len(found.places)
            with HostCopies() as copies:
                answer = run()
            captures.append(found.places[before:] + copies.found)
            return lambda: None, answer

    monkeypatch.setattr(graphs, "Memory", Captures)
    monkeypatch.setattr(graphs, "_kept", type(graphs._kept)())
    monkeypatch.setattr(graphs, "COUNTS", Counter())
    shutter = Shutter(torch.ones(3), torch.zeros(3), seconds=0.1, span=0.1)
    frame = frame_with()
    frame = replace(frame, camera=replace(frame.camera, shutter=shutter))
    moved = MovedViewTerm(MovedViews(every=1), street(wall(4.0)), seed=7)
    effects = {"sky": Sky(SkySettings(resolution=4))}
    system = make_system(nodes(), effects=effects, options=RenderOptions(replay=True), moved_views=moved)
    trainer = StubTrainer(system.to(META), [], max_steps=90)
    trainer.global_step = 50
    with waits(monkeypatch) as found:
        frame = to_device(frame, META)
        trainer.start()
        for _ in range(3):
            trainer.train(1, frame)
        found.places.clear()
        trainer.train(1, frame)
    assert captures == [[]] * 6
    assert (graphs.COUNTS["captured"], graphs.COUNTS["replayed"], graphs.COUNTS["again"]) == (6, 6, 0)
    assert found.places == [SPLAT] * 2


def test_a_sampled_mask_does_not_wait(pretended: None, monkeypatch: pytest.MonkeyPatch):
    # A GPU has a generator that a seed starts; this device has none.
    monkeypatch.setattr(SampledMask, "_uniform", lambda mask, rows, purpose: torch.rand_like(rows.mask_logits))
    system = make_system(masked(SampledMaskSettings(1.0)), {"sparsity": MaskSparsity()})
    assert places_of_a_step(system, frame_with(), monkeypatch) == [SPLAT]


def test_a_mask_over_time_does_not_wait(pretended: None, monkeypatch: pytest.MonkeyPatch):
    learned = {"mask_features": RATE, "mask": RATE, "joint_deltas": RATE, **RATES, **POSE_RATES}
    mask = {"mask": TemporalMaskSettings(1.0), "masked": True, "learning_rates": learned}
    system = make_system({"people": smpl(walker(), **mask)}, {"sparsity": MaskSparsity()})
    assert places_of_a_step(system, frame_with(), monkeypatch) == [SPLAT]


@pytest.mark.filterwarnings("ignore")  # of an epoch of one frame, and workers
def test_lightning_and_its_loggers_add_no_wait(pretended: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Its own loop on the pretended device, which validates nothing; two of seven steps log."""
    monkeypatch.setattr(CPUAccelerator, "setup_device", lambda self, device: None)
    monkeypatch.setattr("lightning.pytorch.loops.fit_loop.has_len_all_ranks", lambda *_, **__: True)
    strategy = SingleDeviceStrategy(device=META, accelerator=CPUAccelerator())
    settings: dict[str, Any] = {"logger": CSVLogger(tmp_path, "", ""), "log_every_n_steps": 3, "accelerator": "auto"}
    with waits(monkeypatch) as found:
        ends = Ends(found)
        fit(make_system(nodes()), [ends], 7, to_device(frame_with(), META), strategy=strategy, **settings)
    assert ends.places == [[SPLAT]] * 7
    rows = list(csv.DictReader((tmp_path / "metrics.csv").open()))
    assert [(row["step"], row["gaussians"]) for row in rows] == [("2", "30.0"), ("5", "30.0")]


class Ends(Callback):
    """Where each step has waited, from the end of the one before."""

    def __init__(self, waits: Waits) -> None:
        self.waits, self.places = waits, []

    def on_train_start(self, trainer: Trainer, pl_module: StreetSystem) -> None:
        self.waits.places.clear()

    def on_train_batch_end(self, trainer: Trainer, pl_module: StreetSystem, *step: Any) -> None:
        self.places.append(self.waits.places.copy())
        self.waits.places.clear()


@pytest.mark.parametrize(
    ("waiting", "done"),
    [
        ("_local_scalar_dense", lambda values: values[0].item()),
        ("_local_scalar_dense", lambda values: bool(values.sum() > 0)),
        ("nonzero", lambda values: (values > 0).nonzero()),
        ("nonzero", lambda values: torch.where(values > 0)),
        ("index by a mask", lambda values: values[values > 0]),
        ("index by a mask", lambda values: values.index_put_((values > 0,), values)),
        ("index of the host", lambda values: values[torch.tensor([0, 1])]),
        ("index of the host", lambda values: values[[0, 1]]),
        ("copy to the host", lambda values: values.cpu()),
        ("copy to the host", lambda values: torch.zeros(3).copy_(values)),
        ("copy to the device", lambda values: torch.ones(3).to(values)),
        ("copy to the device", lambda values: values.copy_(torch.ones(3))),
        ("copy to the device", lambda values: torch.tensor([1.0], device=META)),
        ("copy to the device", lambda values: values.new_tensor([1.0])),
        ("_unique2", lambda values: values.unique()),
        ("equal", lambda values: torch.equal(values, values)),
        (None, lambda values: values.masked_fill_(values > 0, 0.0)),
        (None, lambda values: torch.ones(3).to(values, non_blocking=True)),
        (None, lambda values: values.copy_(torch.ones(3), non_blocking=True)),
        (None, lambda values: torch.where(values > 0, values, 1.0) + torch.tensor(2.0)),
        (None, lambda values: torch.zeros(3, device=META).index_add(0, values.long(), values).cumsum(0).sort()),
        (None, lambda values: torch.ones(3).nonzero()),
    ],
)
def test_what_would_wait_is_noted(waiting: str | None, done: Callable[[Tensor], Any], monkeypatch: pytest.MonkeyPatch):
    values = torch.empty(3, device=META)
    with waits(monkeypatch) as found:
        done(values)
    assert [place.split(": ")[-1] for place in found.places] == ([] if waiting is None else [waiting])
