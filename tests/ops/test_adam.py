"""Adam of the rows whose gradient is finite: all backends against torch's Adam, and what they refuse."""

import pytest
import torch
from torch import Tensor

from sparsestreet.ops.adam import NONE, AdamStep, adam_rows_
from sparsestreet.ops.backend import has_triton
from sparsestreet.ops.cpu.library import load_library
from tests.ops.scenes import device_of, relative_error

BACKENDS = ["torch", "cpu"] + ["triton"] * has_triton()
SHAPES = [(7, 15, 3), (1, 1), (5,), (300, 3), (21, 11)]
STEPS, LR, BETAS, EPS = 4, 0.05, (0.8, 0.97), 1e-15
# Four steps round a moment twelve times by up to 6e-8; a parameter, larger than its steps, hardly feels that.
BARS = {"parameter": 1e-7, "exp_avg": 2e-7, "exp_avg_sq": 2e-7}


def inputs(shape: tuple[int, ...], device: torch.device) -> tuple[Tensor, list[Tensor]]:
    """A parameter and gradients of sizes from 1e-6 to 1."""
    generator = torch.Generator().manual_seed(0)
    gradients = [
        torch.randn(shape, generator=generator) * 10 ** (-6 * torch.rand(shape, generator=generator))
        for _ in range(STEPS)
    ]
    return torch.randn(shape, generator=generator).to(device), [one.to(device) for one in gradients]


def nothing_refused(device: torch.device) -> Tensor:
    return torch.tensor([0, NONE], device=device)


def width_of(shape: tuple[int, ...]) -> int:
    return torch.Size(shape[1:]).numel()


def theirs(start: Tensor, gradients: list[Tensor], fused: bool = False) -> dict[str, Tensor]:
    parameter = torch.nn.Parameter(start.clone())
    adam = torch.optim.Adam([parameter], lr=LR, betas=BETAS, eps=EPS, fused=fused)
    for parameter.grad in gradients:
        adam.step()
    state = adam.state[parameter]
    return {"parameter": parameter.detach(), "exp_avg": state["exp_avg"], "exp_avg_sq": state["exp_avg_sq"]}


def ours(start: Tensor, gradients: list[Tensor], backend: str) -> dict[str, Tensor]:
    parameter, first, second = start.clone(), torch.zeros_like(start), torch.zeros_like(start)
    refused = nothing_refused(start.device)
    for count, gradient in enumerate(gradients, 1):
        step, width = AdamStep(count, LR, BETAS, EPS), width_of(start.shape)
        adam_rows_(parameter, gradient, first, second, refused, step, width=width, backend=backend)
    assert refused.tolist() == [0, NONE]
    return {"parameter": parameter, "exp_avg": first, "exp_avg_sq": second}


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("shape", SHAPES)
def test_where_all_is_finite_it_is_torchs_adam(shape, backend):
    start, gradients = inputs(shape, device_of(backend))
    found, wanted = ours(start, gradients, backend), theirs(start, gradients)
    for name, bar in BARS.items():
        assert relative_error(found[name], wanted[name]) <= bar, name


