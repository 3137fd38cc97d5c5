"""``sparsestreet export RUN FILE``: Gaussians of a trained street for viewers, or a page that plays it."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from sparsestreet.cli.commands.options import run_command
from sparsestreet.naming import one_line

if TYPE_CHECKING:
    from sparsestreet.ops import SplatSettings
    from sparsestreet.scene.storage import StoredScene
    from sparsestreet.scene.views import RecordedViews
    from sparsestreet.types import Gaussians

USAGE = """\
sparsestreet export RUN FILE [key=value ...]     a trained street, as viewers read it

  sparsestreet export outputs/RUN street.ply                     the whole street, at the start of its log
  sparsestreet export outputs/RUN street.ply time=0.5            half way through the log
  sparsestreet export outputs/RUN empty.ply nodes=background     without what moves
  sparsestreet export outputs/RUN car.ply time=0.5 instance=12   one object, where it is at that time
  sparsestreet export outputs/RUN street.html                    one page that plays the drive, in any browser, offline
  sparsestreet export outputs/RUN empty.html edits=edits.yaml    without or with other objects
  sparsestreet export outputs/RUN street.street                  all of it, small; every command opens it like a run
  sparsestreet export outputs/RUN street.spz time=0.5            one frame for viewers, small
  sparsestreet export outputs/RUN street.spz check=true          what the file keeps and loses, measured
  sparsestreet export outputs/RUN objects/                       each object in a file, and poses.json, for engines
  sparsestreet export outputs/RUN street.obj time=0.5            meshes for physics: the ground, hulls of objects
  sparsestreet export outputs/RUN street.obj voxel=0.2           and what stands around: houses, walls, poles
  sparsestreet export outputs/RUN street.usdz                    what AlpaSim loads of it (docs/serving.md)

  scene      a run's folder, a scene.safetensors, or a .street; the first word without a key
  out        (the second) the ending says what: a .street, the whole scene; .ply in the layout of 3DGS or .spz,
             one frame; an .obj, meshes; an .html (docs/viewing.md); no ending, a folder of objects.
             docs/shipping.md says what each keeps
  edits      edits.yaml: objects that are gone, moved, held, copied or of another scene (docs/editing.md)
  views      the views.json that holds the cameras (default: the one beside the scene, or in it)
  parts      [mypaper]: modules whose code is trusted, for a run with parts from outside (docs/extending.md)

of a .ply, .spz or .obj:
  time       0 to 1: first to last frame of the log (default: 0)

of a .ply or .spz:
  nodes      [background,rigid]: only these nodes of the scene
  instance   only this object, by the name of its track; a name that does not exist lists those that do
  sky        true: the sky as 12,000 discs far away; not of a .ply (default: true)
  antialias  true: opacities as trained, for viewers that go by SplatRenderMode: mip (gsplat, Brush); of a .ply
             (default: those that suit viewers of plain 3DGS)
  check      true: read the file again, by splat-transform where it is installed, and say what it lost

of an .obj:
  voxel      meters, 0.05 to 1: the surroundings too, from depths that the drive's cameras see (default: left out);
             needs scikit-image: pip install 'sparsestreet[mesh]'

of an .html:
  shapes     shapes a second of what changes its shape, such as people (default: 4); more are smoother and larger

of a .usdz:
  car        [length,width,height] in meters of the recording car (default: 4.8,1.9,1.6)
  mount      as sparsestreet serve takes it
  names      as sparsestreet serve takes them
