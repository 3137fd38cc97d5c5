"""The device that a command asks for."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from lightning import Trainer
from omegaconf import OmegaConf

from sparsestreet.cli.commands.evaluate import _device
from sparsestreet.cli.commands.scenes import open_scene
from sparsestreet.cli.config.assemble import trainer_of
from sparsestreet.cli.config.validate import device_of, device_problem
from sparsestreet.cli.runs import devices as device_module
from sparsestreet.cli.runs.devices import devices_of_job
from tests.cli.configurations import composed
from tests.evaluation.frames import make_run


@pytest.fixture
def without_gpu(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)


def test_a_device_that_is_there(monkeypatch):
    assert device_of("cpu", "this", "") == torch.device("cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert device_of("cuda:1", "this", "") == torch.device("cuda", 1)


def test_any_other_is_refused(without_gpu):
    for name in ("tpu", "mps"):
        with pytest.raises(ValueError, match=f"device must be cpu or cuda, got '{name}'"):
            device_of(name, "this", "")
    with pytest.raises(ValueError, match="this needs a CUDA device and torch sees none: buy one"):
        device_of("cuda", "this", "buy one")


def test_commands_say_what_asked_for_it(without_gpu, tmp_path):
    with pytest.raises(ValueError, match=r"device=cuda needs a CUDA device .*: say device=cpu"):
        open_scene(tmp_path, "cuda")
    run = replace(make_run(), device="cuda: NVIDIA H100")
    with pytest.raises(ValueError, match=r"trained on cuda: NVIDIA H100 needs .* another machine's; say device=cpu"):
        _device(run, None)
    assert _device(run, "cpu") == torch.device("cpu")


@pytest.fixture
def four_gpus(monkeypatch, tmp_path):
    """As torch would see them, and a folder of locks that is this test's."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 4)
    monkeypatch.setattr(device_module.tempfile, "gettempdir", lambda: str(tmp_path))
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)


def trainer(**options: Any):
    return OmegaConf.create({"accelerator": "gpu", "devices": 1, **options})


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({}, None),
        ({"devices": "auto"}, None),
        ({"devices": "1"}, None),
        ({"devices": [3]}, None),
        ({"devices": "3,"}, None),
        ({"devices": [4]}, r"trainer.devices=[4] is not there: torch sees 4 of them, numbered from 0"),
        ({"devices": [-1]}, "is not there"),
        ({"devices": 2}, "training runs on one device, got trainer.devices=2: trainer=ddp shares a run among several"),
        ({"devices": -1}, "training runs on one device"),
        ({"devices": "-1"}, "training runs on one device"),
        ({"devices": [0, 1]}, "training runs on one device"),
        ({"devices": []}, "training runs on one device"),
        ({"devices": "0,1"}, "training runs on one device"),
        ({"devices": 4, "strategy": "ddp"}, None),
        ({"devices": "auto", "strategy": "ddp"}, None),
        ({"devices": 2, "strategy": "auto"}, "training runs on one device"),
        ({"devices": [3], "accelerator": "cpu"}, "names a GPU, and this run has none: say trainer=gpu"),
        ({"devices": "auto", "accelerator": "cpu"}, None),
        ({"devices": [3], "accelerator": "auto"}, None),
    ],
)
def test_what_is_asked_of_devices(options, said, four_gpus):
    problem = device_problem(trainer(**options))
    assert problem == said if said is None else said in str(problem)


def given(**options: Any):
    return devices_of_job(trainer(**options))


def test_jobs_beside_each_other_get_a_device_each(four_gpus):
    with given() as one, given(devices="auto") as two, given(devices=[2]) as three:
        assert (one, two, three) == ([0], [1], [2])
        with given() as four, given() as five, given() as six:  # more jobs than devices share them evenly
            assert (four, five, six) == ([3], [0], [1])
        with given() as again, given(devices=[1]) as named:
            assert (again, named) == ([3], [1])
    with given() as free:
        assert free == [0]


def test_a_device_has_one_name_whoever_sees_it(four_gpus, monkeypatch):
    with given(devices=[1]):
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "1,2")
        monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
        with given() as other:
            assert other == [1]


def test_a_job_that_fails_gives_its_device_back(four_gpus):
    with pytest.raises(RuntimeError), given():
        raise RuntimeError
    with given() as again:
        assert again == [0]


def test_others_have_what_is_asked(four_gpus, tmp_path):
    with given(accelerator="cpu", devices="auto") as cpu, given(strategy="ddp", devices=4) as shared:
        assert (cpu, shared) == ("auto", 4)
    assert list(tmp_path.iterdir()) == []


def test_lightning_gets_one_device(four_gpus):
    """Of several that are there, whatever is asked: no run shares its steps unasked."""
    cfg = composed("trainer=gpu", "trainer.devices=auto")
    with given(), devices_of_job(cfg.trainer) as devices:
        made = trainer_of(cfg, devices)
    assert made.func is Trainer
    assert (made.keywords["accelerator"], made.keywords["devices"]) == ("gpu", [1])


def test_auto_is_one_device_of_a_cpu():
    cfg = composed("trainer.devices=auto")
    with devices_of_job(cfg.trainer) as devices:
        made = trainer_of(cfg, devices)(logger=False)
    assert (made.num_devices, made.world_size) == (1, 1)
