"""A scene of a few Gaussians, and renders that a test knows."""

from types import SimpleNamespace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sparsestreet.evaluation import evaluate
from sparsestreet.scene.effects import Sky, SkySettings
from sparsestreet.scene.gaussians import Rows, Selection
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.learning_rate import LearningRate
from sparsestreet.scene.masks import Mask
from sparsestreet.scene.nodes import Background, BackgroundSettings
from sparsestreet.scene.rendering import RenderOptions

OPTIONS = RenderOptions(backend="reference")

SETTINGS = BackgroundSettings(
    num_points=0,
    sources={},
    min_gaussians=0,
    max_gaussians=None,
    sh_degree=0,
    mask=None,
    masked=False,
    density=None,
    prunable=False,
    learning_rates={"rows": LearningRate(0.1)},
)


def node_of(points: list[list[float]]) -> Background:
    """Dark Gaussians of 0.2 m at some points."""
    count = len(points)
    columns = {
        "means": torch.tensor(points).reshape(count, 3),
        "log_scales": torch.full((count, 3), -1.6),
        "quaternions": torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        "opacity_logits": torch.full((count,), 2.0),
        "sh_dc": torch.full((count, 1, 3), -1.0),
        "sh_rest": torch.zeros(count, 0, 3),
    }
    return Background(SETTINGS, Rows(columns))


def small_scene() -> SceneGraph:
    """Three Gaussians ahead and one behind the cameras of ``frames.make_frame``, which look along z; a gray sky."""
    ahead = [[0.4, 0.3, 2.0], [0.6, 0.5, 3.0]]
    return SceneGraph(
        {"road": node_of(ahead), "cars": node_of([[0.2, 0.6, 1.5], [0.0, 0.0, -2.0]])},
        {"sky": Sky(SkySettings(resolution=2))},
    )


def replace_render(monkeypatch, colors, module=evaluate) -> None:
    """Let a module see ``colors(view)`` [h, w, 3] instead of a scene's render."""
    monkeypatch.setattr(module, "render", lambda scene, view, options: SimpleNamespace(rgb=colors(view)))


class TwoTimes(Mask):
    """Closes the first row always and the second before time 0.05."""

    columns = ()
    sparsity_weight = 0.0

    def initial_columns(self, num_rows: int) -> dict[str, Tensor]:
        return {}

    def multipliers(self, rows: Rows, time: float) -> Float[Tensor, " n"]:
        shown = torch.ones(len(rows))
        shown[: 2 if time < 0.05 else 1] = 0
        return shown

    def sparsity(self, rows: Rows, time: float, visible: Bool[Tensor, " n"]) -> Float[Tensor, ""]:
        return torch.zeros(())

    def keep(self, rows: Rows) -> Selection:
        raise NotImplementedError

    def finish(self, rows: Rows) -> tuple[Mask | None, dict[str, Tensor]]:
        raise NotImplementedError


def masked_scene() -> SceneGraph:
    """A road of four Gaussians, of which two show at time 0 and three later; a car; a gray sky."""
    road = node_of([[0.4, 0.3, 2.0], [0.6, 0.5, 3.0], [0.2, 0.1, 2.5], [0.0, 0.2, 2.2]])
    road.mask = TwoTimes()
    return SceneGraph({"road": road, "cars": node_of([[0.2, 0.6, 1.5]])}, {"sky": Sky(SkySettings(resolution=2))})
