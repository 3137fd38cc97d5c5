"""How many recorded images showed each Gaussian. What none showed is a guess, as below a car that is removed."""

from collections.abc import Iterable, Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.ops import contribution
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.storage import StoredScene
from sparsestreet.types import View

_COLUMN = "images_seen"


@torch.no_grad()
def count_images(stored: StoredScene, views: Iterable[View]) -> None:
    """Gives the rows of all nodes a column: the number of views in which a Gaussian shows.

    It shows where it has the largest part of at least one pixel, as in the paper's importance. What another Gaussian
    hides has no such pixel. Objects that are edited, moved or copied later take their counts along.
    """
    counts = {
        name: torch.zeros(len(node.rows), dtype=torch.int64, device=node.rows.means.device)
        for name, node in stored.scene.nodes.items()
    }
    for view in views:
        placed = stored.scene.gaussians_at(view)
        options = stored.options
        counted = contribution(placed.gaussians, placed.view.camera, settings=options.settings, backend=options.backend)
        for name, rows in placed.spans.items():
            counts[name] += counted.dominant[rows] > 0
    for name, node in stored.scene.nodes.items():
        node.rows.register_buffer(_COLUMN, counts[name], persistent=False)


def images_seen(scene: SceneGraph, spans: Mapping[str, slice]) -> Float[Tensor, " n"]:
    """Returns the counts in the order of a rendering's rows; 0 for what the recorded images never had.

    Raises ValueError where no node has counts.
    """
    columns = {name: scene.nodes[name].rows.columns() for name in spans}
    if not any(_COLUMN in found for found in columns.values()):
        raise ValueError("nobody has counted the recorded images of this scene: call count_images before it is edited")
    return torch.cat([found.get(_COLUMN, torch.zeros_like(found["means"][:, 0])).float() for found in columns.values()])
