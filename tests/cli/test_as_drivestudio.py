"""Every option by which a run reads, starts and renders as DriveStudio does, set at once."""

from pathlib import Path

import pytest

from sparsestreet.cli.config.validate import override_problem
from sparsestreet.ops import SplatSettings
from sparsestreet.records.run import RUN
from sparsestreet.records.summary import SUMMARY

AS_DRIVESTUDIO = [
    "method=omnire",
    "image_points=none",
    "data.log.undistort=true",
    "data.log.lidar_ahead=[-2,80]",
    "data.log.extent=first_pose",
    "node.background.clear_swept_boxes=true",
    "node.background.sources.lidar.number=600",
    "node.background.sources.lidar.box_enlargement=null",
    "node.background.sources.images.number=0",
    *(f"node.background.sources.{name}.number=200" for name in ("near", "far")),
    *(f"node.background.sources.{name}.largest_scale=null" for name in ("near", "far")),
    *(f"node.background.sources.{name}.blind=true" for name in ("near", "far")),
    "node.rigid.box_points=0",
    "node.rigid.box_margin=0.0",
    "node.deformable.box_points=0",
    "node.smpl.random_colors=true",
    "render.preset=drivestudio",
    "effects.affine.when=on",
]


@pytest.mark.parametrize("override", [*AS_DRIVESTUDIO, "node.background.random_life_peaks=false"])
def test_each_is_an_option(override: str):
    method = "method=pvg" if "life_peaks" in override else "method=omnire"
    assert override_problem([method, override]) is None


@pytest.mark.slow
def test_they_train_together(run_train, tmp_path: Path):
    run = run_train(tmp_path / "run", *AS_DRIVESTUDIO, "schedule.max_steps=4")
    config = RUN.read(run).config
    assert config["render.settings.alpha_max"] == SplatSettings.preset("drivestudio").alpha_max
    assert config["data.log.lidar_ahead"] == [-2, 80]
    summary = SUMMARY.read(run)
    assert summary.bytes_by_part["affine"] == 12 * 4
    # At most what was asked for; guesses are three times as many, of which views show some.
    assert 600 < summary.gaussians["background"] <= 600 + 3 * 400
