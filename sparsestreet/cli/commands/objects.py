"""``sparsestreet objects RUN``: what is in a trained street and can be edited, with a sheet of pictures."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from sparsestreet.cli.commands.options import run_command
from sparsestreet.naming import one_line

if TYPE_CHECKING:
    from sparsestreet.export.objects import SceneObject
    from sparsestreet.scene.storage import StoredScene

USAGE = """\
sparsestreet objects RUN [key=value ...]     the objects of a trained street, those seen largest first

  sparsestreet objects outputs/RUN                    a table, and the sheet outputs/RUN/pictures/objects.png
  sparsestreet objects outputs/RUN out=sheet.png      the sheet elsewhere

  scene     a run's folder; the first word without a key
  out       the sheet, a .png (default: pictures/objects.png in the run's folder)
  device    cpu or cuda (default: a GPU if there is one)
  parts     [mypaper]: modules whose code is trusted, for a run with parts from outside (docs/extending.md)
"""

COLUMNS, TILE_WIDTH = 6, 180


@dataclass(frozen=True)
class ObjectsRequest:
    """The command's options. Raises ValueError where they are wrong."""

    scene: Path
    out: Path | None = None
    device: str | None = None
    parts: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.out is not None and self.out.suffix != ".png":
            raise ValueError(f"the sheet must end in .png, got {self.out.name!r}")


def objects(arguments: list[str]) -> int:
    """Print the table and write the sheet; 2 on wrong usage, 1 if something is missing."""
    return run_command("objects", USAGE, arguments, ObjectsRequest, _objects, positional=("scene",))


def _objects(request: ObjectsRequest) -> None:
    from sparsestreet.cli.commands.scenes import folder_of, log_seconds, open_scene, recorded_views
    from sparsestreet.export.objects import scene_objects
    from sparsestreet.records.file import check_links

    if request.out is None:
        check_links(folder_of(request.scene))
    stored = open_scene(request.scene, request.device, request.parts)
    folder = folder_of(request.scene)
    views = recorded_views(request.scene)
    found = scene_objects(stored, views.all)
    if not found:
        print("the scene has no objects of their own: 3dgs, deformgs and pvg have none, streetgs and omnire do")
        return
    seconds = log_seconds(views)
    print(f"{'name':24} {'class':12} {'node':11} {'size, m':>16} {'Gaussians':>9} {'from':>6} {'to, s':>6}  seen")
    for one in found:
        size = " x ".join(f"{value:.1f}" for value in one.size)
        start, end = (seconds * time for time in one.span)
        seen = "never" if one.view is None else "frame {} camera {}".format(*one.view.indices)
        print(
            f"{one_line(one.name):24} {one_line(one.class_name or '-'):12} {one.node:11} {size:>16} "
            f"{one.gaussians:9,} {start:6.1f} {end:6.1f}  {seen}"
        )
    out = request.out or folder / "pictures" / "objects.png"
    _write_sheet(stored, found, out)
    print(f"{out}: each where it is largest")


def _write_sheet(stored: "StoredScene", found: "list[SceneObject]", out: Path) -> None:
    from sparsestreet.cli.commands.options import shown
    from sparsestreet.export.objects import portrait
    from sparsestreet.pictures.images import write_png
    from sparsestreet.pictures.sheets import Tile, tile_sheet

    pictures = [(one.name, portrait(stored, one)) for one in shown(found, len(found), "pictures")]
    tiles = [Tile(one_line(name), picture) for name, picture in pictures if picture is not None]
    if not tiles:
        raise ValueError("no view shows any of the objects: there is nothing to draw")
    out.parent.mkdir(parents=True, exist_ok=True)
    write_png(out, tile_sheet(tiles, title=f"{len(tiles)} objects", columns=COLUMNS, tile_width=TILE_WIDTH))
