"""Files that ``sparsestreet export`` writes for others: a frame for viewers, and a scene for AlpaSim."""

from dataclasses import dataclass
from pathlib import Path

from sparsestreet.cli.commands.scenes import open_scene, recorded_views
from sparsestreet.export.frame import UNSEEN, VIEWER_FROM_WORLD, frame_gaussians
from sparsestreet.export.ply import scene_gaussians, write_ply
from sparsestreet.export.spz import check_file, read_spz, spz_notes, turned_camera, write_spz
from sparsestreet.records.run import RUN
from sparsestreet.scene.beside import views_of
from sparsestreet.scene.storage import StoredScene
from sparsestreet.types import Camera, Gaussians

ANTIALIAS_LOST = "trained with antialias: plain viewers show small Gaussians brighter"


@dataclass(frozen=True)
class FrameExport:
    """What is asked for, as the command says it."""

    scene: Path
    views: Path | None
    out: Path
    kind: str
    """``.ply`` or ``.spz``."""
    time: float
    nodes: tuple[str, ...] | None
    instance: str | None
    sky: bool
    check: bool


def export_frame(request: FrameExport, stored: StoredScene) -> None:
    """Write the file and say what is in it and what it lost; with ``check``, measured. Raises ValueError if empty."""
    time, mip = request.time, stored.options.settings.antialias
    chosen = {"nodes": request.nodes, "instances": None if request.instance is None else [request.instance]}
    gaussians = scene_gaussians(stored, time, **chosen)
    if request.kind == ".ply":
        left_out, why = int((gaussians.opacities == 0).sum()), "are not there"
    else:
        left_out, why = int((gaussians.opacities < UNSEEN).sum()), "have an opacity below 1 / 255"
        gaussians = frame_gaussians(stored, time, **chosen, sky=request.sky)
    write = write_spz if request.kind == ".spz" else write_ply
    count = write(request.out, gaussians, antialiased=mip)
    size = request.out.stat().st_size
    print(f"{request.out}: {count:,} Gaussians at time {time:g}, {size / 1e6:.2f} MB, {size / count:.1f} bytes each")
    if left_out:
        print(f"left out: {left_out:,} Gaussians that {why} at this time")
    if mip and request.kind == ".ply":
        print(ANTIALIAS_LOST)
    for note in spz_notes(gaussians) if request.kind == ".spz" else []:
        print(note)
    print(f"lost: {'; '.join(_lost(request, stored))}")
    if request.check:
        _check(request, stored, gaussians)


def _check(request: FrameExport, stored: StoredScene, gaussians: Gaussians) -> None:
    camera = _camera(request)
    found = check_file(request.out, gaussians, camera, read_spz, stored.options.settings)
    quality = "no camera is known" if found.psnr is None else f"{found.psnr:.1f} dB beside what was written"
    print(f"read by {found.reader}: {found.gaussians:,} Gaussians, {quality}, {found.bytes_each:.1f} bytes each")


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
    if request.kind == ".ply" or not request.sky or request.nodes is not None or request.instance is not None:
        lost.append("the sky")
    else:
        lost.append("the sky's infinite distance, as it is a dome")
    return [*lost, *lost_of_scene(stored)]


def lost_of_scene(stored: StoredScene) -> list[str]:
    """Return what no file for viewers holds of a scene: masks over time, effects of the cameras."""
    lost = []
    if any(node.mask is not None for node in stored.scene.nodes.values()):
        lost.append("masks, but for what they show now")
    effects = [name for name in stored.scene.effects if name != "sky"]
    return [*lost, f"effects of the cameras ({', '.join(effects)})"] if effects else lost


def export_artifact(
    run: Path,
    out: Path,
    car: tuple[float, ...] | None,
    mount: tuple[float, ...] | None,
    names: tuple[str, ...] | None,
    parts: tuple[str, ...] = (),
) -> None:
    """Write the file and say what is in it. Raises what ``open_scene`` and ``write_artifact`` do."""
    try:
        from sparsestreet.serving.artifact import DEFAULT_CAR, Provenance, write_artifact
        from sparsestreet.serving.scenes import RigOptions, named_runs, open_run
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"a .usdz needs {error.name}: pip install 'sparsestreet[serve]'") from error
    (name,) = named_runs([run])
    served = open_run(run, name, lambda path: open_scene(path, "cpu", parts), RigOptions(mount, names))
    described = RUN.find(run)
    provenance = Provenance(
        "" if described is None else described.source.commit or "",
        "" if described is None else described.data_hash,
        0 if described is None else described.seed,
    )
    counts = write_artifact(out, served, views_of(run), provenance, car or DEFAULT_CAR)
    said = ", ".join(f"{count} {what[:-1] if count == 1 else what}" for what, count in counts.items())
    print(f"{out}: scene {name!r} with {said}; sparsestreet serve {run} gives its pictures")
