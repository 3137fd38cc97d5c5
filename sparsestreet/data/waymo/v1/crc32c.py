"""The checksum of TFRecord files: CRC-32C (Castagnoli), rotated and offset.

A CRC without its first and last inversion is linear over GF(2). So the blocks of a record are worked on side by side,
and joined by the matrix that says what a block's length of zero bytes does to a CRC.
"""

from functools import lru_cache

import numpy as np
from jaxtyping import UInt32

_POLYNOMIAL = 0x82F63B78
"""0x1EDC6F41 with its bits reversed."""
_BLOCK = 2048
_MASK_DELTA = 0xA282EAD8


def masked_crc32c(data: bytes | memoryview) -> int:
    """As it stands behind the length, and behind the bytes, of a record.

    >>> hex(masked_crc32c(b"123456789"))  # the CRC is 0xe3069283
    '0xc78ab0e5'
    """
    crc = _linear_crc(data) ^ _applied(_zeros(len(data)), np.array([0xFFFFFFFF], np.uint32))[0] ^ 0xFFFFFFFF
    return ((int(crc) >> 15 | int(crc) << 17) + _MASK_DELTA) & 0xFFFFFFFF


def _linear_crc(data: bytes | memoryview) -> int:
    """Without inversions; zero bytes ahead do not change it, so that it may be filled up to whole blocks."""
    if not len(data):
        return 0
    count = -(-len(data) // _BLOCK)
    size = _BLOCK if count > 1 else 2 * (-(-len(data) // 2))
    padded = np.zeros(count * size, np.uint8)
    padded[len(padded) - len(data) :] = np.frombuffer(data, np.uint8)
    # Two bytes a step.
    pairs, table = np.ascontiguousarray(padded.view("<u2").reshape(count, -1).T), _table()
    crcs = np.zeros(count, np.uint32)
    for column in pairs:
        crcs = table[(crcs ^ column) & 0xFFFF] ^ (crcs >> 16)
    while len(crcs) > 1:
        if len(crcs) % 2:
            crcs = np.concatenate((np.zeros(1, np.uint32), crcs))
        crcs = _applied(_zeros(size), crcs[::2]) ^ crcs[1::2]
        size *= 2
    return int(crcs[0])


@lru_cache(maxsize=1)
def _table() -> UInt32[np.ndarray, "65536"]:
    """Of all two bytes, the first one lowest."""
    crcs = np.arange(65_536, dtype=np.uint32)
    for _ in range(16):
        crcs = np.where(crcs & 1, crcs >> 1 ^ np.uint32(_POLYNOMIAL), crcs >> 1).astype(np.uint32)
    return crcs


@lru_cache(maxsize=256)
def _zeros(length: int) -> UInt32[np.ndarray, "32"]:
    """The matrix of ``length`` zero bytes, as the images of the 32 single bits."""
    if length == 0:
        return np.uint32(1) << np.arange(32, dtype=np.uint32)
    if length == 1:
        bits = _zeros(0)
        # A zero byte moves the CRC by eight bits, which is what two bytes do to one whose second byte is ahead.
        return _table()[bits << 8 & 0xFFFF] ^ (bits >> 8)
    half = _zeros(length // 2)
    both = _applied(half, half)
    return _applied(_zeros(1), both) if length % 2 else both


def _applied(matrix: UInt32[np.ndarray, "32"], crcs: UInt32[np.ndarray, " n"]) -> UInt32[np.ndarray, " n"]:
    result = np.zeros_like(crcs)
    for bit, image in enumerate(matrix):
        result ^= (crcs >> np.uint32(bit) & np.uint32(1)) * image
    return result
