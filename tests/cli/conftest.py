"""A street small enough that a training takes seconds, and the runs on it that many tests look at."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jaxtyping
import pytest
from lightning import Callback, Trainer

from sparsestreet.cli.commands.data import data
from sparsestreet.cli.commands.train import train
from sparsestreet.training.lightning import callbacks_of
from tests.conftest import unchecked
from tests.shared import made_once


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if "tiny_street" in getattr(item, "fixturenames", ()):
            item.add_marker("lengthy")


class OneStepChecked(Callback):
    """Shapes are checked up to the first step of a training. The next ones are alike, and of evaluations one is checked
    (test_train.py): checks take half of the time of both."""

    def on_train_batch_end(self, *arguments: Any) -> None:
        jaxtyping.config.update("jaxtyping_disable", True)


@pytest.fixture(autouse=True, scope="package")
def one_step_checked() -> Iterator[None]:
    fit = Trainer.fit

    def checked_once(trainer: Trainer, *arguments: Any, **options: Any) -> None:
        callbacks_of(trainer).append(OneStepChecked())
        fit(trainer, *arguments, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Trainer, "fit", checked_once)
        yield


@pytest.fixture(autouse=True)
def _checked_again() -> Iterator[None]:
    """Whatever a training left, of this test or of a fixture before it."""
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture(scope="session")
def tiny_street(tmp_path_factory) -> list[str]:
    """Overrides that select it; it is traced once per session."""
    root = made_once(tmp_path_factory, "streets", trace) / "tiny"
    return [
        *street_at(root),
        "effects.sky.resolution=8",
        *TINY_BACKGROUND,
        f"cache={root.parent / 'kept'}",
        "schedule.max_steps=60",
        "schedule.refine_in.every=10",
        "schedule.mask_in.every=10",
        "trainer.val_check_interval=60",
        "keep_checkpoints=true",  # moments of optimizers are compared
        *TIMED_ONCE,
    ]


def trace(folder: Path) -> None:
    with unchecked():
        assert data(["make", *street_at(folder / "tiny")]) == 0


def street_at(root: Path) -> list[str]:
    return [
        f"data.log.root={root}",
        "data.log.settings.num_frames=12",
        "data.log.settings.width=64",
        "data.log.settings.height=40",
        "data.log.settings.num_cameras=2",
        "data.lidar.beams=24",
        "data.lidar.azimuth_steps=300",
    ]


@pytest.fixture(scope="session")
def finished(tiny_street, tmp_path_factory) -> Path:
    """A run with all stages, for those who look: not to be changed."""

    def make(out: Path) -> None:
        assert train([*tiny_street, *ALL_STAGES, f"out={out}"]) == 0

    return made_once(tmp_path_factory, "finished", make)


TIMED_ONCE = [f"evaluation.timing.{name}={count}" for name, count in (("warmup", 1), ("repeats", 2), ("rounds", 1))]


TINY_BACKGROUND = [
    "node.background.num_points=2000",
    "node.background.min_gaussians=200",
    "node.background.max_gaussians=6000",
]
TINY_RIGID = [
    "node.rigid.points_per_instance=150",
    "node.rigid.min_gaussians=60",
    "node.rigid.max_gaussians=3000",
]


ALL_STAGES = [
    *TINY_RIGID,
    "sparsify=removal",
    # A budget relative to the error would take most of a scene that is hardly trained.
    "schedule.removal_db=0.0",
    # It ends with 260 Gaussians, which must be steadier than those of a street: 0.37 dB.
    "schedule.rates.background_log_scales=1e-2",
    # With a reset, so that a pause after one can be interrupted too.
    "schedule.reset_in.start=0.3",
    "schedule.reset_in.stop=0.35",
    "schedule.reset_in.every=10",
    "schedule.pause_after_reset=12",
]
TINY_PEOPLE = [
    "node.smpl.body.num_vertices=500",
    "node.smpl.min_gaussians=50",
    "node.deformable.points_per_instance=100",
    "node.deformable.min_gaussians=50",
]
TINY_NODES = {"streetgs": TINY_RIGID, "omnire": [*TINY_RIGID, *TINY_PEOPLE]}
"""Method -> what makes its nodes of objects small."""


def method_of(overrides: Sequence[str]) -> str:
    """That of a command: StreetGS unless another is named."""
    named = [word.partition("=")[2] for word in overrides if word.startswith("method=")]
    return named[0] if named else "streetgs"


@pytest.fixture(scope="session")
def run_train(tiny_street):
    """Train on the tiny street into a folder; what has no options is named: ``method=3dgs``, ``image_points=none``."""

    def run(out: Path, *overrides: str) -> Path:
        objects = TINY_NODES.get(method_of(overrides), [])
        without_points = "image_points=none" in overrides
        street = [word for word in tiny_street if not (without_points and word.startswith("image_points."))]
        assert train([*street, *objects, f"out={out}", *overrides]) == 0
        return out

    return run
