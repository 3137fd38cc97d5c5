"""Sun, sky and clouds, and the light that they give to a surface."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from sparsestreet.data.synthetic.noise import smooth_noise, stream
from sparsestreet.data.synthetic.textures.appearance import Color, Scalars, Vectors, column, mix

SUNLIGHT = (2.55, 2.35, 2.0)
SKY_AMBIENT = (0.52, 0.62, 0.80)
GROUND_AMBIENT = (0.34, 0.31, 0.27)


@dataclass(frozen=True)
class Weather:
    """The light of the whole drive, in linear RGB radiance; 1 is about white in the picture."""

    sun: Float32[np.ndarray, "3"]
    """Unit direction towards the sun, world frame."""
    zenith: Color
    horizon: Color
    cloudiness: float
    """Approximate share of the sky that clouds cover."""
    cloud_offset: float

    def radiance(self, directions: Vectors) -> Vectors:
        """Returns the sky in unit directions of the world frame; it has the horizon's color below the horizon."""
        up = np.maximum(directions[2], 0)
        sky = mix(column(self.horizon), column(self.zenith), 1 - np.exp(np.float32(-3.2) * up))
        sky = mix(sky, column((0.98, 0.98, 0.99)), self._clouds(directions, up))
        towards = np.maximum((directions * self.sun[:, None]).sum(0), 0)
        glow = np.float32(0.35) * towards**6 + np.float32(0.7) * towards**64 + np.float32(6) * (towards > 0.9993)
        return sky + column((1.0, 0.9, 0.72)) * glow

    def _clouds(self, directions: Vectors, up: Scalars) -> Scalars:
        """Returns the opacity of clouds on a plane 1 unit above, faded at the horizon, where it would be noise."""
        reach = np.float32(1) / (up + np.float32(0.22))
        u, v = directions[0] * reach, directions[1] * reach
        shift, none = np.float32(self.cloud_offset), np.zeros_like(u)
        density = smooth_noise(u + shift, v - shift, 0.9, none) + np.float32(0.5) * smooth_noise(
            u, v + shift, 0.33, none
        )
        density += np.float32(0.22) * smooth_noise(u - shift, v, 0.13, none)
        cover = np.clip((density - np.float32(1.3 - 2.2 * self.cloudiness)) * np.float32(0.7), 0, 1)
        return np.float32(0.85) * cover * np.clip(up * 7, 0, 1)

    def ambient(self, normals: Vectors) -> Vectors:
        """Returns the light from sky and ground on a surface with these normals."""
        return mix(column(GROUND_AMBIENT), column(SKY_AMBIENT), np.float32(0.5) + np.float32(0.5) * normals[2])


def random_weather(seed: int) -> Weather:
    """Returns weather with a sun close enough to the street's direction that houses do not shade all of the road."""
    rng = stream(seed, "weather")
    azimuth = float(rng.uniform(0.12, 0.30)) * np.pi * (1 if rng.random() < 0.5 else -1)
    if rng.random() < 0.6:  # from behind, so that more of the front camera's view is lit
        azimuth = np.pi - azimuth
    elevation = np.radians(float(rng.uniform(38, 56)))
    sun = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    blue = float(rng.uniform(0.8, 1.1))
    return Weather(
        sun=sun.astype(np.float32),
        zenith=(0.13 * blue, 0.28 * blue, 0.62 * blue),
        horizon=(0.62, 0.72, 0.84),
        cloudiness=float(rng.uniform(0.25, 0.55)),
        cloud_offset=float(rng.uniform(0, 25)),
    )
