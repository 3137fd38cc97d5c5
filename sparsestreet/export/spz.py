"""``.spz``, version 3: Niantic's format of one frame (github.com/nianticlabs/spz, README, "File Format"; MIT).

A gzip stream: a header of 16 bytes, then attribute by attribute: positions as 24-bit fixed point, alphas, colors,
scales, rotations as the smallest three parts, harmonics. Axes are right, up, back.
"""

import gzip
import math
import re
import shutil
import struct
import subprocess
import tempfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8

from sparsestreet.atomic import atomic_file
from sparsestreet.export.frame import turned
from sparsestreet.export.ply import check_gaussians
from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.cameras import inverse
from sparsestreet.ops import SplatSettings, splat
from sparsestreet.types import Camera, Gaussians

MAGIC, VERSION = 0x5053474E, 3
MAX_COUNT = 10_000_000
"""Gaussians that other programs take."""

_HEADER = struct.Struct("<IIIBBBB")
_RIGHT_UP_BACK = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
"""From x right, y down, z ahead; its own inverse."""
_FRACTION_BITS = 12
_COLOR_SCALE = 0.15
_ANTIALIASED = 1
NOTED = 1e-3
"""Meters of rounding that are worth a line."""
_HALF = np.sqrt(0.5)
"""Largest value of the second largest part of a unit quaternion."""


def write_spz(path: Path, gaussians: Gaussians, *, antialiased: bool = False) -> int:
    """Write Gaussians with x right, y down, z ahead; return their number; the whole file or nothing.

    Rounding: positions 2**-13 m within 2,048 m (twice that for each time it is twice as far), log scales 1 / 32 in
    [-10, 5.9], opacities 1 / 510, parts of quaternions 0.0007, the first harmonic 1 / 77 in [-3.3, 3.3], the others
    1 / 256 in [-1, 1). Raises ValueError for more than ``MAX_COUNT`` Gaussians or numbers that are not finite.
    """
    check_gaussians(gaussians)
    found = turned(gaussians, _RIGHT_UP_BACK)
    if len(found) > MAX_COUNT:
        raise ValueError(f"a .spz holds at most {MAX_COUNT:,} Gaussians, got {len(found):,}: prune, or choose nodes")
    means, sh = found.means.double().numpy(), found.dense_sh().double().numpy()
    bits = _fraction_bits(float(np.abs(means).max(initial=0)))
    degree = {1: 0, 4: 1, 9: 2, 16: 3}[sh.shape[1]]
    logs = np.log(np.maximum(found.scales.double().numpy(), 1e-30))
    columns = [
        np.ascontiguousarray(np.rint(means * 2**bits).astype("<i4")).view(np.uint8).reshape(-1, 4)[:, :3],
        _bytes(found.opacities.double().numpy() * 255),
        _bytes(sh[:, 0] * _COLOR_SCALE * 255 + 127.5),
        _bytes((logs + 10) * 16),
        _smallest_three(quat.normalized(found.quaternions.double()).numpy()),
        _bytes(sh[:, 1:] * 128 + 128),
    ]
    header = _HEADER.pack(MAGIC, VERSION, len(found), degree, bits, _ANTIALIASED if antialiased else 0, 0)
    with atomic_file(path) as temporary:
        temporary.write_bytes(gzip.compress(header + b"".join(column.tobytes() for column in columns), 9, mtime=0))
    return len(found)


def spz_notes(gaussians: Gaussians) -> list[str]:
    """Return, in a line each, what the format keeps less of than its usual rounding."""
    notes, means = [], gaussians.means.double()
    if len(gaussians):
        row = int(means.abs().amax(1).argmax())
        step = 0.5 ** (_fraction_bits(float(means[row].abs().max())) + 1)
        if step > NOTED:
            away = float(means[row].norm()) / 1000
            notes.append(f"positions are kept to {1000 * step:.3g} mm, because row {row} lies {away:,.4g} km away")
    logs, sh = gaussians.scales.double().log(), gaussians.dense_sh()
    first, rest = sh[:, 0], sh[:, 1:]
    beyond = {
        "scales are cut to 365 m": int((logs > 255 / 16 - 10 + 1 / 32).any(1).sum()),
        "colors are cut to -3.3 to 3.3": int((first.abs() > 0.5 / _COLOR_SCALE + 0.01).any(1).sum()),
        "harmonics are cut to -1 to 1": int((rest.abs() > 1 + 1 / 256).flatten(1).any(1).sum()),
    }
    return [*notes, *(f"of {count:,} Gaussians, {what}" for what, count in beyond.items() if count)]


