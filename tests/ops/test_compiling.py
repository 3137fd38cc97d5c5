"""Functions around the op under torch.compile, and derivatives of its derivatives."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from sparsestreet.ops import contribution, leave_one_out, over_sky, splat
from sparsestreet.ops.activate import activate
from sparsestreet.ops.raw import RawGaussians
from sparsestreet.types import Camera
from tests.ops.scenes import camera, cast, every_backend, random_gaussians

VIEW = camera(24, 16)


def stored(count: int = 20) -> RawGaussians:
    drawn = cast(random_gaussians(count, VIEW), torch.float32)
    logits, sh = drawn.opacities.clamp(0.01, 0.99).logit(), drawn.dense_sh()
    fields = (drawn.means, drawn.scales.log(), drawn.quaternions, logits, sh[:, :1], sh[:, 1:])
    means, scales, quaternions, logits, first, rest = (values.detach().clone().requires_grad_() for values in fields)
    return RawGaussians(means, scales, quaternions, logits, first, rest)


def street(raw: RawGaussians, texels: Tensor, view: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """All public steps, with torch between them; what they answer."""
    gaussians = activate([raw], sh_degree=1)
    seen = splat(gaussians, view)
    image = over_sky(2 * seen.rgb, seen.alpha, texels.sigmoid(), view, transmittance_min=1e-4)
    return image, contribution(gaussians, view).weight + 1, leave_one_out(gaussians, view).max_abs_change + 1


@pytest.mark.slow
# Dynamo's own, wherever a graph goes on with a tensor that has a history.
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")
def test_compiled_around_the_op_it_is_the_same_without_a_warning():
    """Warnings are errors here; Dynamo would warn of caches and pointers that it cannot trace."""
    answers = []
    for function in (street, torch.compile(street, backend="eager")):
        raw, texels = stored(), torch.zeros(6, 2, 2, 3, requires_grad=True)
        image, *numbers = function(raw, texels, VIEW)
        image.backward(torch.randn(image.shape, generator=torch.Generator().manual_seed(0)))
        answers.append([image.detach(), *numbers, raw.means.grad, raw.sh_dc.grad, texels.grad])
    for plain, compiled in zip(*answers, strict=True):
        assert plain.abs().sum() > 0
        assert torch.equal(plain, compiled)


def slope(backend: str, loss: Callable[[Tensor], Tensor]) -> Tensor:
    """The gradient of a loss, for which autograd was asked to keep a graph."""
    gaussians = cast(random_gaussians(5, VIEW), torch.float32, requires_grad=True)
    value = loss(splat(gaussians, VIEW, backend=backend).rgb)
    return torch.autograd.grad(value, gaussians.opacities, create_graph=True)[0]


@every_backend
def test_only_the_reference_has_second_derivatives(backend):
    twice = slope(backend, torch.norm).sum()
    if backend == "reference":
        twice.backward()
        assert slope(backend, torch.sum).requires_grad
        return
    with pytest.raises(RuntimeError, match="differentiate twice"):
        twice.backward()
    assert not slope(backend, torch.sum).requires_grad
