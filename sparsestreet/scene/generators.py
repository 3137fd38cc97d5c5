"""Random numbers with a separate stream for each part of the scene."""

import zlib

import torch


def named_seed(seed: int, name: str) -> int:
    """Return the seed of the stream with this name."""
    return seed + zlib.crc32(name.encode())


def named_generator(seed: int, name: str) -> torch.Generator:
    """Return the random stream of the part with this name; it does not depend on what other parts draw.

    >>> one, again, other = (named_generator(0, name) for name in ("sky", "sky", "field"))
    >>> one.initial_seed() == again.initial_seed(), one.initial_seed() == other.initial_seed()
    (True, False)
    """
    return torch.Generator().manual_seed(named_seed(seed, name))