def read_spz(path: Path) -> Gaussians:
    """Return the Gaussians of such a file, x right, y down, z ahead. Raises ValueError for one that is none."""
    # Above what the largest file unpacks to, zlib stops.
    with gzip.open(path) as stream:
        try:
            head = stream.read(_HEADER.size)
            magic, version, count, degree, bits, _, _ = _HEADER.unpack(head)
            terms = (degree + 1) ** 2
            if magic != MAGIC or version != VERSION or degree > 3 or bits > 23 or count > MAX_COUNT:
                raise ValueError(f"{path} is no .spz of version {VERSION} with at most {MAX_COUNT:,} Gaussians")
            size = count * (20 + 3 * (terms - 1))
            content = stream.read(size + 1)
        except (OSError, EOFError, struct.error, zlib.error) as error:
            raise ValueError(f"{path} is no .spz or is damaged ({error})") from error
    if len(content) != size:
        raise ValueError(f"{path} is damaged: {count} Gaussians take {size} bytes, got {len(content)}")
    widths = (9, 1, 3, 3, 4, 3 * (terms - 1))
    ends = count * np.cumsum(widths)
    table = np.frombuffer(content, np.uint8)
    parts = [part.reshape(count, width) for part, width in zip(np.split(table, ends[:-1]), widths, strict=True)]
    whole = np.zeros((count, 3, 4), np.uint8)
    whole[:, :, 1:] = parts[0].reshape(count, 3, 3)
    sh = np.concatenate([(parts[2] / 255 - 0.5) / _COLOR_SCALE, (parts[5].astype(float) - 128) / 128], axis=1)
    values = (
        (whole.view("<i4")[:, :, 0] >> 8) / 2**bits,
        _from_smallest_three(parts[4]),
        np.exp(parts[3] / 16 - 10.0),
        parts[1][:, 0] / 255,
        sh.reshape(count, terms, 3),
    )
    return turned(Gaussians(*(torch.from_numpy(value).float() for value in values)), _RIGHT_UP_BACK)


def _fraction_bits(reach: float) -> int:
    """Return how many bits stand behind the point: fewer where 24 bits do not reach as far."""
    bits = _FRACTION_BITS
    while bits and reach * 2**bits >= 2**23 - 1:
        bits -= 1
    if reach * 2**bits >= 2**23 - 1:
        raise ValueError(f"a .spz reaches 8,388 km, a Gaussian is {reach:g} m away: choose nodes")
    return bits


def _bytes(values: Float[np.ndarray, "..."]) -> UInt8[np.ndarray, "..."]:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _smallest_three(unit: Float[np.ndarray, "n 4"]) -> UInt8[np.ndarray, "n 4"]:
    """Return 32 bits a quaternion: two for the place of the largest part among x, y, z, w, and ten for each other."""
    xyzw = unit[:, [1, 2, 3, 0]]
    largest = np.abs(xyzw).argmax(1)
    xyzw = np.where(np.take_along_axis(xyzw, largest[:, None], 1) < 0, -xyzw, xyzw)
    packed = largest.astype(np.uint32)
    for place in range(4):
        part = xyzw[:, place]
        sizes = np.minimum(np.rint(np.abs(part) / _HALF * 511), 511).astype(np.uint32)
        bits = (packed << np.uint32(10)) | ((part < 0).astype(np.uint32) << np.uint32(9)) | sizes
        packed = np.where(largest == place, packed, bits)
    return packed.astype("<u4").view(np.uint8).reshape(-1, 4)


