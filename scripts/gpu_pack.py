"""Fill the folder that travels to a GPU for gpu_quarter.sh: wheels, gsplat, scenes, a traced street. `make gpu-pack`.

python scripts/gpu_pack.py [key=value ...]

  plain     a trained run or its .street: frames and times of it (default: none)
  pruned    the same street, pruned (default: none)
  street    folder of a street that is traced already; else it is traced, 400 seconds of a core
  gsplat    folder or .tar.gz of gsplat's sources, which take the place of the wheel's; its math library is added
  wheels    false: none are fetched (default: true)
  library   true: the built C++ backend goes along, for an x86-64 machine without cmake (default: false)
  python    version on that machine (default: 3.12)
  out       the folder (default: .gpu); what lies there is replaced

Prints the size of each file, and ends with status 1 where they take more than 55 MiB together.
"""

import json
import platform
import shutil
import subprocess
import sys
import tarfile
from collections.abc import Iterator
from dataclasses import dataclass, fields
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from zipfile import ZipFile

import numpy as np
from gpu_needs import CARRIED

from sparsestreet.cli.commands.export import export
from sparsestreet.cli.commands.options import run_command
from sparsestreet.data.synthetic import StreetSettings, make_street
from sparsestreet.ops.cpu.library import find_library

MOST = 55 * 2**20
"""Bytes."""
STREET = StreetSettings(width=960, height=640, jpeg=95)
"""Forty frames of three cameras."""
LIDAR, LIDAR_STEP = "lidar", 2.0**-10
"""Folder of the returns, float32 x, y, z and intensity; meters. The sensor has 20 mm of noise."""
NEEDLESS = "depth"
"""Folder of a street that no reader looks into: half of its bytes."""
PLATFORMS = ("manylinux_2_28_x86_64", "manylinux_2_17_x86_64", "manylinux2014_x86_64")
MATH = "gsplat/cuda/csrc/third_party/glm/"
"""What a copy of gsplat's sources lacks that was fetched without its submodule."""


@dataclass(frozen=True)
class PackRequest:
    """The script's options."""

    plain: Path | None = None
    pruned: Path | None = None
    street: Path | None = None
    gsplat: Path | None = None
    wheels: bool = True
    library: bool = False
    python: str = "3.12"
    out: Path = Path(".gpu")


def pack(request: PackRequest) -> None:
    """Fill the folder and say its sizes. Raises ValueError where they are too many, or a part is none."""
    out = request.out
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    if request.wheels:
        fetch_wheels(out / "wheels", request.python)
    if request.gsplat is not None:
        pack_sources(request.gsplat, out)
    if request.library:
        pack_library(out)
    for name in ("plain", "pruned"):
        if (scene := getattr(request, name)) is not None:
            pack_scene(scene, out / f"{name}.street")
    with TemporaryDirectory() as folder:
        street = request.street or make_street(STREET, Path(folder, "street"), _said)
        pack_street(street, out)
    sizes = {path.relative_to(out): path.stat().st_size for path in sorted(out.rglob("*")) if path.is_file()}
    for path, size in sizes.items():
        print(f"{size / 2**20:8.2f} MiB  {path}")
    print(f"{sum(sizes.values()) / 2**20:8.2f} MiB  in all, of at most {MOST / 2**20:g}")
    if sum(sizes.values()) > MOST:
        raise ValueError(f"{out} is too large to travel: leave out the largest of these files")


def fetch_wheels(folder: Path, python: str) -> None:
    """Fetch what a machine for training networks lacks. Raises ValueError where pip fails."""
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "-q"]
    options = ["--no-deps", "-c", "constraints.txt"]
    binary = ["--only-binary=:all:", "--python-version", python, "--implementation", "cp"]
    platforms = [word for name in PLATFORMS for word in ("--platform", name)]
    for name in CARRIED:
        fetch = [*pip, "download", *options, *binary, *platforms, "-d", str(folder), name]
        # Of some there is no wheel; then one is made, which must be pure.
        make = [*pip, "wheel", *options, "-w", str(folder), name]
        if subprocess.run(fetch, check=False, capture_output=True).returncode:
            made = subprocess.run(make, check=False, capture_output=True, text=True)
            if made.returncode:
                raise ValueError(f"no wheel of {name}: {made.stderr.strip().splitlines()[-1]}")


