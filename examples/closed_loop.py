"""A driver of somebody else drives through a trained street: a loop in the order in which AlpaSim calls.

    pip install 'sparsestreet[serve]' carla-driver-interface==2.3.1
    sparsestreet serve outputs/RUN port=50051
    python examples/closed_loop.py 50051

Each step shows the driver the pictures of the server, where the car is and the way ahead; its plan moves the car.
"""

import sys
from dataclasses import dataclass, field

import grpc
import numpy as np
from carla_driver_interface import protocol
from carla_driver_interface._proto import common_pb2, sensorsim_pb2
from carla_driver_interface.driver import BaseDriver
from carla_driver_interface.geometry import Pose, Trajectory, waypoints_to_proto
from carla_driver_interface.policies.route_follower import RouteFollowerPolicy
from carla_driver_interface.server import serving
from drive import steer, step
from scipy.spatial.transform import Rotation

SERVICE = "/nre.grpc.protos.sensorsim.SensorsimService/"
STEP_US, SPEED = 100_000, 3.0  # m/s
HORIZON, START_BESIDE = 60.0, 0.4  # meters of the way that the driver is told, and to the left of it at the start


@dataclass
class Driven:
    """What became of a drive."""

    recorded: np.ndarray
    """n x 3 places of the recorded drive, meters."""
    places: list[np.ndarray] = field(default_factory=list)
    """Of the car, one a step."""
    pictures: list[bytes] = field(default_factory=list)

    @property
    def beside(self) -> np.ndarray:
        """Meters from each place to the recorded path, straight between its places."""
        starts, ends = self.recorded[:-1], self.recorded[1:]
        ways = ends - starts
        places = np.array(self.places)[:, None]
        shares = ((places - starts) * ways).sum(-1) / (ways * ways).sum(-1)
        return np.linalg.norm(places - starts - np.clip(shares, 0, 1)[..., None] * ways, axis=-1).min(1)


class Renderer:
    """A client of SensorsimService."""

    def __init__(self, port: int) -> None:
        self.channel = grpc.insecure_channel(f"127.0.0.1:{port}")

    def call(self, name: str, request, answer):
        serialize = type(request).SerializeToString
        return self.channel.unary_unary(SERVICE + name, serialize, answer.FromString)(request, timeout=60)

    def drive(self) -> tuple[str, Trajectory, list]:
        """Name of the first scene, its recorded drive and its cameras."""
        empty, sim = common_pb2.Empty(), sensorsim_pb2
        (name, *_) = self.call("get_available_scenes", empty, common_pb2.AvailableScenesReturn).scene_ids
        asked = sim.AvailableTrajectoriesRequest(scene_id=name)
        found = self.call("get_available_trajectories", asked, sim.AvailableTrajectoriesReturn)
        cameras = self.call(
            "get_available_cameras", sim.AvailableCamerasRequest(scene_id=name), sim.AvailableCamerasReturn
        )
        return name, Trajectory.from_proto(found.available_trajectories[0].trajectory), list(cameras.available_cameras)

    def picture(self, scene: str, camera, world_from_rig: Pose, now: int, actors=()) -> bytes:
        request = sensorsim_pb2.RGBRenderRequest(
            scene_id=scene,
            resolution_h=camera.intrinsics.resolution_h,
            resolution_w=camera.intrinsics.resolution_w,
            camera_intrinsics=camera.intrinsics,
            frame_start_us=now,
            frame_end_us=now,
            dynamic_objects=actors,
            image_format=sensorsim_pb2.JPEG,
            image_quality=95,
        )
        pose = (world_from_rig @ Pose.from_proto(camera.rig_to_camera)).to_proto()
        request.sensor_pose.start_pose.CopyFrom(pose)
        request.sensor_pose.end_pose.CopyFrom(pose)
        return self.call("render_rgb", request, sensorsim_pb2.RGBRenderReturn).image_bytes


