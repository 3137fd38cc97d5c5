"""A client of the render server, and the server that it starts: a process of its own, as simulators find it."""

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grpc
import numpy as np

from sparsestreet.geometry.cameras import inverse
from sparsestreet.scene.edits import objects_of
from sparsestreet.scene.storage import load_scene
from sparsestreet.scene.views import FILE_NAME, read_views
from sparsestreet.serving import wire
from sparsestreet.serving.cameras import Pose, camera_spec, pose_message
from sparsestreet.serving.renderer import frame_from_box
from sparsestreet.serving.scenes import RigOptions, ServedScene, open_run
from sparsestreet.types import View

_LIMITS = [(f"grpc.max_{way}_message_length", 64 * 2**20) for way in ("send", "receive")]
_PATIENCE = 300.0
"""Seconds that a request may take."""
PNG, JPEG = (wire.number("ImageFormat", name) for name in ("PNG", "JPEG"))


@dataclass(frozen=True)
class Answer:
    """A picture, and what it took in milliseconds: whole request, rendering with encoding."""

    image: bytes
    whole: float
    own: float


class Client:
    """Asks one server for pictures of the scene of one run."""

    def __init__(self, port: int, run: Path) -> None:
        self.run = run
        self.served: ServedScene = open_run(run, run.name, load_scene, RigOptions())
        self.views = read_views(run / FILE_NAME).all
        channel = grpc.insecure_channel(f"127.0.0.1:{port}", options=_LIMITS)
        self._render = channel.unary_unary(
            f"/{wire.SERVICES[0]}/render_rgb",
            request_serializer=wire.kind("RGBRenderRequest").SerializeToString,
            response_deserializer=wire.kind("RGBRenderReturn").FromString,
        )

    def request(self, view: View, size: tuple[int, int] | None = None, image_format: int = JPEG) -> Any:
        """For what a recorded view sees; ``size``: width and height instead of its own."""
        width, height = size or (view.camera.width, view.camera.height)
        names = {camera.index: camera.name for camera in self.served.rig.cameras}
        now = self.served.rig.clock.microseconds(view.time)
        made = wire.kind("RGBRenderRequest")(
            scene_id="*", resolution_w=width, resolution_h=height, frame_start_us=now, frame_end_us=now,
            camera_intrinsics=camera_spec(names[view.camera_index or 0], view.camera),
            image_format=image_format, image_quality=95,
        )  # fmt: skip
        pose = pose_message(inverse(view.camera.camera_from_world.double()).numpy())
        made.sensor_pose.start_pose.CopyFrom(pose)
        made.sensor_pose.end_pose.CopyFrom(pose)
        return made

    def ask(self, request: Any) -> Answer:
        """Raises grpc.RpcError for a status other than OK."""
        started = time.perf_counter()
        answer, call = self._render.with_call(request, timeout=_PATIENCE, wait_for_ready=True)
        whole = 1000 * (time.perf_counter() - started)
        spent = {name: float(value) for name, value in call.trailing_metadata() if name.endswith("-ms")}
        return Answer(answer.image_bytes, whole, spent["render-ms"] + spent["encode-ms"])

    def box(self, name: str, time: float) -> Pose | None:
        """world_from_box of an object as it was logged; None while it is not there."""
        _, node, instance = objects_of(self.served.stored.scene)[name]
        start, end = node.spans[instance].tolist()
        if not start <= time <= end:
            return None
        frame = node.object_frames(node.pose_at(time))[instance]
        return np.asarray(frame) @ np.linalg.inv(frame_from_box(node, instance))


def place(request: Any, name: str, world_from_box: Pose) -> None:
    """Lets a request say where an object is."""
    one = request.dynamic_objects.add(track_id=name)
    one.pose_pair.start_pose.CopyFrom(pose_message(world_from_box))
    one.pose_pair.end_pose.CopyFrom(pose_message(world_from_box))


def resident_mb(process: int) -> float:
    """Memory of a process that lies in RAM, MB (Linux)."""
    lines = Path(f"/proc/{process}/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS")) / 1000


@contextmanager
def server(run: Path, workers: int) -> Iterator[tuple[Client, int]]:
    """``sparsestreet serve`` on a free port, a client of it, and the number of its process; it ends with the block.

    Raises RuntimeError where it does not begin to serve.
    """
    command = [sys.executable, "-m", "sparsestreet", "serve", str(run), "port=0", f"workers={workers}", "device=cpu"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            lines = iter(process.stdout or ())
            said = next((line for line in lines if line.startswith("serving")), None)
            if said is None:
                raise RuntimeError(f"no server began to serve {run}: {' '.join(command)} says why")
            yield Client(int(said.partition("127.0.0.1:")[2].partition(";")[0]), run), process.pid
        finally:
            process.terminate()