def pack_library(out: Path) -> None:
    """Copy the C++ backend. Raises ValueError where there is none that would run there."""
    library = find_library()
    if library is None or platform.machine() != "x86_64":
        raise ValueError(f"no C++ backend for x86-64 is built on this {platform.machine()}: say library=false")
    shutil.copy(library, out / library.name)


def pack_sources(sources: Path, out: Path) -> None:
    """Pack the package of gsplat's sources; the math library comes from the wheel where they lack it."""
    with TemporaryDirectory() as scratch:
        folder = sources
        if sources.is_file():
            with tarfile.open(sources) as archive:
                archive.extractall(scratch, filter="data")
            folder = Path(scratch)
        found = sorted(folder.glob("**/gsplat/cuda/_backend.py"), key=lambda path: len(path.parts))
        if not found:
            raise ValueError(f"{sources} holds no gsplat/cuda/_backend.py: name the folder or archive of its sources")
        package = found[0].parents[1]
        with tarfile.open(out / "gsplat.tar.gz", "w:gz") as archive:
            archive.add(package, "gsplat")
            if not (package.parent / MATH / "glm").is_dir():
                _add_math(archive, out / "wheels", Path(scratch, "math"))


def _add_math(archive: tarfile.TarFile, wheels: Path, scratch: Path) -> None:
    (wheel,) = wheels.glob("gsplat-*.whl") if wheels.is_dir() else [None]
    if wheel is None:
        raise ValueError("gsplat's sources lack glm: fetch their submodule, or let the wheel be fetched (wheels=true)")
    with ZipFile(wheel) as packed:
        packed.extractall(scratch, [name for name in packed.namelist() if name.startswith(MATH)])
    archive.add(scratch / MATH, MATH.rstrip("/"))


def pack_scene(scene: Path, to: Path) -> None:
    """Copy a .street, or write that of a run. Raises ValueError where there is none."""
    if scene.suffix == to.suffix:
        shutil.copy(scene, to)
    elif export([str(scene), str(to)]):
        raise ValueError(f"{scene} could not be packed: name a trained run or its .street")


def pack_street(street: Path, out: Path) -> None:
    """Pack a street without what nobody reads, and the options of train that describe it.

    Returns of the lidar are rounded to whole ``LIDAR_STEP``, which packs them to less than half.
    """
    (out / "street.options").write_text("\n".join(street_words(street)) + "\n", encoding="utf-8")
    with tarfile.open(out / "street.tar.xz", "w:xz") as archive:
        for path in sorted(path for path in street.rglob("*") if path.is_file()):
            name = path.relative_to(street)
            if name.parts[0] == LIDAR:
                returns = np.fromfile(path, np.float32)
                rounded = (np.round(returns / LIDAR_STEP) * LIDAR_STEP).astype(np.float32).tobytes()
                entry = tarfile.TarInfo(str(name))
                entry.size = len(rounded)
                archive.addfile(entry, BytesIO(rounded))
            elif name.parts[0] != NEEDLESS:
                archive.add(path, str(name))


def street_words(street: Path) -> Iterator[str]:
    """Yield the options of train that are not as conf/data/synthetic.yaml has them.

    Raises ValueError for a folder that is no street, or one with a lidar of its own.
    """
    label = street / "street.json"
    if not label.is_file():
        raise ValueError(f"{street} has no street.json: name a folder that sparsestreet data make has written")
    usual = {field.name: field.default for field in fields(StreetSettings)}
    said = json.loads(label.read_text(encoding="utf-8"))["settings"]
    for name, value in said.items():
        if name == "lidar":
            if any(value[key] != _plain(getattr(STREET.lidar, key)) for key in value):
                raise ValueError(f"{street} has a lidar of its own, which gpu_quarter.sh does not name: take the usual")
        elif value != _plain(usual[name]):
            text = f"[{','.join(map(str, value))}]" if isinstance(value, list) else value
            yield f"seed={text}" if name == "seed" else f"data.log.settings.{name}={text}"


def _plain(value: object) -> object:
    return list(value) if isinstance(value, tuple) else value


def _said(done: int, total: int) -> None:
    print(f"traced {done} of {total} frames", flush=True)


if __name__ == "__main__":
    sys.exit(run_command("gpu_pack", __doc__ or "", sys.argv[1:] or ["wheels=true"], PackRequest, pack))
