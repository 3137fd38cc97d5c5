"""The lidar of the log that a run was trained on."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from sparsestreet.cli.commands.options import run_command
from sparsestreet.cli.config.compose import check_moved
from sparsestreet.cli.config.log_from_options import reader_of
from sparsestreet.cli.config.targets import open_run_config
from sparsestreet.records.run import RUN

if TYPE_CHECKING:
    from sparsestreet.data.lidar_models import LidarModel
    from sparsestreet.export.layers import LidarReturns
    from sparsestreet.export.path import CameraPath
    from sparsestreet.export.sweeps import Mounted
    from sparsestreet.scene.storage import StoredScene
    from sparsestreet.scene.views import RecordedViews
    from sparsestreet.serving.rig import Rig
    from sparsestreet.types import View


def lidar_of_run(run: Path, views: "RecordedViews", parts: Sequence[str] = ()) -> "LidarReturns":
    """Return the sweeps at the times of their frames, in the world of the scene; ``parts`` as for ``open_scene``.

    Raises ValueError in one sentence where the log is not there, is another one, or has no lidar.
    """
    from sparsestreet.export.layers import LidarReturns

    try:
        config = open_run_config(run, parts)
        check_moved(config)
        reader = reader_of(config)
        log, data_hash = reader.read(), reader.data_hash()
    except (OSError, ValueError) as error:
        raise ValueError(f"the layer lidar needs the log that the scene was trained on: {error}") from error
    if RUN.exists(run) and (was := RUN.read(run).data_hash) != data_hash:
        raise ValueError(f"the log is not the one that {run} was trained on (data {data_hash[:9]}, then {was[:9]})")
    times = {view.frame_index: view.time for view in views.all}
    known = {frame: times[frame] for frame in log.sweeps.indices if frame in times}
    if not known:
        raise ValueError("the log has no lidar: leave the layer lidar out")
    return LidarReturns(log.sweeps, known)


USAGE = """\
sparsestreet render RUN FILE [key=value ...]     a video of a trained street; the log is not needed

  sparsestreet render outputs/RUN drive.mp4                     what the log's cameras saw, side by side
  sparsestreet render outputs/RUN drive.mp4 cameras=0 fps=30    the front camera, smooth
  sparsestreet render outputs/RUN right.mp4 path=shifted offset=1.5       from 1.5 m farther to the right
  sparsestreet render outputs/RUN lane.mp4 path=lane_change offset=-3     three meters to the left on the way
  sparsestreet render outputs/RUN still frames=40:60 width=640            single PNGs in the folder still/
  sparsestreet render outputs/RUN empty.mp4 edits=edits.yaml              without or with other objects
  sparsestreet render outputs/RUN flight.mp4 path=keys.json               along poses of your own (docs/rendering.md)
  sparsestreet render outputs/RUN truck.mp4 cameras=0 up=1.2 fov=100 width=960 height=400    another camera
  sparsestreet render outputs/RUN labels layers=[rgb,depth,instances]     a folder of PNGs for each layer
  sparsestreet render outputs/RUN sure.mp4 layers=[rgb,seen] edits=edits.yaml   and where the scene only guesses
  sparsestreet render outputs/RUN lidar.mp4 layers=[rgb,lidar] cameras=0  the log's lidar on the picture
  sparsestreet render outputs/RUN sweeps lidar=hdl64 mount=1,0,1.8        what a lidar on the car would return

  scene     a run's folder, a scene.safetensors, or a .street; the first word without a key
  out       (the second) a .mp4, or a folder for PNGs or sweeps (a name without an ending), or a file of one sweep
  edits     edits.yaml: objects that are gone, moved, held, copied or of another scene (docs/editing.md)
  device    cpu or cuda (default: a GPU if there is one)
  parts     [mypaper]: modules whose code is trusted, for a run with parts from outside (docs/extending.md)

the way:
  path      recorded (as the log was driven), shifted (beside it), lane_change (from there to beside it), or a .json:
            poses, keyframes of a smooth path, or nerfstudio's camera_path.json
  offset    meters to the right that path=shifted or lane_change moves the car; negative: to the left
  frames    40:60: only these frames of the log, the last one left out
  views     the views.json that holds the cameras (default: the one beside the scene, or in it)

the cameras:
  cameras   [1,0,2]: these of the log, shown in this order (default: all, the leftmost first)
  up        meters by which the cameras are higher
  fov       degrees from left to right that pinholes in their place see (default: their own lenses)
  width     pixels of one camera's image (default: as recorded)
  height    pixels; rows come or go above and below (default: in proportion)

