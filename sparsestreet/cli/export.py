"""``sparsestreet export scene=RUN time=0.5 out=street.ply``: Gaussians of a trained street for viewers."""

from dataclasses import dataclass
from pathlib import Path

from sparsestreet.cli.options import run_command

USAGE = """\
sparsestreet export RUN FILE.ply [key=value ...]     Gaussians of a trained street, as viewers read them

  sparsestreet export outputs/RUN street.ply                     the whole street, at the start of its log
  sparsestreet export outputs/RUN street.ply time=0.5            half way through the log
  sparsestreet export outputs/RUN empty.ply nodes=background     without what moves
  sparsestreet export outputs/RUN car.ply time=0.5 instance=12   one object, where it is at that time

  sparsestreet export outputs/RUN street.usdz                    what AlpaSim loads of it (docs/serving.md)

  scene      a run's folder, or a scene.safetensors; the first word without a key
  out        (the second) a .ply in the layout of 3DGS (binary; opens in SuperSplat and others)
  time       0 to 1: first to last frame of the log (default: 0)
  nodes      [background,rigid]: only these nodes of the scene
  instance   only this object, by the name of its track; a name that does not exist lists those that do
  car        [length,width,height] in meters of the recording car, in a .usdz (default: 4.8,1.9,1.6)
  mount      in a .usdz: as sparsestreet serve takes it
  names      in a .usdz: as sparsestreet serve takes them
"""


@dataclass(frozen=True)
class ExportRequest:
    """The command's options. Raises ValueError where they contradict each other."""

    scene: Path
    out: Path
    time: float = 0.0
    nodes: tuple[str, ...] | None = None
    instance: str | None = None
    car: tuple[float, ...] | None = None
    mount: tuple[float, ...] | None = None
    names: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        if self.nodes is not None and self.instance is not None:
            raise ValueError("nodes and instance exclude each other: leave one out")
        if self.out.suffix not in (".ply", ".usdz"):
            raise ValueError(f"the file must end in .ply, or in .usdz, got {self.out.name!r}")
        if self.out.suffix != ".usdz" and (self.car, self.mount, self.names) != (None, None, None):
            raise ValueError("car, mount and names are of a .usdz: leave them out")


def export(arguments: list[str]) -> int:
    """Write the file; 2 on wrong usage, 1 if something is missing."""
    return run_command("export", USAGE, arguments, ExportRequest, _export, positional=("scene", "out"))


def _export(request: ExportRequest) -> None:
    # Imported here: torch takes a second, and --help needs none of it.
    if request.out.suffix == ".usdz":
        from sparsestreet.cli.artifact import export_artifact

        export_artifact(request.scene, request.out, request.car, request.mount, request.names)
        return
    from sparsestreet.cli.scene import open_scene
    from sparsestreet.export.ply import scene_gaussians, write_ply

    stored = open_scene(request.scene, "cpu")
    instances = None if request.instance is None else [request.instance]
    gaussians = scene_gaussians(stored, request.time, nodes=request.nodes, instances=instances)
    count = write_ply(request.out, gaussians)
    megabytes = request.out.stat().st_size / 1e6
    print(f"{request.out}: {count:,} Gaussians at time {request.time:g}, {megabytes:.1f} MB")
