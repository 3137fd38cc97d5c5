"""A street small enough that a training takes seconds."""

from collections.abc import Sequence
from pathlib import Path

import pytest

from sparsestreet.cli.data import data
from sparsestreet.cli.train import train
from tests.conftest import unchecked


@pytest.fixture(scope="session")
def tiny_street(tmp_path_factory) -> list[str]:
    """Overrides that select it; it is traced once per session."""
    root = tmp_path_factory.mktemp("street") / "tiny"
    street = [
        f"data.log.root={root}",
        "data.log.settings.num_frames=12",
        "data.log.settings.width=64",
        "data.log.settings.height=40",
        "data.log.settings.num_cameras=2",
        "data.lidar.beams=24",
        "data.lidar.azimuth_steps=300",
    ]
    with unchecked():
        assert data(["make", *street]) == 0
    return [
        *street,
        "effects.sky.resolution=8",
        *TINY_BACKGROUND,
        f"image_points.cache={root.parent / 'points'}",
        "schedule.max_steps=60",
        "schedule.refine_in.every=10",
        "schedule.mask_in.every=10",
        "trainer.val_check_interval=60",
        *TIMED_ONCE,
    ]


TIMED_ONCE = [f"evaluation.timing.{name}={count}" for name, count in (("warmup", 1), ("repeats", 2), ("rounds", 1))]
TIMED_BY_DEFAULT = [f"~{word.partition('=')[0]}" for word in TIMED_ONCE]


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


@pytest.fixture
def run_train(tiny_street):
    """Train on the tiny street into a folder; what has no options is named: ``method=3dgs``, ``image_points=none``."""

    def run(out: Path, *overrides: str) -> Path:
        objects = TINY_NODES.get(method_of(overrides), [])
        without_points = "image_points=none" in overrides
        street = [word for word in tiny_street if not (without_points and word.startswith("image_points."))]
        assert train([*street, *objects, f"out={out}", *overrides]) == 0
        return out

    return run