def drive(port: int, steps: int, policy: BaseDriver | None = None) -> Driven:
    """Let the policy (the package's route follower) drive, from 0.4 m beside the path on; a car follows its plans."""
    renderer = Renderer(port)
    scene, recorded, cameras = renderer.drive()
    driven = Driven(recorded.positions)
    with serving(policy or RouteFollowerPolicy(cruise_speed_mps=SPEED), 0, "127.0.0.1", mode="alpasim") as driver_port:
        driver = protocol.EgodriverServiceStub(grpc.insecure_channel(f"127.0.0.1:{driver_port}"))
        start = protocol.DriveSessionRequest(session_uuid="street")
        start.rollout_spec.vehicle.available_cameras.extend(cameras)
        driver.start_session(start)
        now = int(recorded.timestamps_us[0])
        car = recorded.interpolate(now) @ Pose.from_xyz_yaw(0.0, START_BESIDE, 0.0, 0.0)
        for _ in range(steps):
            driven.places.append(car.position)
            for camera in cameras:
                image = protocol.RolloutCameraImage(session_uuid="street")
                image.camera_image.logical_id = camera.logical_id
                image.camera_image.frame_start_us = image.camera_image.frame_end_us = now
                image.camera_image.image_bytes = renderer.picture(scene, camera, car, now)
                driven.pictures.append(image.camera_image.image_bytes)
                driver.submit_image_observation(image)
            _tell_where_it_is(driver, car, now)
            _tell_the_way(driver, driven.recorded, car, now)
            asked = protocol.DriveRequest(session_uuid="street", time_now_us=now, time_query_us=now + STEP_US)
            now += STEP_US
            car = _followed(Trajectory.from_proto(driver.drive(asked).trajectory), car, now)
        driver.close_session(protocol.DriveSessionCloseRequest(session_uuid="street"))
    return driven


def _followed(plan: Trajectory, car: Pose, now: int) -> Pose:
    """A car with a front axle that steers towards where the plan is a second later, at the speed of the plan."""
    soon, later, goal = (plan.interpolate(now + wait) for wait in (0, STEP_US, 10 * STEP_US))
    speed = float(np.linalg.norm(later.position - soon.position)) / (STEP_US / 1e6)
    moved = step(car.as_matrix(), speed, steer(car.as_matrix(), goal.position))
    return Pose.from_rotation(moved[:3, 3], Rotation.from_matrix(moved[:3, :3]))


def _tell_where_it_is(driver, car: Pose, now: int) -> None:
    seen = protocol.RolloutEgoTrajectory(session_uuid="street")
    seen.trajectory.CopyFrom(Trajectory([now], [car]).to_proto())
    seen.dynamic_states.append(protocol.DynamicState(linear_velocity=protocol.Vec3(x=SPEED, y=0.0, z=0.0)))
    driver.submit_egomotion_observation(seen)


def _tell_the_way(driver, recorded: np.ndarray, car: Pose, now: int) -> None:
    """The recorded path from beside the car on, a point every 2 m; straight on behind its end."""
    last = recorded[-1] - recorded[-2]
    path = np.concatenate((recorded, [recorded[-1] + 2 * HORIZON * last / np.linalg.norm(last)]))
    along = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))))

    def at(places: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(places, along, path[:, axis]) for axis in range(3)], axis=1)

    fine = np.arange(0.0, along[-1], 0.1)
    start = fine[np.linalg.norm(at(fine) - car.position, axis=1).argmin()]
    ahead = car.inverse().transform_points(at(np.arange(start, start + HORIZON, 2.0)))
    route = protocol.Route(timestamp_us=now, waypoints=waypoints_to_proto(ahead))
    driver.submit_route(protocol.RouteRequest(session_uuid="street", route=route))


if __name__ == "__main__":
    result = drive(int(sys.argv[1]), steps=100)
    length = np.linalg.norm(np.diff(result.places, axis=0), axis=1).sum()
    print(
        f"{len(result.places)} steps, {length:.1f} m, {len(result.pictures)} pictures; at most "
        f"{result.beside.max():.2f} m, on average {result.beside.mean():.2f} m beside the recorded path"
    )
