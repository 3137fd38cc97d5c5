"""What a file for viewers keeps of a frame: read again, and rendered beside what was written."""

import math
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from sparsestreet.geometry.cameras import inverse
from sparsestreet.ops import SplatSettings, splat
from sparsestreet.types import Camera, Gaussians

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


def check_file(
    path: Path,
    written: Gaussians,
    camera: Camera | None,
    own_reader: Callable[[Path], Gaussians],
    settings: SplatSettings,
) -> Checked:
    """Reads a file by another program where it is installed, else by our own reader, and renders both.

    ``written`` has the axes of viewers, ``camera`` too. Raises ValueError where the file cannot be read or has another
    number of Gaussians.
    """
    program = shutil.which(PROGRAM)
    found = own_reader(path) if program is None else _read_by(program, path)
    if len(found) != len(written):
        raise ValueError(f"{path} has {len(found)} Gaussians for {len(written)} that were written: export it again")
    quality = None if camera is None else _psnr(found, written, camera, settings)
    reader = PROGRAM if program is not None else f"our own reader ({PROGRAM} is not installed)"
    return Checked(reader, len(found), quality, path.stat().st_size)


def turned_camera(camera: Camera, new_from_world: torch.Tensor) -> Camera:
    """Returns the same camera in turned axes, as a pinhole without a shutter."""
    turn = torch.eye(4, dtype=camera.camera_from_world.dtype)
    turn[:3, :3] = new_from_world
    return Camera(camera.camera_from_world @ inverse(turn), camera.intrinsics, camera.width, camera.height)


def read_plain_ply(path: Path) -> Gaussians:
    """Returns the Gaussians of a .ply in the layout of 3DGS, binary, of floats alone. Raises ValueError for another."""
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
