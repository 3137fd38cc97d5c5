"""``sparsestreet export RUN street.spz``: one frame for viewers, and what it keeps."""

from dataclasses import dataclass
from pathlib import Path

from sparsestreet.cli.scene import recorded_views
from sparsestreet.export.check import check_file, turned_camera
from sparsestreet.export.compressed_ply import read_compressed_ply, write_compressed_ply
from sparsestreet.export.frame import VIEWER_FROM_WORLD, frame_gaussians
from sparsestreet.export.sog import read_sog, write_sog
from sparsestreet.export.spz import read_spz, write_spz
from sparsestreet.scene.storage import StoredScene
from sparsestreet.types import Camera, Gaussians

_READERS = {".spz": read_spz, ".sog": read_sog, ".compressed.ply": read_compressed_ply}


@dataclass(frozen=True)
class FrameExport:
    """What is asked for, as the command says it."""

    scene: Path
    views: Path | None
    out: Path
    kind: str
    """``.spz``, ``.sog`` or ``.compressed.ply``."""
    time: float
    nodes: tuple[str, ...] | None
    instance: str | None
    sky: bool
    check: bool


def export_frame(request: FrameExport, stored: StoredScene) -> None:
    """Write the file and say what is in it; with ``check``, what it lost. Raises ValueError where nothing is left."""
    time = request.time
    instances = None if request.instance is None else [request.instance]
    gaussians = frame_gaussians(stored, time, nodes=request.nodes, instances=instances, sky=request.sky)
    if request.kind == ".compressed.ply":
        count = write_compressed_ply(request.out, gaussians)
    else:
        write = write_spz if request.kind == ".spz" else write_sog
        count = write(request.out, gaussians, antialiased=stored.options.settings.antialias)
    size = request.out.stat().st_size
    print(f"{request.out}: {count:,} Gaussians at time {time:g}, {size / 1e6:.2f} MB, {size / count:.1f} bytes each")
    if request.check:
        _check(request, stored, gaussians)


def _check(request: FrameExport, stored: StoredScene, gaussians: Gaussians) -> None:
    camera = _camera(request)
    found = check_file(request.out, gaussians, camera, _READERS[request.kind], stored.options.settings)
    quality = "no camera is known" if found.psnr is None else f"{found.psnr:.1f} dB beside what was written"
    print(f"read by {found.reader}: {found.gaussians:,} Gaussians, {quality}, {found.bytes_each:.1f} bytes each")
    print(f"lost: {'; '.join(_lost(request, stored))}")


def _camera(request: FrameExport) -> Camera | None:
    """The camera of the view nearest in time, in the axes of viewers."""
    try:
        views = recorded_views(request.scene, request.views).all
    except FileNotFoundError:
        return None
    nearest = min(views, key=lambda view: abs(view.time - request.time))
    return turned_camera(nearest.camera, VIEWER_FROM_WORLD)


def _lost(request: FrameExport, stored: StoredScene) -> list[str]:
    lost = [f"time, as this is the moment {request.time:g}"]
    if not request.sky or request.nodes is not None or request.instance is not None:
        lost.append("the sky")
    else:
        lost.append("the sky's infinite distance, as it is a dome")
    if any(node.mask is not None for node in stored.scene.nodes.values()):
        lost.append("masks, but for what they show now")
    effects = [name for name in stored.scene.effects if name != "sky"]
    return [*lost, f"effects of the cameras ({', '.join(effects)})"] if effects else lost
