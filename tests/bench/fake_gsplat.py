"""gsplat's interface, for tests without a device."""

from types import ModuleType

import torch

from benchmarks import gsplat_baseline
from sparsestreet.ops import splat
from sparsestreet.types import Camera, Gaussians

# What gsplat 1.5.3's rasterization takes, of which we use these.
TAKES = {
    *("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "width", "height", "near_plane"),
    *("eps2d", "sh_degree", "packed", "absgrad", "rasterize_mode"),
}


def fake_gsplat(brightness: float = 1.0, version: str = "1.5.3") -> ModuleType:
    """A module with gsplat's signature that renders with our op, by the settings that match a version."""
    module = ModuleType("gsplat")
    vars(module).update(__version__=version)
    settings = gsplat_baseline.settings_beside(module)

    def rasterization(**given):
        assert set(given) == TAKES
        assert given["viewmats"].shape == (1, 4, 4)
        assert given["Ks"].shape == (1, 3, 3)
        assert given["colors"].shape[1] == (given["sh_degree"] + 1) ** 2
        fields = ("means", "quats", "scales", "opacities", "colors")
        camera = Camera(given["viewmats"][0], given["Ks"][0], given["width"], given["height"])
        rendering = splat(Gaussians(*(given[name] for name in fields)), camera, settings=settings)

        class Means:
            absgrad = property(lambda self: rendering.screen_offsets.grad[None])

        radii = rendering.radii[None, :, None].expand(-1, -1, 2)
        # Six tiles of 16x16, of which the third and the last are empty.
        offsets = torch.tensor([[[0, 2, 3], [3, 4, 7]]], dtype=torch.int32)
        meta = {"flatten_ids": torch.zeros(7, dtype=torch.int32), "means2d": Means(), "radii": radii}
        meta |= {"isect_offsets": offsets}
        return brightness * rendering.rgb[None], rendering.alpha[None, ..., None], meta

    vars(module).update(rasterization=rasterization)
    return module