def _from_smallest_three(stored: UInt8[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 4"]:
    packed = np.ascontiguousarray(stored).view("<u4")[:, 0]
    largest, xyzw = packed >> np.uint32(30), np.zeros((len(packed), 4))
    rest = packed.copy()
    for place in range(3, -1, -1):
        values = (rest & np.uint32(511)) * (_HALF / 511) * np.where(rest & np.uint32(512), -1.0, 1.0)
        xyzw[:, place] = np.where(largest == place, 0, values)
        rest = np.where(largest == place, rest, rest >> np.uint32(10))
    others = np.sqrt(np.maximum(1 - (xyzw**2).sum(1), 0))
    np.put_along_axis(xyzw, largest[:, None].astype(np.int64), others[:, None], 1)
    return xyzw[:, [3, 0, 1, 2]]


PROGRAM = "splat-transform"
"""Of PlayCanvas: ``npm install -g @playcanvas/splat-transform``; it writes what it read as a plain .ply."""

_SECONDS = 600


@dataclass(frozen=True)
class Checked:
    """What was found of a file."""

    reader: str
    """Who opened it."""
    gaussians: int
    psnr: float | None
    """Of its picture beside that of what was written, decibels; infinity: the same. None: no camera is known."""
    bytes: int

    @property
    def bytes_each(self) -> float:
        return self.bytes / max(self.gaussians, 1)


def check_file(path: Path, written: Gaussians, camera: Camera | None, settings: SplatSettings) -> Checked:
    """Read a file by another program where it is installed, else by our own reader, and render both.

    ``written`` has the axes of viewers, ``camera`` too. Raises ValueError where the file cannot be read or has another
    number of Gaussians.
    """
    program = shutil.which(PROGRAM)
    found = read_spz(path) if program is None else _read_by(program, path)
    if len(found) != len(written):
        raise ValueError(f"{path} has {len(found)} Gaussians for {len(written)} that were written: export it again")
    quality = None if camera is None else _psnr(found, written, camera, settings)
    reader = PROGRAM if program is not None else f"our own reader ({PROGRAM} is not installed)"
    return Checked(reader, len(found), quality, path.stat().st_size)


def turned_camera(camera: Camera, new_from_world: torch.Tensor) -> Camera:
    """Return the same camera in turned axes, as a pinhole without a shutter."""
    turn = torch.eye(4, dtype=camera.camera_from_world.dtype)
    turn[:3, :3] = new_from_world
    return Camera(camera.camera_from_world @ inverse(turn), camera.intrinsics, camera.width, camera.height)


def read_plain_ply(path: Path) -> Gaussians:
    """Return the Gaussians of a .ply in the layout of 3DGS, binary, of floats alone. Raises ValueError for another."""
    content = path.read_bytes()
    head, _, body = content.partition(b"end_header\n")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    names = [line[2] for line in lines if line[:2] == ["property", "float"] and len(line) == 3]
    counts = [int(line[2]) for line in lines if re.fullmatch("element vertex [0-9]{1,9}", " ".join(line))]
    plain = all(len(line) == 3 and line[1] == "float" for line in lines if line[:1] == ["property"])
    binary = b"format binary_little_endian 1.0\n" in head
    if len(counts) != 1 or not plain or not binary or len(body) != 4 * len(names) * counts[0]:
        raise ValueError(f"{path} is no .ply of floats in the layout of 3DGS")
    terms = sum(name.startswith("f_rest_") for name in names) // 3
    needed = ["x", "y", "z", "opacity", *_numbered("f_dc", 3), *_numbered("rot", 4), *_numbered("scale", 3)]
    missing = {*needed, *_numbered("f_rest", 3 * terms)} - set(names)
    if missing or len(set(names)) < len(names) or terms not in (0, 3, 8, 15):
        what = f"it lacks {', '.join(sorted(missing))}" if missing else f"{terms} harmonics or a name twice"
        raise ValueError(f"{path} is no .ply in the layout of 3DGS: {what}")
    columns = dict(zip(names, np.frombuffer(body, "<f4").reshape(counts[0], len(names)).T, strict=True))

    def table(pattern: str, count: int) -> torch.Tensor:
        return torch.from_numpy(np.stack([columns[pattern.format(index)] for index in range(count)], axis=1))

    first = table("f_dc_{}", 3)[:, None]
    rest = table("f_rest_{}", 3 * terms).unflatten(1, (3, terms)).mT if terms else first[:, :0]
    means = torch.from_numpy(np.stack([columns[axis] for axis in "xyz"], axis=1))
    opacities = torch.from_numpy(columns["opacity"].copy()).sigmoid()
    return Gaussians(means, table("rot_{}", 4), table("scale_{}", 3).exp(), opacities, torch.cat([first, rest], 1))


def _numbered(name: str, count: int) -> list[str]:
    return [f"{name}_{index}" for index in range(count)]


def _read_by(program: str, path: Path) -> Gaussians:
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder, "plain.ply")
        try:
            done = subprocess.run(
                [program, "-q", "-w", str(path.resolve()), str(plain)], capture_output=True, text=True, timeout=_SECONDS
            )
        except subprocess.TimeoutExpired as error:
            raise ValueError(f"{PROGRAM} did not read {path} within {_SECONDS} s: look at it there") from error
        if done.returncode or not plain.is_file():
            said = " ".join((done.stderr or done.stdout).split())[-300:]
            raise ValueError(f"{PROGRAM} cannot read {path}: {said}")
        return read_plain_ply(plain)


def _psnr(found: Gaussians, written: Gaussians, camera: Camera, settings: SplatSettings) -> float:
    one, other = (splat(which, camera, settings=settings).rgb.clamp(0, 1) for which in (found, written))
    error = float((one - other).double().square().mean())
    return math.inf if error == 0 else -10 * math.log10(error)
