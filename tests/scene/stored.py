"""A scene with every kind of node, as training leaves it."""

from dataclasses import replace

import torch
from torch import Tensor

from sparsestreet.ops import SplatSettings
from sparsestreet.scene.density import GradientDensity
from sparsestreet.scene.effects import Sky, SkySettings
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.masks import StaticMaskSettings
from sparsestreet.scene.nodes import Background, Rigid
from sparsestreet.scene.rendering import RenderOptions, SceneRendering
from sparsestreet.scene.storage import StoredScene
from sparsestreet.types import View
from tests.scene.street import (
    SOURCES,
    background_settings,
    camera_at,
    keyframes,
    pose,
    random_rows,
    rigid_settings,
    track,
    view_at,
)

OPTIONS = RenderOptions(SplatSettings(alpha_min=1 / 300, near_plane=0.123, max_sigma=3.7), backend="reference")
"""Values that are no round numbers: what a file rounds shows."""

NAMES = ["tram 12", "ünïcode/car"]


def view(time: float = 0.37) -> View:
    """Between the recorded frames; the whole scene lies 6 m ahead."""
    return view_at(time, camera_at(-6.0, width=33, height=21))


def background(count: int, seed: int, *, sh_degree: int, masked: bool = False, min_gaussians: int = 0) -> Background:
    settings = background_settings(
        sh_degree=sh_degree,
        num_points=7,
        sources=SOURCES,
        mask=StaticMaskSettings(2.5e-3),
        masked=masked,
        min_gaussians=min_gaussians,
        max_gaussians=None if masked else 1000,
        density=GradientDensity(cull_opacity=0.003),
    )
    mask = StaticMaskSettings(2.5e-3).build(min_gaussians) if masked else None
    return Background(settings, random_rows(count, seed, sh_degree=sh_degree, mask=mask), mask)


def cars(count: int = 8, *, sh_degree: int = 1, masked: bool = False) -> Rigid:
    """Two objects with names, poses that were corrected, and boxes of different sizes."""
    settings = rigid_settings(sh_degree=sh_degree, mask=StaticMaskSettings(1e-4), masked=masked, max_gap=3)
    mask = StaticMaskSettings(1e-4).build(0) if masked else None
    rows = random_rows(count, 5, sh_degree=sh_degree, mask=mask, instances=torch.arange(count) % 2)
    tracks = [
        track("tram", [0, 2, 4], [pose(0.2 * i, (0.3 * i, -1.0, 1.0)) for i in range(3)]),
        track("car", [1, 3], [pose(1.0, (0.5, 0.0, 0.5)), pose(1.4, (0.5, 1.0, 0.5))]),
    ]
    sizes = torch.tensor([[4.0, 2.0, 1.5], [1.0, 0.5, 2.0]])
    node = Rigid(settings, rows, keyframes(tracks, 5), sizes, names=NAMES, max_gap=0.61, mask=mask)
    with torch.no_grad():
        generator = torch.Generator().manual_seed(6)
        for corrections in (node.rotation_deltas, node.translation_deltas):
            corrections.copy_(0.05 * torch.randn(corrections.shape, generator=generator))
    return node


def sky() -> Sky:
    made = Sky(SkySettings(resolution=5, initial_color=0.3))
    with torch.no_grad():
        made.texels.uniform_(0, 1, generator=torch.Generator().manual_seed(2))
    return made


def stored(sh_degree: int = 1, *, masked: bool = False) -> StoredScene:
    """Two backgrounds, two cars, a sky; with masks, about half of the rows are closed."""
    nodes = {
        "road": background(30, 0, sh_degree=sh_degree, masked=masked, min_gaussians=12),
        "trees": background(9, 1, sh_degree=0, masked=masked),
        "cars": cars(sh_degree=sh_degree, masked=masked),
    }
    with torch.no_grad():
        for seed, node in enumerate(nodes.values()):
            if masked:  # around -4.6, where a score of 0.01 lies
                generator = torch.Generator().manual_seed(seed)
                node.rows.mask_logits.copy_(torch.randn(len(node.rows), generator=generator) - 4.6)
    return StoredScene(SceneGraph(nodes, {"sky": sky()}), OPTIONS, "hand-made", 5)


def with_nodes(scene: StoredScene, **nodes) -> StoredScene:
    return replace(scene, scene=scene.scene.with_nodes(nodes))


def pixels(rendering: SceneRendering) -> list[Tensor]:
    """What must not change by a bit."""
    return [rendering.rgb, rendering.alpha, rendering.depth]
