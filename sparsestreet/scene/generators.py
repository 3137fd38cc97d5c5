"""Random numbers, a stream for each part of the scene."""

import zlib

import torch


def named_generator(seed: int, name: str) -> torch.Generator:
    """The stream of a part of this name: what other parts draw leaves it as it is."""
    return torch.Generator().manual_seed(seed + zlib.crc32(name.encode()))
