"""The street at an instant, and what a camera sees of it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int16

from sparsestreet.data.synthetic.cameras import EVERYWHERE, StreetCamera, Window
from sparsestreet.data.synthetic.parts import BACKGROUND, Pose
from sparsestreet.data.synthetic.scene import Scene, SunView
from sparsestreet.data.synthetic.shading import radiance
from sparsestreet.data.synthetic.sky import Weather
from sparsestreet.data.synthetic.tracer import NOTHING, Hits, Rays, first_hits
from sparsestreet.data.synthetic.world import World


@dataclass(frozen=True)
class Sight:
    """Light of pixels, and the truth along the ray through each pixel's center."""

    linear: Float32[np.ndarray, "3 h w"]
    """RGB radiance, mean over the pixel."""
    depth: Float32[np.ndarray, "h w"]
    """Depth along the optical axis, meters; 0 in the sky."""
    object_indices: Int16[np.ndarray, "h w"]
    """Position in World.actors, or BACKGROUND."""
    sky: Bool[np.ndarray, "h w"]


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

    def seen_by(self, camera: StreetCamera, samples: int, window: Window = EVERYWHERE) -> Sight:
        """Returns what the pixels of a window see, their light by samples x samples rays each."""
        rays = camera.rays(1, window)
        hits = first_hits(self.scene, rays)
        linear = self._radiance(camera, rays, hits, 1) if samples == 1 else self.light(camera, samples, window)
        sky = hits.parts == NOTHING
        depth = np.where(sky, 0, hits.distances * camera.axis_cosines(window)).astype(np.float32)
        objects = np.where(sky, BACKGROUND, self.scene.object_indices[hits.parts]).astype(np.int16)
        return Sight(linear, depth, objects, sky)

    def light(self, camera: StreetCamera, samples: int, window: Window = EVERYWHERE) -> Float32[np.ndarray, "3 h w"]:
        """Returns the light of the same pixels alone."""
        rays = camera.rays(samples, window)
        return self._radiance(camera, rays, first_hits(self.scene, rays), samples)

    def _radiance(self, camera: StreetCamera, rays: Rays, hits: Hits, samples: int) -> Float32[np.ndarray, "3 h w"]:
        pixel = 1 / float(camera.intrinsics[0, 0]) / samples
        linear = radiance(self.scene, self.sunlit, self.weather, rays, hits, pixel)
        height, width = hits.parts.shape
        return linear.reshape(3, height // samples, samples, width // samples, samples).mean((2, 4))
