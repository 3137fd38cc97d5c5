"""What a running server takes: latency by size and clients, and its memory over many requests.

    sparsestreet serve outputs/RUN port=50051 workers=4 & python scripts/measure_serving.py 50051 $!

Asks for the recorded drive of the first camera. Needs carla-driver-interface==2.3.1, whose messages it sends.
"""

import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import grpc
import numpy as np
from carla_driver_interface._proto import common_pb2, sensorsim_pb2
from carla_driver_interface.geometry import Pose, Trajectory

SERVICE = "/nre.grpc.protos.sensorsim.SensorsimService/"
SIZES = ((320, 192), (960, 576), (1920, 1080))
SMALL, MANY = (64, 40), 5000
LIMITS = [(f"grpc.max_{way}_message_length", 64 * 2**20) for way in ("send", "receive")]


def resident_mb(process: int) -> float:
    """Memory of a process that lies in RAM."""
    (line,) = [line for line in Path(f"/proc/{process}/status").read_text().splitlines() if line.startswith("VmRSS")]
    return int(line.split()[1]) / 1000


class Client:
    def __init__(self, port: int) -> None:
        self.channel = grpc.insecure_channel(f"127.0.0.1:{port}", options=LIMITS)
        sim = sensorsim_pb2
        (self.scene, *_) = self.call("get_available_scenes", common_pb2.Empty(), common_pb2.AvailableScenesReturn)[
            0
        ].scene_ids
        asked = sim.AvailableCamerasRequest(scene_id=self.scene)
        self.camera = self.call("get_available_cameras", asked, sim.AvailableCamerasReturn)[0].available_cameras[0]
        asked = sim.AvailableTrajectoriesRequest(scene_id=self.scene)
        found = self.call("get_available_trajectories", asked, sim.AvailableTrajectoriesReturn)[0]
        self.path = Trajectory.from_proto(found.available_trajectories[0].trajectory)

    def call(self, name: str, request, answer):
        """The answer, and what the server says of its milliseconds."""
        stub = self.channel.unary_unary(SERVICE + name, type(request).SerializeToString, answer.FromString)
        message, done = stub.with_call(request, timeout=300)
        return message, {key: float(value) for key, value in done.trailing_metadata() if key.endswith("-ms")}

    def picture(self, number: int, size: tuple[int, int], image_format: int = sensorsim_pb2.JPEG):
        """Milliseconds of the request, and of its rendering and encoding."""
        place = number % len(self.path)
        request = sensorsim_pb2.RGBRenderRequest(
            scene_id=self.scene,
            resolution_w=size[0],
            resolution_h=size[1],
            camera_intrinsics=self.camera.intrinsics,
            frame_start_us=int(self.path.timestamps_us[place]),
            frame_end_us=int(self.path.timestamps_us[place]),
            image_format=image_format,
            image_quality=95,
        )
        pose = self.path.interpolate(int(self.path.timestamps_us[place]))
        sent = (pose @ Pose.from_proto(self.camera.rig_to_camera)).to_proto()
        request.sensor_pose.start_pose.CopyFrom(sent)
        request.sensor_pose.end_pose.CopyFrom(sent)
        started = time.perf_counter()
        _, spent = self.call("render_rgb", request, sensorsim_pb2.RGBRenderReturn)
        return 1000 * (time.perf_counter() - started), spent["render-ms"] + spent["encode-ms"]


def table(client: Client, clients: int, count: int, sizes=SIZES) -> None:
    for size in sizes:
        client.picture(0, size)
        started = time.perf_counter()
        with ThreadPoolExecutor(clients) as pool:
            measured = np.array(list(pool.map(lambda number: client.picture(number, size), range(count))))  # noqa: B023
        rate = count / (time.perf_counter() - started)
        (p50, p99), own = np.percentile(measured[:, 0], (50, 99)), np.median(measured[:, 1])
        beside = np.median(measured[:, 0] - measured[:, 1])
        print(
            f"{size[0]}x{size[1]}, {clients} clients: p50 {p50:.1f} ms, p99 {p99:.1f} ms, rendering and encoding "
            f"{own:.1f} ms, the rest {beside:.1f} ms ({beside / own:.0%}), {rate:.1f} pictures/s"
        )


def main(port: int, process: int) -> None:
    client = Client(port)
    table(client, clients=1, count=40)
    table(client, clients=8, count=40)
    before = resident_mb(process)
    for step in range(5):
        for number in range(MANY // 5):
            client.picture(number, SMALL, sensorsim_pb2.PNG)
        print(
            f"{(step + 1) * MANY // 5} requests of {SMALL[0]}x{SMALL[1]}: {resident_mb(process):.0f} MB ({before:.0f})"
        )


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
