"""``sparsestreet view RUN``: fly through a trained street in a browser, and edit it."""

from dataclasses import dataclass
from pathlib import Path

from sparsestreet.cli.commands.options import run_command
from sparsestreet.listening import Callers, opened_at

USAGE = """\
sparsestreet view RUN [key=value ...]     a trained street in the browser: fly, play, hide and move objects

  sparsestreet view outputs/RUN                         open the address that it prints; Ctrl-C ends it
  sparsestreet view outputs/RUN edits=edits.yaml        go on editing
  sparsestreet view outputs/RUN fps=25                  smoother and coarser while the camera moves

  scene     a run's folder, a scene.safetensors, or a .street; the first word without a key
  edits     edits.yaml to start from (docs/editing.md)
  save      where "Save edits" writes (default: the file of edits=, else edits.yaml beside the scene)
  fps       pictures a second that it aims at while something moves (default: 15); at rest they have full size
  views     the views.json that holds the cameras (default: the one beside the scene, or in it)
  device    cpu or cuda (default: a GPU if there is one)
  parts     [mypaper]: modules whose code is trusted, for a run with parts from outside (docs/extending.md)
  host      whom it answers (default: 127.0.0.1, this machine alone); anybody who reaches it can use it
  port      default: 8080, or the next that is free
  known_as  [street.lab,10.0.0.5]: further names of this machine by which browsers reach it, such as a proxy's
"""


@dataclass(frozen=True)
class ViewRequest:
    """The command's options. Raises ValueError where they are wrong."""

    scene: Path
    edits: Path | None = None
    save: Path | None = None
    fps: float = 15.0
    views: Path | None = None
    device: str | None = None
    host: str = "127.0.0.1"
    port: int = 8080
    known_as: tuple[str, ...] = ()
    parts: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not 1 <= self.fps <= 60:
            raise ValueError(f"fps lies in 1 to 60, got {self.fps:g}")
        if not 0 <= self.port < 2**16:
            raise ValueError(f"a port lies in 0 to 65535, got {self.port}")
        Callers.of("127.0.0.1", self.known_as)


def view(arguments: list[str]) -> int:
    """Serve until Ctrl-C; 2 on wrong usage, 1 if something is missing."""
    return run_command("view", USAGE, arguments, ViewRequest, _view, positional=("scene",))


def _view(request: ViewRequest) -> None:
    # Imported here: torch takes a second, and --help needs none of it.
    from sparsestreet.cli.commands.scenes import folder_of, log_seconds, open_scene, opener, recorded_views
    from sparsestreet.scene.edits.file import beside, read_values
    from sparsestreet.viewing.edit_state import EditState
    from sparsestreet.viewing.server import Viewer
    from sparsestreet.viewing.stage import Stage

    stored = open_scene(request.scene, request.device, request.parts).standing()
    folder = folder_of(request.scene)
    views = recorded_views(request.scene, request.views)
    file, open_other = request.edits or folder / "edits.yaml", opener(stored)
    said = {} if request.edits is None else read_values(request.edits)
    edits = EditState(stored.scene, said, log_seconds(views), lambda path: open_other(beside(file, path)))
    viewer = Viewer(
        Stage(stored, views.all, edits),
        views.all[0],
        title=stored.name,
        host=request.host,
        port=request.port,
        frames_per_second=request.fps,
        save=request.save or file,
        known_as=request.known_as,
    )
    print(f"http://{opened_at(request.host, viewer.port)}  (Ctrl-C ends it)", flush=True)
    try:
        viewer.run()
    except KeyboardInterrupt:
        print("ended")
