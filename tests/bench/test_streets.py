"""Stored streets that are measured: which views, how large, of how many splats; and the line about their frames."""

from pathlib import Path

import torch

from benchmarks import streets
from sparsestreet.bench.records import read_records
from sparsestreet.bench.scenes import BenchScene, frustum_camera
from sparsestreet.cli.commands.export import export
from sparsestreet.geometry.cameras import project
from sparsestreet.geometry.quaternions import to_matrix
from sparsestreet.scene.storage import save_scene
from sparsestreet.scene.views import read_views, write_views
from sparsestreet.types import Gaussians
from tests.export.street import stored_street, street_views


def made_street(folder: Path) -> Path:
    """A run of 37 splats, four cameras, five frames, of which the front camera's third is held out."""
    save_scene(folder / "scene.safetensors", stored_street())
    views = street_views()
    write_views(folder / "views.json", [*views[:8], *views[9:]], [views[8]])
    return folder


def test_the_front_camera_sees_the_first_frame_and_the_middle_one_also_in_larger_images(tmp_path):
    run = made_street(tmp_path / "run")
    first, middle, *larger = streets.front_streets(run, 2)
    views = [view for view in read_views(run / "views.json").all if view.camera_index == 0]
    for street, view, wide in zip((first, middle), (views[0], views[2]), larger, strict=True):
        assert street.source == f"trained: run on hand-made, frame {view.frame_index}"
        assert torch.equal(street.camera.camera_from_world, view.camera.camera_from_world)
        assert wide.gaussians is street.gaussians
        assert (wide.camera.width, wide.camera.height) == (2 * street.camera.width, 2 * street.camera.height)
        pixels, depths, _ = project(street.camera, street.gaussians.means)
        seen = depths > 0
        torch.testing.assert_close(project(wide.camera, street.gaussians.means)[0][seen], 2 * pixels[seen])


def test_a_scene_file_and_a_street_show_what_their_run_shows(tmp_path):
    run = made_street(tmp_path / "run")
    assert export([str(run), str(tmp_path / "small.street")]) == 0
    whole, *_ = streets.front_streets(run)
    for scene, exact in ((run / "scene.safetensors", True), (tmp_path / "small.street", False)):
        found, *_ = streets.front_streets(scene)
        assert torch.equal(found.camera.camera_from_world, whole.camera.camera_from_world)
        assert len(found.gaussians) == len(whole.gaussians)
        assert torch.equal(found.gaussians.means, whole.gaussians.means) == exact


def test_small_splats_are_together_as_wide_as_theirs():
    """Two ellipsoids, turned, cut into 60 x 60: mean and covariance of places, and that of sizes, add up."""
    generator = torch.Generator().manual_seed(3)
    quaternions = torch.nn.functional.normalize(torch.randn(2, 4, generator=generator), dim=1)
    scales = torch.tensor([[0.5, 0.1, 2.0], [1.0, 0.3, 0.2]])
    means = torch.tensor([[1.0, 2.0, 9.0], [-3.0, 0.5, 5.0]])
    whole = Gaussians(means, quaternions, scales, torch.tensor([0.3, 0.9]), torch.rand(2, 4, 3, generator=generator))
    street = BenchScene("a street", "of a run", whole, frustum_camera(40, 56))
    small = streets.refined(street, 60)
    assert streets.refined(street, 1) is street
    assert (small.source, small.camera.width, small.camera.height) == ("of a run, refined 60x60", 2400, 3360)
    assert len(small.gaussians) == 7200
    for row in range(2):
        own = slice(3600 * row, 3600 * (row + 1))
        rotation = to_matrix(quaternions[row])
        covariance = rotation @ torch.diag(scales[row] ** 2) @ rotation.T
        places = small.gaussians.means[own]
        # 3,600 draws: a mean is off by 1 / 60 of a deviation, a variance by sqrt(2 / 3600) of itself; four times that.
        assert ((places.mean(0) - means[row]) @ rotation / scales[row]).abs().max() < 4 / 60
        size = rotation @ torch.diag(small.gaussians.scales[own][0] ** 2) @ rotation.T
        off = rotation.T @ (torch.cov(places.T) + size - covariance) @ rotation / (scales[row][:, None] * scales[row])
        assert off.abs().max() < 4 * (2 / 3600) ** 0.5
        assert torch.equal(small.gaussians.dense_sh()[own], whole.dense_sh()[row].expand(3600, 4, 3))
        assert bool((small.gaussians.opacities[own] == whole.opacities[row]).all())


def test_frames_are_timed_at_every_width_and_said(tmp_path, capsys):
    run = made_street(tmp_path / "run")
    words = [f"scenes={run}", "widths=24,72", "repeats=2", f"out={tmp_path}"]
    assert streets.main(words) == 0
    small, large = read_records(tmp_path / "frames.jsonl")
    assert [(one["width"], one["height"]) for one in (small, large)] == [(24, 16), (72, 48)]
    assert small["gaussians"] == {"background": 30, "rigid": 7}
    assert (small["latency"]["views"], small["memory_peak"]) == (20, None)
    said = capsys.readouterr().out.splitlines()
    frame = small["latency"]["clocks"]["frame"]["p50"]
    assert said[0].startswith(f"run: 37 Gaussians, 24x16: frame {frame:.3f} ms ({1000 / frame:,.0f} a second), splat")
    assert streets.main([f"scenes={run}", "widths=0"]) == 2
    assert streets.main([f"scenes={tmp_path / 'nowhere'}"]) == 1
