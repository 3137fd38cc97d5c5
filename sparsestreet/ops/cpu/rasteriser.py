"""The C++ backend as an autograd function over torch tensors."""

from ctypes import byref, c_double

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from sparsestreet.ops.cpu import library as native
from sparsestreet.ops.cpu.workspace import FASTEST_VARIANT, Lease
from sparsestreet.ops.raster import PairLimitError, Raster
from sparsestreet.ops.settings import SplatSettings
from sparsestreet.ops.validate import check_values
from sparsestreet.types import Camera, Contribution, Gaussians

DTYPES = (torch.float32, torch.float64)
PAIR_LIMIT = 1 << 28
"""(splat, tile) pairs of one rendering; each takes 8 bytes forward and 48 (float32) more backward."""


def rasterise(
    gaussians: Gaussians,
    screen_offsets: Float[Tensor, "n 2"],
    camera: Camera,
    settings: SplatSettings,
    variant: int = FASTEST_VARIANT,
) -> Raster:
    """Project, sort by tile and blend; float32 or float64. Bitwise the same for any number of threads.

    ``variant`` picks an instruction set: 0 baseline, 1 x86-64-v3, 2 x86-64-v4, -1 the fastest that runs here.
    """
    _check_dtype(gaussians)
    g = gaussians
    layers = _Blend.apply(
        g.means, g.quaternions, g.scales, g.opacities, g.sh, screen_offsets, _view(camera, settings), variant
    )
    return Raster(*layers)


def contribution(
    gaussians: Gaussians, camera: Camera, settings: SplatSettings, variant: int = FASTEST_VARIANT
) -> Contribution:
    """Blend weights, touched pixels and dominated pixels per row of one view."""
    _check_dtype(gaussians)
    g = gaussians
    fields = tuple(field.detach().contiguous() for field in (g.means, g.quaternions, g.scales, g.opacities, g.sh))
    lease, report = Lease(g.means.dtype, variant), native.Report()
    weight = torch.empty(len(g), dtype=torch.float64)
    pixels, dominant = torch.empty(2, len(g), dtype=torch.int64)
    counters = native.Counters(weight.data_ptr(), pixels.data_ptr(), dominant.data_ptr())
    status = native.load_library().splat_contribution(
        lease.workspace.handle, byref(_view(camera, settings)), byref(_rows(fields)), byref(counters), byref(report)
    )
    _raise_for(status, fields, report)
    return Contribution(weight, pixels, dominant)


class _Blend(torch.autograd.Function):
    """Five fields and the screen offsets to the layers of a Raster."""

    @staticmethod
    def forward(ctx, means, quaternions, scales, opacities, sh, screen_offsets, view, variant):
        ctx.set_materialize_grads(False)
        fields = tuple(field.contiguous() for field in (means, quaternions, scales, opacities, sh))
        rgb = means.new_empty(view.height, view.width, 3)
        transmittance, depth_sum = means.new_empty(2, view.height, view.width)
        radii = means.new_empty(means.shape[0])
        lease, report = Lease(means.dtype, variant), native.Report()
        status = native.load_library().splat_forward(
            lease.workspace.handle,
            byref(view),
            byref(_rows(fields)),
            byref(_layers(rgb, transmittance, depth_sum)),
            radii.data_ptr(),
            byref(report),
        )
        _raise_for(status, fields, report)
        ctx.mark_non_differentiable(radii)
        ctx.save_for_backward(*fields, rgb, transmittance, depth_sum)
        ctx.view, ctx.lease = view, lease
        return rgb, transmittance, depth_sum, radii

    @staticmethod
    @once_differentiable
    def backward(ctx, v_rgb, v_transmittance, v_depth_sum, _v_radii):
        *fields, rgb, transmittance, depth_sum = ctx.saved_tensors
        cotangents = [None if v is None else v.contiguous() for v in (v_rgb, v_transmittance, v_depth_sum)]
        gradients = [torch.empty_like(field) for field in fields]
        screen = fields[0].new_empty(fields[0].shape[0], 2)
        status = native.load_library().splat_backward(
            ctx.lease.workspace.handle,
            byref(ctx.view),
            byref(_rows(fields)),
            byref(_layers(rgb, transmittance, depth_sum)),
            byref(_layers(*cotangents)),
            byref(native.RowGradients(*(gradient.data_ptr() for gradient in gradients), screen.data_ptr())),
        )
        _raise_for(status, fields, native.Report())
        return *gradients, screen, None, None


def _check_dtype(gaussians: Gaussians) -> None:
    if gaussians.means.dtype not in DTYPES:
        raise ValueError(
            f"backend 'cpu' computes in float32 or float64, got {gaussians.means.dtype}: convert the Gaussians with "
            "dataclasses.replace and .float(), or use backend='reference'"
        )


def _view(camera: Camera, settings: SplatSettings) -> native.View:
    pose, intrinsics = camera.camera_from_world.tolist(), camera.intrinsics.tolist()
    return native.View(
        (c_double * 9)(*(value for row in pose[:3] for value in row[:3])),
        (c_double * 3)(*(row[3] for row in pose[:3])),
        intrinsics[0][0],
        intrinsics[1][1],
        intrinsics[0][2],
        intrinsics[1][2],
        settings.alpha_min,
        settings.alpha_max,
        settings.transmittance_min,
        settings.blur,
        settings.near,
        camera.width,
        camera.height,
        settings.stop == "exclusive",
        settings.antialias,
        PAIR_LIMIT,
        torch.get_num_threads(),
    )


def _rows(fields: tuple[Tensor, ...] | list[Tensor]) -> native.Rows:
    return native.Rows(fields[0].shape[0], fields[4].shape[1], *(field.data_ptr() for field in fields))


def _layers(*layers: Tensor | None) -> native.Layers:
    return native.Layers(*(None if layer is None else layer.data_ptr() for layer in layers))


def _raise_for(status: int, fields: tuple[Tensor, ...] | list[Tensor], report: native.Report) -> None:
    if status == native.STATUS_OK:
        return
    if status == native.STATUS_BAD_VALUE:
        check_values(Gaussians(*fields))
    if status == native.STATUS_TOO_MANY_PAIRS:
        worst = [(row, pairs) for row, pairs in zip(report.worst_rows, report.worst_pairs, strict=True) if row >= 0]
        raise PairLimitError.of(report.pairs, PAIR_LIMIT, worst)
    if status == native.STATUS_OUT_OF_MEMORY:
        raise MemoryError("no memory for the buffers of the splat op: render a smaller image or fewer rows")
    raise RuntimeError(f"the splat library answered status {status}, which this package does not know")
