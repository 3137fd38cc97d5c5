"""What a command imports before it opens the scene of a run."""

import pytest
import torch

from sparsestreet.cli import scene
from sparsestreet.cli.scene import open_scene
from tests.export.street import stored_street


@pytest.mark.parametrize("gpu", [False, True])
@pytest.mark.parametrize("asked", [None, "cpu", "cuda"])
def test_a_scene_opens_where_it_is_asked_for(tmp_path, monkeypatch, gpu, asked):
    """Of a run its configuration is looked at first; a file alone says nothing of them."""
    done: list[object] = []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpu)
    monkeypatch.setattr(scene, "open_run_config", lambda run, parts: done.append((run, *parts)))
    stored = stored_street()
    monkeypatch.setattr(scene, "load_scene", lambda *given: done.append(given) or stored)
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