"""

DEFAULT_SHAPES = 4.0
ANTIALIAS_LOST = "trained with antialias, and no camera is known: plain viewers show small Gaussians brighter"
ANTIALIAS_MEAN = "trained with antialias: opacities are those that its cameras see on average, for plain viewers"

_FRAME = ("time", "nodes", "instance")
_OWN = {
    ".street": (),
    ".ply": (*_FRAME, "antialias"),
    ".spz": (*_FRAME, "sky", "check"),
    ".obj": ("time", "voxel"),
    ".html": ("shapes",),
    "": (),
    ".usdz": ("car", "mount", "names"),
}
"""Ending of a file -> the options that not every file has."""


@dataclass(frozen=True)
class ExportRequest:
    """The command's options. Raises ValueError where they contradict each other."""

    scene: Path
    out: Path
    time: float | None = None
    nodes: tuple[str, ...] | None = None
    instance: str | None = None
    edits: Path | None = None
    views: Path | None = None
    voxel: float | None = None
    shapes: float | None = None
    car: tuple[float, ...] | None = None
    mount: tuple[float, ...] | None = None
    names: tuple[str, ...] | None = None
    sky: bool | None = None
    check: bool | None = None
    antialias: bool | None = None
    parts: tuple[str, ...] = ()

    @property
    def kind(self) -> str:
        """The file's ending, of which viewers take ``.compressed.ply`` for another format than ``.ply``."""
        return ".compressed.ply" if self.out.name.endswith(".compressed.ply") else self.out.suffix

    def __post_init__(self) -> None:
        if self.nodes is not None and self.instance is not None:
            raise ValueError("nodes and instance exclude each other: leave one out")
        if self.kind not in _OWN:
            raise ValueError(f"the file must end in {', '.join(filter(None, _OWN))}, got {self.out.name!r}")
        others = {name for names in _OWN.values() for name in names} - set(_OWN[self.kind])
        others |= {"edits"} if self.kind in (".usdz", ".street", ".obj") else set()
        for name in sorted(others):
            if getattr(self, name) is not None:
                raise ValueError(f"{name} is no option of a {self.kind or 'folder'}: leave it out")
        if self.shapes is not None and self.shapes <= 0:
            raise ValueError(f"shapes must be above 0 a second, got {self.shapes:g}")


def export(arguments: list[str]) -> int:
    """Write the file; 2 on wrong usage, 1 if something is missing."""
    return run_command("export", USAGE, arguments, ExportRequest, _export, positional=("scene", "out"))


def _export(request: ExportRequest) -> None:
    # Imported here: torch takes a second, and --help needs none of it.
    from sparsestreet.cli.commands.scenes import open_scene, recorded_views, with_edits

    if request.kind == ".usdz":
        return _export_artifact(request)
    stored = open_scene(request.scene, "cpu", request.parts)
    if request.kind == ".street":
        return _export_street(request, stored)
    if request.kind == ".obj":
        return _export_shapes(request, stored, recorded_views(request.scene, request.views))
    if request.kind in (".html", "") or request.edits is not None:
        views = recorded_views(request.scene, request.views)
        stored = with_edits(stored, views, request.edits)
        if request.kind == ".html":
            return _export_page(request, stored, views)
        if request.kind == "":
            return _export_objects(request, stored, views)
    _export_frame(request, stored)


def _export_frame(request: ExportRequest, stored: "StoredScene") -> None:
    """Write one moment for viewers. Raises ValueError where it shows nothing."""
    from sparsestreet.export.frame import UNSEEN, frame_gaussians
    from sparsestreet.export.ply import scene_gaussians, write_ply
    from sparsestreet.export.spz import spz_notes, write_spz

    time, plain = request.time or 0.0, request.kind == ".ply"
    chosen = {"nodes": request.nodes, "instances": None if request.instance is None else [request.instance]}
    gaussians = scene_gaussians(stored, time, **chosen)
    if plain:
        left_out, why = int((gaussians.opacities == 0).sum()), "are not there"
    else:
        left_out, why = int((gaussians.opacities < UNSEEN).sum()), "have an opacity below 1 / 255"
        gaussians = frame_gaussians(stored, time, **chosen, sky=request.sky is not False)
    settings, said = stored.options.settings, None
    if plain and settings.antialias and not request.antialias:
        gaussians, settings, said = _for_plain_viewers(request, gaussians, settings)
    count = (write_ply if plain else write_spz)(request.out, gaussians, antialiased=settings.antialias)
    size = request.out.stat().st_size
    print(f"{request.out}: {count:,} Gaussians at time {time:g}, {size / 1e6:.2f} MB, {size / count:.1f} bytes each")
    if left_out:
        print(f"left out: {left_out:,} Gaussians that {why} at this time")
    if said:
        print(said)
    for note in [] if plain else spz_notes(gaussians):
        print(note)
    has_sky = not plain and request.sky is not False and request.nodes is None and request.instance is None
    sky = "the sky's infinite distance, as it is a dome" if has_sky else "the sky"
    print(f"lost: {'; '.join([f'time, as this is the moment {time:g}', sky, *_lost_of_scene(stored)])}")
    if request.check:
        _check(request, stored, gaussians)