@pytest.mark.skipif(
    torch.backends.cpu.get_cpu_capability() not in ("AVX2", "AVX512")
    or load_library().splat_variant_name(-1) == b"baseline"
    or not torch.__version__.startswith("2.13."),
    reason="without fused multiplication torch and the library round otherwise, and torch may in other versions",
)
@pytest.mark.parametrize("shape", [*SHAPES, (3000, 4), (13,)])
def test_the_library_has_the_bits_of_torchs_fused_adam(shape):
    start, gradients = inputs(shape, torch.device("cpu"))
    found, wanted = ours(start, gradients, "cpu"), theirs(start, gradients, fused=True)
    for name in BARS:
        assert torch.equal(found[name], wanted[name]), name


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("shape", [(700, 15, 3), (300,), (130, 4)])
def test_rows_whose_gradient_is_not_finite_keep_every_bit_and_are_counted(shape, backend):
    """All others step as if these were not there. The table spans several blocks of a kernel."""
    start, (gradient, *_) = inputs(shape, device_of(backend))
    rows, width = shape[0], width_of(shape)
    bad = torch.tensor([5, 6, rows - 1], device=start.device)
    clean = gradient.clone()
    for place, (row, value) in enumerate(zip(bad.tolist(), (torch.nan, torch.inf, -torch.inf), strict=True)):
        gradient.view(rows, width)[row, (place * 7) % width] = value
    fields = {name: (torch.full_like(start, 0.25), torch.full_like(start, 0.5)) for name in ("given", "clean")}
    tables = {"given": (start.clone(), gradient), "clean": (start.clone(), clean)}
    for name, (parameter, given) in tables.items():
        refused = nothing_refused(start.device)
        adam_rows_(parameter, given, *fields[name], refused, AdamStep(3, LR), width=width, backend=backend)
        assert refused.tolist() == ([3, 5] if name == "given" else [0, NONE])
    others = torch.ones(rows, dtype=torch.bool, device=start.device).index_fill(0, bad, False)
    for before, found, wanted in zip(
        (start, torch.full_like(start, 0.25), torch.full_like(start, 0.5)),
        (tables["given"][0], *fields["given"]),
        (tables["clean"][0], *fields["clean"]),
        strict=True,
    ):
        assert torch.equal(found[bad], before[bad])
        # The library rounds the last numbers of a tensor otherwise only where they are the tensor's last.
        assert torch.equal(found[others], wanted[others])


@pytest.mark.parametrize("backend", BACKENDS)
def test_counts_add_up_and_the_first_row_stays_the_first(backend):
    start, (gradient, *_) = inputs((9, 3), device_of(backend))
    gradient[7] = torch.nan
    refused = torch.tensor([4, 2], device=start.device)
    moments = torch.zeros_like(start), torch.zeros_like(start)
    adam_rows_(start, gradient, *moments, refused, AdamStep(1, LR), width=3, backend=backend)
    assert refused.tolist() == [5, 2]


def test_huge_numbers_are_finite_and_none_at_all_is_no_error():
    parameter, gradient = torch.zeros(2, 3), torch.full((2, 3), 3e38)
    refused = nothing_refused(parameter.device)
    for backend in BACKENDS[:2]:
        adam_rows_(parameter, gradient, parameter.clone(), parameter.clone(), refused, AdamStep(1, LR), width=3,
                   backend=backend)  # fmt: skip
    empty = torch.zeros(0, 3)
    adam_rows_(empty, empty, empty, empty, refused, AdamStep(1, LR), width=3)
    assert refused.tolist() == [0, NONE]


def test_a_view_as_gradient_and_shapes_that_do_not_fit():
    start, (gradient, *_) = inputs((6, 6), torch.device("cpu"))
    ends = []
    for given in (gradient.T, gradient.T.contiguous()):
        parameter, refused = start.clone(), nothing_refused(start.device)
        moments = torch.zeros_like(start), torch.zeros_like(start)
        adam_rows_(parameter, given, *moments, refused, AdamStep(1, LR), width=6)
        ends.append(parameter)
    assert torch.equal(*ends)
    refused = nothing_refused(start.device)
    with pytest.raises(ValueError, match="one shape"):
        adam_rows_(start, gradient[:3], start, start, refused, AdamStep(1, LR), width=6)
    with pytest.raises(ValueError, match="36 numbers do not come in rows of 5"):
        adam_rows_(start, gradient, start, start, refused, AdamStep(1, LR), width=5)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_graph_of_older_values_refuses_its_backward_pass(backend):
    start, (gradient, *_) = inputs((6, 3), device_of(backend))
    parameter = start.clone().requires_grad_()
    loss = (parameter * parameter).sum()
    moments, refused = (torch.zeros_like(start), torch.zeros_like(start)), nothing_refused(start.device)
    adam_rows_(parameter, gradient, *moments, refused, AdamStep(1, LR), width=3, backend=backend)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()
