"""A street small enough that a training takes seconds."""

from pathlib import Path

import pytest

from sparsestreet.cli.train import train


@pytest.fixture(scope="session")
def tiny_street(tmp_path_factory) -> list[str]:
    """Overrides that select it; it is traced once per session."""
    root = tmp_path_factory.mktemp("street") / "tiny"
    return [
        f"data.log.root={root}",
        "data.log.settings.num_frames=12",
        "data.log.settings.width=64",
        "data.log.settings.height=40",
        "data.log.settings.num_cameras=2",
        "data.log.settings.lidar_beams=24",
        "data.log.settings.lidar_azimuth_steps=300",
        "scale.background.lidar_points=1500",
        "scale.background.near_points=200",
        "scale.background.far_points=300",
        "scale.background.min_gaussians=200",
        "scale.background.max_gaussians=6000",
        "scale.background.min_gaussians=200",
        "scale.background.max_gaussians=6000",
        "scale.rigid={points_per_instance: 150, min_gaussians: 60, max_gaussians: 3000, mask_visible_only: true}",
        "scale.sky_resolution=8",
        "schedule.max_steps=60",
        "schedule.densify_in.every=10",
        "schedule.cull_in.every=10",
        "schedule.mask_in.every=10",
        "trainer.val_check_interval=60",
    ]


@pytest.fixture
def run_train(tiny_street):
    """Train on the tiny street into a folder."""

    def run(out: Path, *overrides: str) -> Path:
        assert train([*tiny_street, f"hydra.run.dir={out}", *overrides]) == 0
        return out

    return run