def _for_plain_viewers(
    request: ExportRequest, gaussians: "Gaussians", settings: "SplatSettings"
) -> "tuple[Gaussians, SplatSettings, str]":
    """Return Gaussians and settings of viewers that do not antialias, and what is said of it; both as they are where no
    camera is known."""
    from dataclasses import replace

    from sparsestreet.cli.commands.scenes import recorded_views
    from sparsestreet.export.ply import plain_factors, spread_cameras

    try:
        cameras = spread_cameras(recorded_views(request.scene, request.views).all)
    except FileNotFoundError:
        return gaussians, settings, ANTIALIAS_LOST
    own = replace(gaussians, opacities=gaussians.opacities * plain_factors([(gaussians, cameras)], settings))
    return own, replace(settings, antialias=False), ANTIALIAS_MEAN


def _check(request: ExportRequest, stored: "StoredScene", gaussians: "Gaussians") -> None:
    """Read the file again, seen by the camera of the view nearest in time, in the axes of viewers."""
    from sparsestreet.cli.commands.scenes import recorded_views
    from sparsestreet.export.frame import VIEWER_FROM_WORLD
    from sparsestreet.export.spz import check_file, turned_camera

    try:
        views = recorded_views(request.scene, request.views).all
        nearest = min(views, key=lambda view: abs(view.time - (request.time or 0.0)))
        camera = turned_camera(nearest.camera, VIEWER_FROM_WORLD)
    except FileNotFoundError:
        camera = None
    found = check_file(request.out, gaussians, camera, stored.options.settings)
    quality = "no camera is known" if found.psnr is None else f"{found.psnr:.1f} dB beside what was written"
    print(f"read by {found.reader}: {found.gaussians:,} Gaussians, {quality}, {found.bytes_each:.1f} bytes each")


def _lost_of_scene(stored: "StoredScene") -> list[str]:
    """Return what no file for viewers holds of a scene: masks over time, effects of the cameras."""
    lost = []
    if any(node.mask is not None for node in stored.scene.nodes.values()):
        lost.append("masks, but for what they show now")
    effects = [name for name in stored.scene.effects if name != "sky"]
    return [*lost, f"effects of the cameras ({', '.join(effects)})"] if effects else lost


def _export_artifact(request: ExportRequest) -> None:
    from sparsestreet.cli.commands.scenes import open_scene
    from sparsestreet.records.run import RUN
    from sparsestreet.scene.storage import views_of

    try:
        from sparsestreet.serving.artifact import DEFAULT_CAR, Provenance, write_artifact
        from sparsestreet.serving.renderer import RigOptions, named_runs, open_run
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"a .usdz needs {error.name}: pip install 'sparsestreet[serve]'") from error
    run, options = request.scene, RigOptions(request.mount, request.names)
    (name,) = named_runs([run])
    served = open_run(run, name, lambda path: open_scene(path, "cpu", request.parts), options)
    of = RUN.find(run)
    provenance = Provenance("", "", 0) if of is None else Provenance(of.source.commit or "", of.data_hash, of.seed)
    counts = write_artifact(request.out, served, views_of(run), provenance, request.car or DEFAULT_CAR)
    said = ", ".join(f"{count} {what[:-1] if count == 1 else what}" for what, count in counts.items())
    print(f"{request.out}: scene {name!r} with {said}; sparsestreet serve {run} gives its pictures")


