"""One instant of the street: pictures, exact truth per pixel, and the lidar's turn."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int16, UInt8

from sparsestreet.data.synthetic.cameras import StreetCamera, street_camera
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
    """Along the optical axis, meters; 0 in the sky."""
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
    novel: dict[float, StreetImage]
    """The front camera with the ego car shifted left by the key, meters."""


def render_frame(settings: StreetSettings, world: World, index: int) -> StreetFrame:
    """Everything that is seen at frame ``index``."""
    time = index / settings.frame_rate
    scene = Scene.of(world.parts_at(time))
    view = SunView.of(scene, world.weather.sun)
    ego = world.ego.pose(time)
    cameras = [street_camera(settings, camera, ego) for camera in range(settings.num_cameras)]
    novel = {}
    if index % settings.novel_stride == 0:
        for offset in settings.novel_offsets:
            camera = street_camera(settings, 0, world.ego.pose(time, offset))
            if not _inside_an_actor(world, time, camera):
                novel[offset] = _render(settings, scene, view, world.weather, camera)
    return StreetFrame(
        index=index,
        world_from_ego=ego,
        images=tuple(_render(settings, scene, view, world.weather, camera) for camera in cameras),
        sweep=sweep(settings, scene, ego, index),
        actor_poses=tuple(actor.pose(time) for actor in world.actors),
        novel=novel,
    )


def _render(
    settings: StreetSettings, scene: Scene, view: SunView, weather: Weather, camera: StreetCamera
) -> StreetImage:
    samples = settings.supersampling
    center_rays = camera.rays(1)
    center_hits = first_hits(scene, center_rays)
    rays = center_rays if samples == 1 else camera.rays(samples)
    hits = center_hits if samples == 1 else first_hits(scene, rays)
    linear = radiance(scene, view, weather, rays, hits, 1 / float(camera.intrinsics[0, 0]) / samples)
    linear = linear.reshape(3, camera.height, samples, camera.width, samples).mean((2, 4))
    sky = center_hits.parts == NOTHING
    depth = np.where(sky, 0, center_hits.distances * camera.axis_cosines()).astype(np.float32)
    objects = np.where(sky, BACKGROUND, scene.object_indices[center_hits.parts]).astype(np.int16)
    return StreetImage(camera, to_srgb(linear), depth, objects, sky)


def _inside_an_actor(world: World, time: float, camera: StreetCamera, margin: float = 0.3) -> bool:
    """Whether the camera would sit in (or within ``margin`` meters of) the box of something annotated."""
    for actor in world.actors:
        local = np.linalg.inv(actor.pose(time)) @ camera.world_from_camera[:, 3]
        if (np.abs(local[:3]) < np.array(actor.model.size) / 2 + margin).all():
            return True
    return False
