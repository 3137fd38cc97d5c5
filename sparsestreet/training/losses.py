"""Loss terms: each is a weighted number from a rendering, the frame it should look like, and the scene."""

from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.data.images import WHITE
from sparsestreet.ops import splat
from sparsestreet.ops.activate import activate
from sparsestreet.ops.photometric import photometric
from sparsestreet.ops.pixel_losses import depth_error, sky_entropy
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import SceneRendering
from sparsestreet.types import Frame


@runtime_checkable
class Loss(Protocol):
    def applies(self, frame: Frame) -> bool:
        """Whether the frame carries what the term compares with."""
        return True

    def __call__(self, rendering: SceneRendering, frame: Frame, scene: SceneGraph) -> Float[Tensor, ""]:
        """The weighted term."""
        ...


@dataclass(frozen=True)
class Photometric(Loss):
    """(1 - lambda) L1 + lambda (1 - SSIM) of colors that are not clamped, but where the sensor was cut off.

    A recorded channel at white says only that at least so much light came: more of it is no error there. A clamp of
    all colors would stop the gradient also of a pixel that is too bright and was recorded darker.
    """

    weight: float = 1.0
    lambda_dssim: float = 0.2
    white: int | None = WHITE
    """Level of 255 from which a recorded channel is a lower bound; None: none is (DriveStudio's loss)."""

    def __call__(self, rendering: SceneRendering, frame: Frame, scene: SceneGraph) -> Float[Tensor, ""]:
        return photometric(
            rendering.rgb, frame.image, lambda_dssim=self.lambda_dssim, white=self.white, weight=self.weight
        )


def without_hood(rendering: SceneRendering, frame: Frame) -> tuple[SceneRendering, Frame]:
    """Return both as losses see them: on the pixels of ``ego`` black, without alpha, and without depth.

    There both images agree, alpha is that of a sky, and nothing has a gradient. Means stay those over all pixels, as in
    DriveStudio. A frame without such a mask and its rendering are returned as they are.
    """
    hood = frame.ego
    if hood is None:
        return rendering, frame
    seen = replace(
        rendering,
        rgb=torch.where(hood[..., None], 0.0, rendering.rgb),
        alpha=torch.where(hood, 0.0, rendering.alpha),
        depth=torch.where(hood, 0.0, rendering.depth),
    )
    recorded = replace(
        frame,
        image=frame.image.masked_fill(hood[..., None], 0),
        sky=None if frame.sky is None else frame.sky | hood,
        depth=None if frame.depth is None else frame.depth.masked_fill(hood, 0.0),
    )
    return seen, recorded


@dataclass(frozen=True)
class SkyMask(Loss):
    """Mean over the pixels of a cross entropy that is finite, and pulls, at every alpha.

    With a = alpha, y = 0 in the sky and 1 elsewhere::

        -(y log((a + eps) / (1 + eps)) + (1 - y) log((1 - a + eps) / (1 + eps)))

    Its derivative is -1 / (a + eps) outside the sky and 1 / (1 - a + eps) in it: it never vanishes. Its magnitude grows
    from 1 / (1 + eps) where alpha is right to 1 / eps where it is most wrong, the value from 0 to log((1 + eps) / eps).
    Clamping alpha bounds both as well, but lets no gradient through where alpha is most wrong. With a ``floor`` f,
    DriveStudio's ``safe_bce``, the logarithms stop at log f, and the gradient stays 1 / f beyond: value and gradient
    are then those of two functions.

    Raises ValueError for an ``eps`` that is not positive, or a ``floor`` outside (0, 1).
    """

    weight: float = 0.05
    eps: float = 1e-3
    floor: float | None = None
    """DriveStudio's ``safe_bce``: 0.1. None: no floor."""

    def __post_init__(self) -> None:
        if not self.eps > 0:
            raise ValueError(f"the cross entropy of an alpha of 0 or 1 is finite for eps > 0 only, got {self.eps}")
        if self.floor is not None and not 0 < self.floor < 1:
            raise ValueError(f"the floor of a cross entropy lies between 0 and 1, got {self.floor}: null for none")

    def applies(self, frame: Frame) -> bool:
        return frame.sky is not None

    def __call__(self, rendering: SceneRendering, frame: Frame, scene: SceneGraph) -> Float[Tensor, ""]:
        assert frame.sky is not None  # it applies
        return sky_entropy(rendering.alpha, frame.sky, weight=self.weight, eps=self.eps, floor=self.floor)


@dataclass(frozen=True)
class Depth(Loss):
    """The inverse depth bounds the pull of far and wrong returns (DriveStudio's paper_legacy configurations)."""

    weight: float = 0.1
    inverse: bool = True
    """False: the depth itself, in meters (its current configurations, with weight 0.01)."""
    nearest: float = 0.5
    farthest: float = 80.0
    """Returns outside [nearest, farthest] meters are left out."""
    nearest_rendered: float | None = None
    """Meters; pixels whose rendered depth is smaller are left out. None: ``nearest``."""

    def applies(self, frame: Frame) -> bool:
        return frame.depth is not None

    def __call__(self, rendering: SceneRendering, frame: Frame, scene: SceneGraph) -> Float[Tensor, ""]:
        assert frame.depth is not None  # it applies
        least = self.nearest if self.nearest_rendered is None else self.nearest_rendered
        return depth_error(
            rendering.depth, frame.depth, weight=self.weight, nearest=self.nearest, farthest=self.farthest,
            nearest_rendered=least, inverse=self.inverse,
        )  # fmt: skip


