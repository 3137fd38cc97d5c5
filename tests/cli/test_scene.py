"""What a command imports before it opens the scene of a run."""

import pytest
import torch
from safetensors.torch import save_file

from sparsestreet.cli.commands import scenes
from sparsestreet.cli.commands.evaluate import evaluate
from sparsestreet.cli.commands.export import export
from sparsestreet.cli.commands.objects import objects
from sparsestreet.cli.commands.render import render
from sparsestreet.cli.commands.scenes import open_scene
from sparsestreet.cli.commands.serve import serve
from sparsestreet.cli.commands.view import view
from sparsestreet.export.ply import scene_gaussians, write_ply
from sparsestreet.scene.storage import save_scene
from sparsestreet.scene.views import write_views
from tests.export.street import stored_street, street_views


@pytest.mark.parametrize(
    ("command", "more"),
    [
        (render, ["out"]),
        (view, ["port=0"]),
        (export, ["a.spz"]),
        (export, ["a.usdz"]),
        (export, ["a.street"]),
        (objects, []),
        (serve, ["port=0"]),
        (evaluate, []),
    ],
)
def test_every_command_names_a_file_of_another_kind(command, more, tmp_path, monkeypatch, capsys):
    """Our own .ply, which is for viewers, comes back to us."""
    monkeypatch.chdir(tmp_path)
    write_ply("car.ply", scene_gaussians(stored_street(), 0.0))
    assert command(["car.ply", *more]) == 1
    said = capsys.readouterr().err
    assert "car.ply holds Gaussians of one moment for viewers, or points, not a scene: open the run's folder" in said
    assert len(said.strip().splitlines()) == 1
    assert [one.name for one in tmp_path.iterdir()] == ["car.ply"]


@pytest.mark.parametrize("command", [serve, evaluate, objects])
def test_so_it_does_tensors_of_another_program(command, tmp_path, monkeypatch, capsys):
    """Also where it would look for files beside the scene first."""
    monkeypatch.chdir(tmp_path)
    save_file({"weight": torch.zeros(3)}, "model.safetensors")
    assert command(["model.safetensors"]) == 1
    assert "model.safetensors: the file holds tensors but no scene of ours" in capsys.readouterr().err


def test_so_does_an_edit_that_inserts_it(tmp_path, capsys):
    write_ply(tmp_path / "car.ply", scene_gaussians(stored_street(), 0.0))
    save_scene(tmp_path / "scene.safetensors", stored_street())
    write_views(tmp_path / "views.json", street_views(), [], frame_rate=10.0)
    (tmp_path / "edits.yaml").write_text("insert: {new: {scene: car.ply, of: car, path: [[0, 1, 1]]}}")
    assert render([str(tmp_path), str(tmp_path / "out"), f"edits={tmp_path / 'edits.yaml'}"]) == 1
    assert "car.ply holds Gaussians of one moment for viewers" in capsys.readouterr().err


@pytest.mark.parametrize("gpu", [False, True])
@pytest.mark.parametrize("asked", [None, "cpu", "cuda"])
def test_a_scene_opens_where_it_is_asked_for(tmp_path, monkeypatch, gpu, asked):
    """Of a run its configuration is looked at first; a file alone says nothing of them."""
    done: list[object] = []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpu)
    monkeypatch.setattr(scenes, "open_run_config", lambda run, parts: done.append((run, *parts)))
    stored = stored_street()
    monkeypatch.setattr(scenes, "load_scene", lambda *given: done.append(given) or stored)
    (tmp_path / "run" / ".hydra").mkdir(parents=True)
    device = asked or ("cuda" if gpu else "cpu")
    if device == "cuda" and not gpu:
        with pytest.raises(ValueError, match="device=cuda needs a CUDA device and torch sees none: say device=cpu"):
            open_scene(tmp_path / "run", asked)
        return
    assert open_scene(tmp_path / "run", asked, ["mine"]) is stored
    assert open_scene(tmp_path / "run" / "scene.safetensors", asked) is stored
    run, file = tmp_path / "run", tmp_path / "run" / "scene.safetensors"
    assert done == [(run, "mine"), (run, torch.device(device)), (file, torch.device(device))]
