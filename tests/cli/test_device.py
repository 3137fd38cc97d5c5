"""The device that a command asks for."""

from dataclasses import replace

import pytest
import torch

from sparsestreet.cli.device import device_of
from sparsestreet.cli.evaluate import _device
from sparsestreet.cli.scene import open_scene
from tests.evaluation.frames import make_run


@pytest.fixture
def without_gpu(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)


def test_a_device_that_is_there(monkeypatch):
    assert device_of("cpu", "this", "") == torch.device("cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert device_of("cuda:1", "this", "") == torch.device("cuda", 1)


def test_any_other_is_refused(without_gpu):
    with pytest.raises(ValueError, match="device must be cpu or cuda, got 'tpu'"):
        device_of("tpu", "this", "")
    with pytest.raises(ValueError, match="this needs a CUDA device and torch sees none: buy one"):
        device_of("cuda", "this", "buy one")


def test_commands_say_what_asked_for_it(without_gpu, tmp_path):
    with pytest.raises(ValueError, match=r"device=cuda needs a CUDA device .*: say device=cpu"):
        open_scene(tmp_path, "cuda")
    run = replace(make_run(), device="cuda: NVIDIA H100")
    with pytest.raises(ValueError, match=r"trained on cuda: NVIDIA H100 needs .* another machine's; say device=cpu"):
        _device(run, None)
    assert _device(run, "cpu") == torch.device("cpu")