the pictures:
  layers    [rgb,depth,alpha,nodes,instances,seen,lidar]: in a .mp4 one below the other, in colors; in a folder one
            folder each, exact: depth in millimeters, ids of nodes and objects with tables (default: rgb). seen: how
            many recorded images showed it; 0 is a guess. lidar needs the log: its returns, drawn on the picture
  fps       frames a second of the video, 0.001 to 1000; poses between the recorded ones are interpolated (default: as
            the log)
  log_fps   frames a second of the log (default: as its clock says, 10 where it has none)
  quality   1 to 10, of the .mp4 (default: 7)

sweeps of a lidar, in place of pictures (docs/rendering.md):
  lidar     waymo_top, hdl64, hdl32, pandar64, at128, or a .json of its angles
  mount     [ahead,left,up] in meters: the lidar over the rear axle on the ground (default: as the log's)
  format    ply, pcd or bin, of the files of a folder (default: ply); bin is KITTI's and has no seconds
"""

PATHS = ("recorded", "shifted", "lane_change")
SLOWEST, FASTEST = 0.001, 1000.0
"""Frames a second of a video."""
_SLOW = 5.0
"""Frames a second below which a video is a row of stills."""
SWEEPS = ("ply", "pcd", "bin")
"""Formats of the files of sweeps."""
DEFAULT_MOUNT = (1.0, 0.0, 1.9)
"""Meters ahead, left and up of the rear axle on the ground: about where roofs carry a lidar."""
_OF_PICTURES = ("cameras", "up", "fov", "width", "height")
LAYERS = ("rgb", "depth", "alpha", "nodes", "instances", "seen", "lidar")


@dataclass(frozen=True)
class RenderRequest:
    """The command's options. Raises ValueError where they contradict each other."""

    scene: Path
    out: Path
    path: str = "recorded"
    offset: float | None = None
    cameras: tuple[int, ...] | None = None
    frames: slice | None = None
    up: float | None = None
    fov: float | None = None
    width: int | None = None
    height: int | None = None
    layers: tuple[str, ...] = ("rgb",)
    fps: float | None = None
    log_fps: float | None = None
    quality: float = 7.0
    views: Path | None = None
    edits: Path | None = None
    device: str | None = None
    parts: tuple[str, ...] = ()
    lidar: str | None = None
    mount: tuple[float, ...] | None = None
    format: str | None = None

    def __post_init__(self) -> None:
        self._check_path()
        for name in ("fps", "log_fps"):
            value = getattr(self, name)
            if value is not None and not SLOWEST <= value <= FASTEST:
                raise ValueError(f"{name} lies in {SLOWEST:g} to {FASTEST:g}, got {value:g}")
        if self.lidar is None:
            self._check_pictures()
        else:
            self._check_sweeps()

    def _check_path(self) -> None:
        if self.path not in PATHS and not self.path.endswith(".json"):
            raise ValueError(f"path must be one of {', '.join(PATHS)}, or a .json, got {self.path!r}")
        if (self.path in ("shifted", "lane_change")) != (self.offset is not None):
            raise ValueError("a shifted path needs both: path=shifted offset=METERS, or path=lane_change")
        if self.path_file is not None:
            for name in ("cameras", "frames"):
                if getattr(self, name) is not None:
                    raise ValueError(f"{name}= chooses of the log's, and {self.path} has poses of its own")

    def _check_pictures(self) -> None:
        for name in ("mount", "format"):
            if getattr(self, name) is not None:
                raise ValueError(f"{name}= is of sweeps: say which lidar= draws them")
        for name in ("width", "height"):
            value = getattr(self, name)
            if value is not None and value <= 0:
                raise ValueError(f"{name} must be above 0, got {value:g}")
        if self.fov is not None and not 0 < self.fov < 180:
            raise ValueError(f"fov lies between 0 and 180 degrees, got {self.fov:g}")
        if self.out.suffix not in (".mp4", ""):
            raise ValueError(f"a video ends in .mp4, a folder of PNGs has no ending, got {self.out.name!r}")
        if not 1 <= self.quality <= 10:
            raise ValueError(f"quality lies in 1 to 10, got {self.quality:g}")
        for layer in self.layers:
            if layer not in LAYERS or self.layers.count(layer) > 1:
                raise ValueError(f"layers are {', '.join(LAYERS)}, each once, got {', '.join(self.layers)}")

    def _check_sweeps(self) -> None:
        given = [name for name in _OF_PICTURES if getattr(self, name) is not None]
        if given or self.layers != ("rgb",):
            raise ValueError(f"{(given or ['layers'])[0]}= is of pictures, and lidar= draws sweeps: leave one out")
        if self.out.suffix[1:] not in (*SWEEPS, ""):
            raise ValueError(f"a sweep ends in .{', .'.join(SWEEPS)}, a folder has no ending, got {self.out.name!r}")
        if self.format is not None and (self.format not in SWEEPS or self.out.suffix):
            raise ValueError(f"format is {', '.join(SWEEPS)}, of the files of a folder, got {self.format!r}")
        if self.mount is not None and len(self.mount) != 3:
            raise ValueError(f"mount is three numbers, ahead, left and up, got {len(self.mount)}")

    @property
    def path_file(self) -> Path | None:
        """The file of poses; None: a way along the log."""
        return None if self.path in PATHS else Path(self.path).expanduser()


def render(arguments: list[str]) -> int:
    """Write the video; 2 on wrong usage, 1 if something is missing."""
    return run_command("render", USAGE, arguments, RenderRequest, _render, positional=("scene", "out"))


def _render(request: RenderRequest) -> None:
    (_render_pictures if request.lidar is None else _render_sweeps)(request)


def _render_pictures(request: RenderRequest) -> None:
    # Imported here: torch takes a second, and --help needs none of it.
    from sparsestreet.cli.commands.options import shown
    from sparsestreet.cli.commands.scenes import folder_of, open_scene, recorded_views, with_edits
    from sparsestreet.export.layers import count_images
    from sparsestreet.export.video import check_destination, check_size, picture_size

    started = time.perf_counter()
    check_destination(request.out)
    stored = open_scene(request.scene, request.device, request.parts).standing()
    views = recorded_views(request.scene, request.views)
    log_fps = _log_fps(request, views)
    path, fps, what = _path(request, views, log_fps)
    path = _seen_by(request, path)
    if request.out.suffix:
        check_size(*picture_size(path, rows=len(request.layers)))
    if "seen" in request.layers:
        count_images(stored, shown(views.training, len(views.training), "images looked at"))
    stored = with_edits(stored, views, request.edits)
    if stored.scene.exposed(views.all[0]) is not None:
        print("the pictures are sharp: what blurred those of the log is left out")
    if request.fps is None and not request.path_file and fps < _SLOW:
        print(
            f"{fps:g} frames a second, as the log has: fps=20 shows poses between them (data.log.rate=all, in "
            "training, reads every image of a log that has keyframes)"
        )
    returns = lidar_of_run(folder_of(request.scene), views, request.parts) if "lidar" in request.layers else None
    count = _write(request, stored, path, fps, returns)
    made = f"made in {time.perf_counter() - started:.0f} s"
    print(f"{request.out}: {count} frames of {what} at {fps:g} a second{_speed(request, log_fps)}, {made}")


def _log_fps(request: RenderRequest, views: "RecordedViews") -> float:
    from sparsestreet.scene.views import DEFAULT_FRAME_RATE

    known = request.log_fps or views.frame_rate
    if known is None:
        print(f"the log's frame rate is not known: taken as {DEFAULT_FRAME_RATE:g} a second (log_fps=...)")
    return known or DEFAULT_FRAME_RATE


def _render_sweeps(request: RenderRequest) -> None:
    from sparsestreet.cli.commands.options import shown
    from sparsestreet.cli.commands.scenes import open_scene, recorded_views, with_edits
    from sparsestreet.data.lidar_models import lidar_model
    from sparsestreet.export.sweeps import Instant, write_sweeps
    from sparsestreet.scene.intensities import intensities_of

    started = time.perf_counter()
    model = lidar_model(request.lidar or "")
    stored = open_scene(request.scene, request.device, request.parts).standing()
    views = recorded_views(request.scene, request.views)
    log_fps = _log_fps(request, views)
    path, _, _ = _path(request, views, log_fps)
    instants = [Instant(rig[0].time, rig[0].frame_index) for rig in path]
    if request.out.suffix and len(instants) > 1:
        raise ValueError(f"{request.out.name} holds one sweep, and {len(instants)} are wanted: frames=0:1, or a folder")
    lidar = _mounted(request, model, views, path, log_fps)
    stored = with_edits(stored, views, request.edits)
    if intensities_of(stored.scene) is None:
        print("intensities are 0: the log of the scene has none, or it was trained before they were learned")
    ending = f".{request.format or SWEEPS[0]}"
    count = len(instants)
    points = write_sweeps(
        request.out, stored, lidar, shown(instants, count, "sweeps") if count > 1 else instants, ending
    )
    made = f"made in {time.perf_counter() - started:.0f} s"
    print(f"{request.out}: {count} sweep{'s'[: count > 1]} of {model.name}, {points:,} points, {made}")


def _mounted(
    request: RenderRequest, model: "LidarModel", views: "RecordedViews", path: "CameraPath", log_fps: float
) -> "Mounted":
    """Put the lidar on the car; between the chosen instants it goes on as along all of the log."""
    import numpy as np

    from sparsestreet.export.sweeps import mounted
    from sparsestreet.geometry.cameras import inverse
    from sparsestreet.scene.storage import rig_record
    from sparsestreet.scene.views import seconds_of
    from sparsestreet.serving.rig import rig_of

    record = rig_record(request.scene)
    rig = rig_of(views, record, frame_rate=log_fps)
    vehicle_from = {one.index: np.linalg.inv(one.rig_from_camera) for one in rig.cameras}
    if request.frames is not None and request.path != "lane_change":
        path, _, _ = _path(replace(request, frames=None), views, log_fps)
    vehicles = []
    for one in path:
        camera = rig.cameras[0].index if one[0].camera_index is None else one[0].camera_index
        vehicles.append(inverse(one[0].camera.camera_from_world.double()).numpy() @ vehicle_from[camera])
    mount = request.mount or _known_mount(rig, None if record is None else record.lidar)
    times = [one[0].time for one in path]
    return mounted(model, times, vehicles, mount, seconds_of(views, log_fps))


def _known_mount(rig: "Rig", place: Sequence[float] | None) -> tuple[float, ...]:
    """Return where the log's lidar was on the car, or where others have theirs, and say so."""
    import numpy as np

    mount = DEFAULT_MOUNT
    if place is not None:
        *world, instant = place
        mount = tuple((np.linalg.inv(rig.at(instant)) @ [*world, 1.0])[:3].tolist())
    said = ", ".join(
        f"{round(one, 2) + 0.0:.2f} m {where}" for one, where in zip(mount, ("ahead", "left", "up"), strict=True)
    )
    whose = "as roofs carry one" if place is None else "as the log's"
    print(f"the lidar is {said} of the car's origin, {whose} (mount=...)")
    return mount


def _path(request: RenderRequest, views: "RecordedViews", log_fps: float) -> "tuple[CameraPath, float, str]":
    """The way of the cameras as recorded or read, frames a second, and in words whose it is."""
    from sparsestreet.export.path_file import read_path
    from sparsestreet.geometry.trajectories import frame_periods
    from sparsestreet.scene.views import seconds_of

    if request.path_file is not None:
        fps = request.fps or log_fps
        like = views.all[0]
        read = read_path(request.path_file, like, seconds_of(views, log_fps), fps)
        if read.note is not None:
            print(read.note)
        return read.path, request.fps or read.fps or fps, request.path
    fps = request.fps or log_fps
    path = _along_the_log(request, views.all, step=log_fps / fps / frame_periods(views.all))
    return path, fps, "camera " + ", ".join(str(view.camera_index) for view in path[0])


def _along_the_log(request: RenderRequest, views: "Sequence[View]", step: float) -> "CameraPath":
    from sparsestreet.export import path as paths

    path = paths.recorded(views)
    cameras = request.cameras or paths.left_to_right(path[0])
    if request.frames is not None:
        path = paths.of_frames(path, request.frames)
    if request.offset is not None:
        path = paths.shifted(path, request.offset, gradually=request.path == "lane_change")
    return paths.resampled(paths.of_cameras(path, cameras), step)


def _seen_by(request: RenderRequest, path: "CameraPath") -> "CameraPath":
    """The path with the cameras that were asked for."""
    from sparsestreet.export.path import cropped, pinholes, raised, resized

    path = path if request.up is None else raised(path, request.up)
    path = path if request.width is None else resized(path, request.width)
    path = path if request.height is None else cropped(path, request.height)
    return path if request.fov is None else pinholes(path, request.fov)


def _write(
    request: RenderRequest, stored: "StoredScene", path: "CameraPath", fps: float, returns: "LidarReturns | None"
) -> int:
    from sparsestreet.cli.commands.options import shown
    from sparsestreet.export import layers
    from sparsestreet.export.video import path_pictures, write_pictures

    if request.layers == ("rgb",):
        pictures = path_pictures(stored, path)
    elif request.out.suffix:
        pictures = layers.layer_pictures(stored, path, request.layers, returns)
    else:
        frames = shown(range(len(path)), len(path), "frames")
        return layers.write_layers(request.out, stored, path, request.layers, frames, returns)
    return write_pictures(request.out, shown(pictures, len(path), "frames"), fps=fps, quality=request.quality)


def _speed(request: RenderRequest, log_fps: float) -> str:
    return "" if request.path_file else f" (the log's speed, {log_fps:g} of its frames a second)"