@dataclass(frozen=True)
class DynamicRegion(Loss):
    """Mean |I - truth| once more over the pixels that objects cover: where they, rendered alone, have enough alpha.

    Objects are what nodes with ``instances`` hold. What stands in front of them does not count: a hidden object has its
    region too. Rendered once more without gradients, and only from ``from_progress`` on; 0 before, and in views
    without objects.
    """

    weight: float = 1.0
    threshold: float = 0.2
    """Alpha of the objects above which a pixel belongs to the region."""
    from_progress: float = 0.6666
    """Fraction of the run before which the term rests."""

    def __call__(self, rendering: SceneRendering, frame: Frame, scene: SceneGraph) -> Float[Tensor, ""]:
        objects = [rendering.parts[name] for name, node in scene.nodes.items() if node.instances() is not None]
        if not objects or rendering.state.progress < self.from_progress:
            return torch.zeros((), device=rendering.rgb.device)
        with torch.no_grad():
            # Of no interest in which colors.
            gaussians, options = activate(objects, sh_degree=0), rendering.options
            camera = scene.seen(frame, rendering.state).camera
            alone = splat(gaussians, camera, settings=options.settings, backend=options.backend)
        region = alone.alpha > self.threshold
        if frame.ego is not None:
            region = region & ~frame.ego
        error = (rendering.rgb - frame.image.to(rendering.rgb.dtype) / 255).abs().mean(-1)
        # Over all pixels, because picking those of the region would wait for a device.
        return self.weight * (torch.where(region, error, 0.0).sum() / region.sum().clamp(min=1))


MIN_DEPTH = 1e-5
"""Meters added to a depth before it is inverted."""


@dataclass(frozen=True)
class InverseDepthSmoothness(Loss):
    """mean(|dx d| exp(-|dx I|)) + mean(|dy d| exp(-|dy I|)) of the inverse depth d; |I| is the mean of the channels.

    Steps between neighbors of which one shows nothing (depth 0) count as none: an inverse depth of 10^5 would stand
    there. ``kornia.losses.inverse_depth_smoothness_loss``, the oracle of the tests, is the same elsewhere.
    """

    weight: float = 0.001

    def __call__(self, rendering: SceneRendering, frame: Frame, scene: SceneGraph) -> Float[Tensor, ""]:
        truth = frame.image.to(rendering.depth.dtype) / 255
        inverse, drawn = 1 / (rendering.depth + MIN_DEPTH), rendering.depth > 0
        terms = []
        for axis in (0, 1):
            steps = inverse.diff(dim=axis).abs() * torch.exp(-truth.diff(dim=axis).abs().mean(-1))
            alike = drawn.narrow(axis, 1, steps.shape[axis]) & drawn.narrow(axis, 0, steps.shape[axis])
            terms.append(torch.where(alike, steps, 0.0).mean())
        return self.weight * (terms[0] + terms[1])


@dataclass(frozen=True)
class MaskSparsity(Loss):
    """K counts all Gaussians of all nodes, masked nodes or not; lambda_n is the ``sparsity_weight`` of the node's own
    mask."""

    weight: float = 1.0
    """lambda_m."""

    def __call__(self, rendering: SceneRendering, frame: Frame, scene: SceneGraph) -> Float[Tensor, ""]:
        rows = max(sum(scene.counts().values()), 1)
        total = torch.zeros((), device=rendering.rgb.device)
        for name, node in scene.nodes.items():
            if node.mask is not None and node.mask.columns:
                visible = rendering.splats.visible[rendering.spans[name]]
                total = total + node.mask.sparsity_weight * node.mask.sparsity(node.rows, frame.time, visible)
        return self.weight * total / rows


@dataclass(frozen=True)
class OpacityEntropy(Loss):
    """Mean over the pixels of -a log((a + eps) / (1 + eps)): 0 at both ends, with a finite slope at each.

    -a log a itself is infinitely steep where nothing is drawn. Raises ValueError for an ``eps`` that is not positive.
    """

    weight: float = 0.05
    eps: float = 1e-6

    def __post_init__(self) -> None:
        if not self.eps > 0:
            raise ValueError(f"the entropy has a finite slope at alpha 0 for eps > 0 only, got {self.eps}")

    def __call__(self, rendering: SceneRendering, frame: Frame, scene: SceneGraph) -> Float[Tensor, ""]:
        alpha = rendering.alpha
        return -self.weight * (alpha * ((alpha + self.eps) / (1 + self.eps)).log()).mean()
