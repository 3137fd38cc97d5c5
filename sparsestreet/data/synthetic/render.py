"""Renders one instant of the street: pictures, exact truth per pixel, and the lidar's turn."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int16, UInt8

from sparsestreet.data.synthetic.cameras import StreetCamera, street_camera
from sparsestreet.data.synthetic.exposure import recorded_gains
from sparsestreet.data.synthetic.lidar import StreetSweep, sweep
from sparsestreet.data.synthetic.parts import BACKGROUND, Pose
from sparsestreet.data.synthetic.scene import Scene, SunView
from sparsestreet.data.synthetic.settings import StreetSettings
from sparsestreet.data.synthetic.shading import radiance, to_srgb
from sparsestreet.data.synthetic.sky import Weather
from sparsestreet.data.synthetic.tracer import NOTHING, first_hits
from sparsestreet.data.synthetic.world import World


@dataclass(frozen=True)
class StreetImage:
    """A picture and the truth along the ray through each pixel's center."""

    camera: StreetCamera
    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float32[np.ndarray, "h w"]
    """Depth along the optical axis, meters; 0 in the sky."""
    object_indices: Int16[np.ndarray, "h w"]
    """Position in World.actors, or BACKGROUND."""
    sky: Bool[np.ndarray, "h w"]


@dataclass(frozen=True)
class StreetFrame:
    index: int
    world_from_ego: Pose
    images: tuple[StreetImage, ...]
    sweep: StreetSweep
    actor_poses: tuple[Pose, ...]
    """World from object of every actor of the world."""


@dataclass(frozen=True)
class Instant:
    """The street at a time, with its light."""

    scene: Scene
    sunlit: SunView
    weather: Weather
    actors: tuple[tuple[Pose, tuple[float, float, float]], ...]
    """World from object and the size of the box, meters, of every actor of the world."""

    @staticmethod
    def at(world: World, time: float) -> "Instant":
        """Returns the street at ``time``, seconds."""
        scene = Scene.of(world.parts_at(time))
        actors = tuple((actor.pose(time), actor.model.size) for actor in world.actors)
        return Instant(scene, SunView.of(scene, world.weather.sun), world.weather, actors)

    def inside_an_actor(self, camera: StreetCamera, margin: float = 0.3) -> bool:
        """Whether the camera lies in, or within ``margin`` meters of, the box of an annotated object."""
        for pose, size in self.actors:
            local = np.linalg.inv(pose) @ camera.world_from_camera[:, 3]
            if (np.abs(local[:3]) < np.array(size) / 2 + margin).all():
                return True
        return False

    def actors_within(self, meters: float, camera: StreetCamera) -> list[int]:
        """Returns positions in World.actors of actors at most ``meters`` from the camera, seen from above."""
        here = camera.world_from_camera[:2, 3]
        return [at for at, (pose, _) in enumerate(self.actors) if np.linalg.norm(pose[:2, 3] - here) <= meters]


def render_frame(settings: StreetSettings, world: World, index: int) -> StreetFrame:
    """Renders all images, each at its own instant, and the lidar and boxes of frame ``index``."""
    time = index / settings.frame_rate
    instant = Instant.at(world, time)
    ego = world.ego.pose(time)
    return StreetFrame(
        index=index,
        world_from_ego=ego,
        images=tuple(_render_camera(settings, world, instant, index, camera) for camera in range(settings.num_cameras)),
        sweep=sweep(settings, instant.scene, ego, index),
        actor_poses=tuple(pose for pose, _ in instant.actors),
    )


def _render_camera(settings: StreetSettings, world: World, instant: Instant, frame: int, camera: int) -> StreetImage:
    """Renders what a camera records of a frame, at its own instant; ``instant`` is the frame's."""
    time = settings.image_time(frame, camera)
    if time != frame / settings.frame_rate:
        instant = Instant.at(world, time)
    mounted = street_camera(settings, camera, world.ego.pose(time))
    return render_image(settings, instant, mounted, recorded_gains(settings, frame, camera))


def render_image(
    settings: StreetSettings, instant: Instant, camera: StreetCamera, gains: Float32[np.ndarray, "3"] | None = None
) -> StreetImage:
    """Renders what a camera sees at an instant; of the settings it uses only the number of rays per pixel."""
    samples = settings.supersampling
    scene = instant.scene
    center_rays = camera.rays(1)
    center_hits = first_hits(scene, center_rays)
    rays = center_rays if samples == 1 else camera.rays(samples)
    hits = center_hits if samples == 1 else first_hits(scene, rays)
    pixel = 1 / float(camera.intrinsics[0, 0]) / samples
    linear = radiance(scene, instant.sunlit, instant.weather, rays, hits, pixel)
    linear = linear.reshape(3, camera.height, samples, camera.width, samples).mean((2, 4))
    sky = center_hits.parts == NOTHING
    depth = np.where(sky, 0, center_hits.distances * camera.axis_cosines()).astype(np.float32)
    objects = np.where(sky, BACKGROUND, scene.object_indices[center_hits.parts]).astype(np.int16)
    return StreetImage(camera, to_srgb(linear, gains), depth, objects, sky)