def _export_street(request: ExportRequest, stored: "StoredScene") -> None:
    from sparsestreet.scene.storage import files_beside
    from sparsestreet.scene.street_file import save_street

    save_street(request.out, stored, files_beside(request.scene, request.views))
    count, size = sum(stored.scene.counts().values()), request.out.stat().st_size
    print(f"{request.out}: {count:,} Gaussians, {size / 1e6:.2f} MB, {size / max(count, 1):.1f} bytes a Gaussian")


def _export_objects(request: ExportRequest, stored: "StoredScene", views: "RecordedViews") -> None:
    from sparsestreet.export.objects import GROUND, POSES, write_objects
    from sparsestreet.export.ply import instance_names

    names = write_objects(request.out, stored, views.all)
    print(f"{request.out}: {len(names)} objects and {POSES}: {', '.join(map(one_line, names))}")
    ground = GROUND if (request.out / GROUND).is_file() else f"no {GROUND}, as nothing tells how high the ground is"
    print(f"meshes: a hull of each, {ground}")
    absent = sorted(set(instance_names(stored)) - set(names))
    if absent:
        print(f"left out, as no recorded frame shows them: {', '.join(map(one_line, absent))}")
    if stored.options.settings.antialias:
        print(ANTIALIAS_MEAN)
    print(f"lost: {'; '.join(['the sky', 'how shapes change', *_lost_of_scene(stored)])}")


def _export_shapes(request: ExportRequest, stored: "StoredScene", views: "RecordedViews") -> None:
    from sparsestreet.export.shapes import write_shapes
    from sparsestreet.scene.surroundings import MIN_VIEWS, REACH

    time = request.time or 0.0
    shapes = write_shapes(request.out, stored, views.all, time, request.voxel)
    ground, count = 0 if shapes.ground is None else len(shapes.ground.mesh.vertices), len(shapes.hulls)
    objects = f"{count} object{'' if count == 1 else 's'}"
    print(f"{request.out}: {ground:,} vertices of the ground, {objects} at time {time:g}")
    if shapes.ground is not None:
        left_out, filled = f"{shapes.ground.left_out:,}", f"{shapes.ground.filled:,}"
        print(f"left out: {left_out} places near the drive where nothing tells the ground's height; filled: {filled}")
    if request.voxel is not None:
        count = 0 if shapes.surroundings is None else len(shapes.surroundings.faces)
        print(f"surroundings: {count:,} triangles of what {MIN_VIEWS} or more views see within {REACH:g} m")
    if shapes.boxes:
        print(f"boxes, as too few of their Gaussians are opaque: {', '.join(map(one_line, shapes.boxes))}")


def _export_page(request: ExportRequest, stored: "StoredScene", views: "RecordedViews") -> None:
    from sparsestreet.cli.commands.scenes import log_seconds
    from sparsestreet.export.frame import dome_around
    from sparsestreet.export.page import viser_module, write_page
    from sparsestreet.export.path import recorded
    from sparsestreet.export.recording import recorded_parts

    viser_module()  # before the work
    path = recorded(views.all)
    seconds = [(rig[0].time - path[0][0].time) * log_seconds(views) for rig in path]
    rate = (len(path) - 1) / seconds[-1] if seconds[-1] > 0 else 1.0
    every = max(round(rate / (request.shapes or DEFAULT_SHAPES)), 1)
    parts = recorded_parts(stored, path, every)
    dome = dome_around(stored.scene, parts)
    write_page(request.out, parts, seconds, path[0][0], dome=dome, title=stored.name)
    moving = [part for part in parts if "/" in part.name]
    print(
        f"{request.out}: {sum(map(len, parts)):,} Gaussians, {len(moving)} objects, {seconds[-1]:.1f} s, "
        f"{request.out.stat().st_size / 1e6:.1f} MB; open it in a browser"
    )
    if stored.options.settings.antialias:
        print(ANTIALIAS_MEAN)
    print(f"lost: {'; '.join(['colors that change with the direction', *_lost_of_scene(stored)])}")
