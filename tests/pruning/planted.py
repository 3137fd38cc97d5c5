"""Planted truth: put Gaussians into a scene that no view needs, prune, and see who went.

A row is *visible* if removing it alone moves a channel of a pixel of a view by more than one 8-bit step, or by more
than a coarser step that the caller names. ``plant`` adds two kinds of useless rows, each checked to be invisible
before it is accepted: *hidden* ones lie behind what some view sees, inside or behind opaque surfaces; *copies* are
small, faint doubles just under an existing row. All lie in the image of a view (outside of all views would be no
test). ``judge`` compares a selection with that truth.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sparsestreet.geometry.cameras import project, ray_directions
from sparsestreet.ops import contribution, splat
from sparsestreet.scene.gaussians import RowPlan, Rows
from sparsestreet.types import Camera, Gaussians

NOTICEABLE = 1 / 255
"""One step of an 8-bit image: what no screen shows is not seen."""

PROPOSALS = 6
"""Places that are tried for each useless row: a pixel here and there shows what was to be hidden."""


@dataclass(frozen=True)
class Verdict:
    recall: float
    """Share of the planted rows that were removed."""
    visible_lost: float
    """Share of the visible rows that were removed."""
    num_planted: int
    num_visible: int


def judge(keep: Bool[Tensor, " n"], planted: Bool[Tensor, " n"], visible: Bool[Tensor, " n"]) -> Verdict:
    """Hold a selection against the truth; ``visible`` may mark a sample of the visible rows only."""
    num_planted, num_visible = int(planted.sum()), int(visible.sum())
    return Verdict(
        float((planted & ~keep).sum()) / num_planted,
        float((visible & ~keep).sum()) / num_visible,
        num_planted,
        num_visible,
    )


def activated(rows: Rows) -> Gaussians:
    """Rows in the world frame as the rasterizer takes them, unmasked."""
    columns = {name: column.detach() for name, column in rows.columns().items()}
    return Gaussians(
        columns["means"],
        columns["quaternions"],
        columns["log_scales"].exp(),
        columns["opacity_logits"].sigmoid(),
        torch.cat((columns["sh_dc"], columns["sh_rest"]), dim=1),
    )


class Views:
    """Images of a scene from all cameras, to be compared with images of the scene without one of its rows."""

    def __init__(
        self,
        gaussians: Gaussians,
        cameras: Sequence[Camera],
        backend: str = "auto",
        sky_images: Sequence[Tensor] | None = None,
    ) -> None:
        """``sky_images``: what stands behind the Gaussians in each view; None: black."""
        self.gaussians, self.cameras, self.backend = gaussians, cameras, backend
        self.sky_images = [None] * len(cameras) if sky_images is None else sky_images
        self.images = [self._image(gaussians, index) for index in range(len(cameras))]
        self.contributions = [contribution(gaussians, camera, backend=backend) for camera in cameras]

    def movement(self, row: int, enough: float = torch.inf) -> float:
        """Largest change of a channel of a pixel of a view when this row alone is removed (exact up to ``enough``).

        Views are rendered again without the row, those with the largest weight first; the ones into which the
        row was not blended cannot change.
        """
        weights = [float(view.weight[row]) for view in self.contributions]
        opacities = self.gaussians.opacities.clone()
        opacities[row] = 0
        without = replace(self.gaussians, opacities=opacities)
        largest = 0.0
        for index in sorted(range(len(weights)), key=lambda index: -weights[index]):
            if weights[index] == 0 or largest > enough:
                break
            largest = max(largest, float((self._image(without, index) - self.images[index]).abs().max()))
        return largest

    @torch.no_grad()
    def _image(self, gaussians: Gaussians, index: int) -> Tensor:
        return splat(gaussians, self.cameras[index], background=self.sky_images[index], backend=self.backend).rgb

    def visible(self, rows: Int[Tensor, " k"], more_than: float = NOTICEABLE) -> Bool[Tensor, " n"]:
        """Marks those of the given rows whose leave_one_out moves a view by more than ``more_than``."""
        marked = torch.zeros(len(self.gaussians), dtype=torch.bool)
        for row in rows.tolist():
            marked[row] = self.movement(row, enough=more_than) > more_than
        return marked


def plant(
    rows: Rows,
    cameras: Sequence[Camera],
    generator: torch.Generator,
    hidden: int,
    copies: int,
    backend: str = "auto",
    sky_images: Sequence[Tensor] | None = None,
) -> tuple[Rows, Bool[Tensor, " n"]]:
    """A table of the old rows followed by ``hidden`` + ``copies`` useless ones, and which these are.

    ``rows`` are in the world frame (a background node). Raises ValueError if the scene has too few opaque places.
    """
    views = Views(activated(rows), cameras, backend, sky_images)
    # Three proposals for each row wanted: some places turn out to be seen from elsewhere.
    proposals = [
        _propose_hidden(rows, views, PROPOSALS * hidden, generator),
        _propose_copies(rows, views, PROPOSALS * copies, generator),
    ]
    candidates = _resized(rows, _append(rows, proposals))
    means = candidates.means.detach()[len(rows) :]
    possible = torch.stack([project(camera, means)[2] for camera in cameras]).any(0)
    is_hidden = torch.arange(len(means)) < PROPOSALS * hidden
    while True:
        chosen = _first(possible & is_hidden, hidden) | _first(possible & ~is_hidden, copies)
        keep = torch.cat((torch.ones(len(rows), dtype=torch.bool), chosen))
        planted = _resized(candidates, RowPlan.keep(keep))
        moving = _moving(Views(activated(planted), cameras, backend, sky_images), len(rows))
        if not moving.any():
            return planted, torch.arange(len(planted)) >= len(rows)
        possible[torch.nonzero(chosen).squeeze(-1)[moving]] = False


def _first(possible: Bool[Tensor, " m"], wanted: int) -> Bool[Tensor, " m"]:
    """The first ``wanted`` of the marked."""
    found = int(possible.sum())
    if found < wanted:
        raise ValueError(f"the scene is too transparent: only {found} places left for {wanted} useless rows")
    return possible & (possible.cumsum(0) <= wanted)


def _propose_hidden(rows: Rows, views: Views, number: int, generator: torch.Generator) -> RowPlan:
    """Places behind the surfaces that random pixels of random views show, 0.1 to 2 m deep; sizes fit the depth."""
    places, gaps = [], []
    for index, camera in enumerate(views.cameras):
        share = number // len(views.cameras) + (index < number % len(views.cameras))
        with torch.no_grad():
            rendering = splat(views.gaussians, camera, backend=views.backend)
        opaque = torch.nonzero(rendering.alpha > 0.98)
        if not len(opaque):
            raise ValueError(f"view {index} shows no opaque pixel: nothing can be hidden there")
        y, x = opaque[torch.randint(len(opaque), (share,), generator=generator)].unbind(-1)
        direction = ray_directions(camera)[y, x]
        # depth is along the optical axis, the gap along the ray
        depth = rendering.depth[y, x] / (direction @ camera.camera_from_world[2, :3])
        gap = 0.1 + 1.9 * torch.rand(share, generator=generator)
        places.append(camera.position + direction * (depth + gap)[:, None])
        gaps.append(gap)
    parents = torch.randint(len(rows), (number,), generator=generator)
    log_scales = rows.log_scales.detach()[parents]
    limit = (torch.cat(gaps) / 4).log()[:, None]  # four standard deviations fit into the gap
    edits = {"means": torch.cat(places), "log_scales": torch.minimum(log_scales, limit)}
    return RowPlan(len(rows), parents, torch.ones_like(parents, dtype=torch.bool), edits)


def _propose_copies(rows: Rows, views: Views, number: int, generator: torch.Generator) -> RowPlan:
    """Doubles of rows that some view shows: a third of the size, opacity 0.02 to 0.12, just behind the original."""
    shown = torch.stack([view.dominant > 0 for view in views.contributions]).any(0).nonzero().squeeze(-1)
    parents = shown[torch.randint(len(shown), (number,), generator=generator)]
    means, scales = rows.means.detach()[parents], rows.log_scales.detach()[parents].exp()
    eye = torch.stack([camera.position for camera in views.cameras]).mean(0)
    away = torch.nn.functional.normalize(means - eye, dim=-1)
    opacities = 0.02 + 0.1 * torch.rand(number, generator=generator)
    edits = {
        "means": means + away * scales.amin(-1, keepdim=True),
        "log_scales": (scales / 3).log(),
        "opacity_logits": opacities.logit(),
    }
    return RowPlan(len(rows), parents, torch.ones_like(parents, dtype=torch.bool), edits)


def _append(rows: Rows, proposals: list[RowPlan]) -> RowPlan:
    """One plan: all rows as they are, then the proposals."""
    old = torch.arange(len(rows))
    source = torch.cat((old, *(proposal.source for proposal in proposals)))
    edits = {}
    for name in ("means", "log_scales", "opacity_logits"):
        column = rows.columns()[name].detach()
        parts = [proposal.edits.get(name, column[proposal.source]) for proposal in proposals]
        edits[name] = torch.cat((column, *parts))
    return RowPlan(len(rows), source, torch.arange(len(source)) >= len(rows), edits)


def _resized(rows: Rows, plan: RowPlan) -> Rows:
    """A resized copy."""
    parameters, buffers = dict(rows.named_parameters()), dict(rows.named_buffers())
    copy = Rows(parameters, buffers, rows.transient)
    copy.resize(plan)
    return copy


def _moving(views: Views, old: int) -> Bool[Tensor, " m"]:
    """Which of the rows from ``old`` on move some view."""
    largest = torch.stack([view.weight for view in views.contributions]).amax(0)
    # A weight below NOTICEABLE in sum over all pixels moves no pixel by more (colors differ by at most about 1); the
    # others are tested one by one.
    unclear = (largest > NOTICEABLE) & (torch.arange(len(views.gaussians)) >= old)
    return views.visible(torch.nonzero(unclear).squeeze(-1))[old:]


def joint_change(rows: Rows, planted: Bool[Tensor, " n"], cameras: Sequence[Camera], backend: str) -> float:
    """Largest change of any pixel when all planted rows go at once."""
    gaussians = activated(rows)
    with_all = Views(gaussians, cameras, backend).images
    without: list[Float[Tensor, "h w 3"]] = Views(
        replace(gaussians, opacities=gaussians.opacities * ~planted), cameras, backend
    ).images
    return max(float((a - b).abs().max()) for a, b in zip(with_all, without, strict=True))
