"""``sparsestreet serve scene=RUN[,RUN] port=50051``: pictures of trained streets for simulators, over gRPC."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from sparsestreet.atomic import atomic_file
from sparsestreet.cli.commands.options import run_command
from sparsestreet.listening import opened_at
from sparsestreet.naming import one_line

USAGE = """\
sparsestreet serve RUN[,RUN] [key=value ...]     pictures for simulators over gRPC (docs/serving.md)
sparsestreet serve --proto [FILE]                the interface as a .proto, on the screen or in a file

  sparsestreet serve outputs/RUN                                a street at 127.0.0.1:50051, until Ctrl-C
  sparsestreet serve outputs/A,outputs/B memory=4               two; scene files of at most 4 GB are open at a time
  sparsestreet serve outputs/RUN mount=1.7,0,1.5                its front camera is 1.7 m ahead of the rear axle, 1.5 up
  sparsestreet serve outputs/RUN host=0.0.0.0 port=8080         for other machines, without any authentication

  scene     folders of runs, with commas between them; the first word without a key
  port      where it listens (default: 50051; 0: a free one)
  host      the address (default: 127.0.0.1: this machine alone)
  workers   requests worked on at the same time (default: 4)
  memory    GB of scene files that are open at the same time (default: 8); one is in any case
  mount     [ahead,left,up] in meters: the first camera over the rear axle on the ground; for logs that do not know
            their car (default: 1.5,0,1.6), and in place of what a log knows
  names     [front,left]: of the cameras, in the order of their numbers (default: as the log calls them)
  log_fps   frames a second of a log without a clock (default: 10)
  device    cpu or cuda (default: a GPU if there is one)
  parts     [mypaper]: modules whose code is trusted, for a run with parts from outside (docs/extending.md)
"""

GRACE = 5
"""Seconds that requests have to end after the server was told to."""


@dataclass(frozen=True)
class ServeRequest:
    """The command's options. Raises ValueError where they are wrong."""

    scene: tuple[Path, ...]
    port: int = 50051
    host: str = "127.0.0.1"
    workers: int = 4
    memory: float = 8.0
    mount: tuple[float, ...] | None = None
    names: tuple[str, ...] | None = None
    log_fps: float | None = None
    device: str | None = None
    parts: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535:
            raise ValueError(f"port lies in 0 to 65535, got {self.port}")
        if self.workers < 1 or self.memory <= 0 or (self.log_fps is not None and self.log_fps <= 0):
            raise ValueError("workers, memory and log_fps must be above 0")
        if self.mount is not None and len(self.mount) != 3:
            raise ValueError(f"mount is three numbers, ahead, left and up, got {len(self.mount)}")


@dataclass(frozen=True)
class ProtoRequest:
    """Where the interface is written. Raises ValueError for a file of another kind."""

    proto: bool
    out: Path | None = None

    def __post_init__(self) -> None:
        if self.out is not None and self.out.suffix != ".proto":
            raise ValueError(f"the interface is written to a .proto, got {str(self.out)!r}")


def serve(arguments: list[str]) -> int:
    """Serve until Ctrl-C or SIGTERM, or tell the interface; 2 on wrong usage, 1 if something is missing."""
    if "--proto" in arguments:
        words = ["proto=true" if word == "--proto" else word for word in arguments]
        return run_command("serve", USAGE, words, ProtoRequest, _tell, positional=("out",))
    return run_command("serve", USAGE, arguments, ServeRequest, _serve, positional=("scene",))


@contextmanager
def _extra() -> Iterator[None]:
    """Name the extra where a package of it is missing."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"serving needs {error.name}: pip install 'sparsestreet[serve]'") from error


def _tell(request: ProtoRequest) -> None:
    with _extra():
        from sparsestreet.serving.interface import proto_text
    if request.out is None:
        print(proto_text(), end="")
    else:
        with atomic_file(request.out) as temporary:
            temporary.write_text(proto_text(), encoding="utf-8")


def _serve(request: ServeRequest) -> None:
    # Imported here: torch takes a second, and --help needs none of it.
    from sparsestreet.cli.commands.scenes import open_scene
    from sparsestreet.serving.renderer import RigOptions, Scenes, named_runs

    with _extra():
        from sparsestreet.serving.server import start
    options = RigOptions(request.mount, request.names, request.log_fps)
    scenes = Scenes(
        named_runs(request.scene),
        lambda run: open_scene(run, request.device, request.parts),
        memory=int(1e9 * request.memory),
        options=options,
    )
    for name in scenes.names:
        cameras = ", ".join(one_line(one.name) for one in scenes.rig(name).cameras)
        print(f"{one_line(name)}: cameras {cameras}")
    scenes.get(scenes.names[0])  # what is wrong with it is said now, and the first request need not wait
    server, port = start(scenes, request.host, request.port, request.workers)
    count = len(scenes.names)
    print(f"serving {count} scene{'s'[: count > 1]} at {opened_at(request.host, port)}; Ctrl-C ends it", flush=True)
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    ended.wait()
    print(f"ending: requests under way have {GRACE} s", flush=True)
    server.stop(grace=GRACE).wait()
