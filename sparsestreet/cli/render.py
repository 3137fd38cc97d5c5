"""``sparsestreet render scene=RUN out=drive.mp4``: a video of a trained street, along its log or beside it."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from sparsestreet.cli.options import run_command

if TYPE_CHECKING:
    from sparsestreet.export.path import CameraPath
    from sparsestreet.types import View

USAGE = """\
sparsestreet render RUN FILE [key=value ...]     a video of a trained street; the log is not needed

  sparsestreet render outputs/RUN drive.mp4                     what the log's cameras saw, side by side
  sparsestreet render outputs/RUN drive.mp4 cameras=0 fps=30    the front camera, smooth
  sparsestreet render outputs/RUN right.mp4 path=shifted offset=1.5       from 1.5 m farther to the right
  sparsestreet render outputs/RUN lane.mp4 path=lane_change offset=-3     three meters to the left on the way
  sparsestreet render outputs/RUN still frames=40:60 width=640            single PNGs in the folder still/
  sparsestreet render outputs/RUN empty.mp4 edits=edits.yaml              without or with other objects

  scene     a run's folder, or a scene.safetensors; the first word without a key
  out       (the second) a .mp4, or a folder for PNGs (a name without an ending)
  path      recorded (as the log was driven), shifted (beside it) or lane_change (from there to beside it)
  offset    meters to the right that path=shifted or lane_change moves the car; negative: to the left
  cameras   [1,0,2]: these of the log, shown in this order (default: all, the leftmost first)
  frames    40:60: only these frames of the log, the last one left out
  width     pixels of one camera's image (default: as recorded)
  fps       frames a second of the video; poses between the recorded ones are interpolated (default: as the log)
  log_fps   frames a second of the log (default: as its clock says, 10 where it has none)
  quality   1 to 10, of the .mp4 (default: 7)
  views     the views.json that holds the cameras (default: the one beside the scene)
  edits     edits.yaml: objects that are gone, moved, held, copied or of another scene (docs/editing.md)
  device    cpu or cuda (default: a GPU if there is one)
"""


@dataclass(frozen=True)
class RenderRequest:
    """The command's options. Raises ValueError where they contradict each other."""

    scene: Path
    out: Path
    path: Literal["recorded", "shifted", "lane_change"] = "recorded"
    offset: float | None = None
    cameras: tuple[int, ...] | None = None
    frames: slice | None = None
    width: int | None = None
    fps: float | None = None
    log_fps: float | None = None
    quality: float = 7.0
    views: Path | None = None
    edits: Path | None = None
    device: str | None = None

    def __post_init__(self) -> None:
        if (self.path != "recorded") != (self.offset is not None):
            raise ValueError("a shifted path needs both: path=shifted offset=METERS, or path=lane_change")
        for name in ("fps", "log_fps", "width"):
            value = getattr(self, name)
            if value is not None and value <= 0:
                raise ValueError(f"{name} must be above 0, got {value:g}")
        if not 1 <= self.quality <= 10:
            raise ValueError(f"quality lies in 1 to 10, got {self.quality:g}")


def render(arguments: list[str]) -> int:
    """Write the video; 2 on wrong usage, 1 if something is missing."""
    return run_command("render", USAGE, arguments, RenderRequest, _render, positional=("scene", "out"))


def _render(request: RenderRequest) -> None:
    # Imported here: torch takes a second, and --help needs none of it.
    from sparsestreet.cli.edits import DEFAULT_LOG_FPS, with_edits
    from sparsestreet.cli.progress import shown
    from sparsestreet.cli.scene import open_scene
    from sparsestreet.export.video import check_destination, path_pictures, write_pictures
    from sparsestreet.geometry.trajectories import frame_periods
    from sparsestreet.scene.views import FILE_NAME, read_views

    started = time.perf_counter()
    check_destination(request.out)
    stored = open_scene(request.scene, request.device)
    beside = request.scene if request.scene.is_dir() else request.scene.parent
    views = read_views(request.views or beside / FILE_NAME)
    stored = with_edits(stored, views, request.edits)
    log_fps = request.log_fps or views.frame_rate
    if log_fps is None:
        log_fps = DEFAULT_LOG_FPS
        print(f"the log's frame rate is not known: taken as {log_fps:g} a second (log_fps=...)")
    fps = request.fps or log_fps
    speed = f"the log's speed, {log_fps:g} of its frames a second"
    path = _path(request, views.all, step=log_fps / fps / frame_periods(views.all))
    pictures = shown(path_pictures(stored, path), len(path), "frames")
    count = write_pictures(request.out, pictures, fps=fps, quality=request.quality)
    cameras, seconds = ", ".join(str(view.camera_index) for view in path[0]), time.perf_counter() - started
    print(f"{request.out}: {count} frames of camera {cameras} at {fps:g} a second ({speed}), made in {seconds:.0f} s")


def _path(request: RenderRequest, views: "Sequence[View]", step: float) -> "CameraPath":
    from sparsestreet.export import path as paths

    path = paths.recorded(views)
    cameras = request.cameras or paths.left_to_right(path[0])
    if request.frames is not None:
        path = paths.of_frames(path, request.frames)
    if request.offset is not None:
        path = paths.shifted(path, request.offset, gradually=request.path == "lane_change")
    path = paths.resampled(paths.of_cameras(path, cameras), step)
    return path if request.width is None else paths.resized(path, request.width)
