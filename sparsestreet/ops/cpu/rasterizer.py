"""The C++ backend as an autograd function over torch tensors."""

from collections.abc import Sequence
from ctypes import Array, byref, c_double, c_void_p

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from sparsestreet.geometry.cameras import exact_position
from sparsestreet.geometry.lenses import fold_radius_squared
from sparsestreet.ops.cpu import library as native
from sparsestreet.ops.cpu.library import FASTEST_VARIANT, Lease
from sparsestreet.ops.raster import COUNTINGS, SHAPE, LeaveOneOutSums, PairLimitError, Raster, empty_gradients
from sparsestreet.ops.settings import SplatSettings
from sparsestreet.ops.validate import check_dtype, check_values
from sparsestreet.phases import phase
from sparsestreet.types import Camera, Contribution, Gaussians, LeaveOneOut, MedianDepth

PAIR_LIMIT = 1 << 28
"""Most (splat, tile) pairs of one rendering. A pair takes 26 to 28 bytes forward and 48 more backward in float32, and
20 where changes are gathered.

In float64 it takes 34 to 36 and 96. Buffers that have just grown are a quarter larger: up to 24 GB in float32."""


def rasterize(
    gaussians: Gaussians,
    screen_offsets: Float[Tensor, "n 2"],
    camera: Camera,
    settings: SplatSettings,
    variant: int = FASTEST_VARIANT,
    every_tile: bool = False,
    *,
    gates: Float[Tensor, " n"] | None = None,
    changes: LeaveOneOutSums | None = None,
) -> Raster:
    """Project, sort by tile and blend; float32 or float64. Bitwise the same for any number of threads.

    ``variant`` picks an instruction set: 0 baseline, 1 x86-64-v3, 2 x86-64-v4, -1 the fastest that runs here.
    ``every_tile`` lists each splat in every tile and visits all pixels of the tile, as a check of lists and masks. It
    is slow, and gives the same layers and infinite radii.
    """
    check_dtype(gaussians, "backend 'cpu'")
    view, terms = _view(camera, settings, every_tile), gaussians.terms
    given = (screen_offsets, gates, _moved(gaussians), view, variant, changes, terms)
    return Raster(*_Blend.apply(*given, *gaussians.learned()))


def contribution(gaussians: Gaussians, camera: Camera, settings: SplatSettings) -> Contribution:
    """Blend weights, touched pixels and dominated pixels per row of one view."""
    weight = torch.empty(len(gaussians), dtype=torch.float64)
    pixels, dominant = torch.empty(2, len(gaussians), dtype=torch.int64)
    _measure("splat_contribution", gaussians, camera, settings, native.pointers(weight, pixels, dominant))
    return Contribution(weight, pixels, dominant)


def leave_one_out(
    gaussians: Gaussians,
    background: Float[Tensor, "h w 3"] | None,
    pixel_weights: Float[Tensor, "h w"] | None,
    camera: Camera,
    settings: SplatSettings,
) -> LeaveOneOut:
    """How much the view changes when each row alone is removed."""
    largest, squared, weight = torch.empty(3, len(gaussians), dtype=torch.float64)
    behind, counts = (None if layer is None else layer.detach().contiguous() for layer in (background, pixel_weights))
    backdrop, changes = native.pointers(behind, counts), native.pointers(largest, squared, weight)
    _measure("splat_leave_one_out", gaussians, camera, settings, backdrop, changes)
    return LeaveOneOut(largest, squared, weight)


@torch.no_grad()
def median_depth(gaussians: Gaussians, camera: Camera, settings: SplatSettings) -> MedianDepth:
    """Which splat finished each pixel; ``settings`` stop inclusively at half of the light."""
    check_dtype(gaussians, "backend 'cpu'")
    view, lease = _view(camera, settings), Lease(gaussians.means.dtype, FASTEST_VARIANT)
    fields = tuple(field.detach().contiguous() for field in gaussians.learned())
    _, transmittance, _, _ = _drawn(lease, view, fields, gaussians.terms, _moved(gaussians), None)
    depth, rows = torch.full_like(transmittance, torch.inf), torch.full(transmittance.shape, -1)
    native.load_library().splat_finishers(
        lease.workspace.handle, byref(view), transmittance.data_ptr(), byref(native.pointers(rows, depth))
    )
    return MedianDepth(depth, rows, 1 - transmittance)


def _drawn(
    lease: Lease,
    view: native.CView,
    fields: Sequence[Tensor],
    terms: int | None,
    displacements: Tensor | None,
    gates: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Layers of a raster. The lists of its tiles stay in the workspace."""
    means, report = fields[0], native.CReport()
    rgb = means.new_empty(view.height, view.width, 3)
    transmittance, depth_sum = means.new_empty(2, view.height, view.width)
    radii = means.new_empty(means.shape[0])
    status = native.load_library().splat_forward(
        lease.workspace.handle,
        byref(view),
        byref(_rows(fields, terms, displacements, gates)),
        byref(native.pointers(rgb, transmittance, depth_sum)),
        radii.data_ptr(),
        byref(report),
    )
    _raise_for(status, fields, terms, displacements, report)
    return rgb, transmittance, depth_sum, radii


def _measure(
    function: str, gaussians: Gaussians, camera: Camera, settings: SplatSettings, *structs: Array[c_void_p]
) -> None:
    """Call a function of the library that writes what it measures of each row to where ``structs`` point."""
    check_dtype(gaussians, "backend 'cpu'")
    fields = tuple(field.detach().contiguous() for field in gaussians.learned())
    displacements = _moved(gaussians)
    lease, report = Lease(gaussians.means.dtype, FASTEST_VARIANT), native.CReport()
    status = getattr(native.load_library(), function)(
        lease.workspace.handle,
        byref(_view(camera, settings)),
        byref(_rows(fields, gaussians.terms, displacements)),
        *map(byref, structs),
        byref(report),
    )
    _raise_for(status, fields, gaussians.terms, displacements, report)


class _Blend(torch.autograd.Function):
    """Maps four fields, the tables of harmonics, the screen offsets and the gates to the layers of a Raster."""

    @staticmethod
    def forward(ctx, screen_offsets, gates, displacements, view, variant, changes, terms, *fields):
        ctx.set_materialize_grads(False)
        fields = tuple(field.contiguous() for field in fields)
        gates, lease = None if gates is None else gates.contiguous(), Lease(fields[0].dtype, variant)
        rgb, transmittance, depth_sum, radii = _drawn(lease, view, fields, terms, displacements, gates)
        ctx.mark_non_differentiable(radii)
        ctx.save_for_backward(*fields, gates, displacements, transmittance, None if changes is None else rgb)
        ctx.view, ctx.lease, ctx.changes, ctx.terms = view, lease, changes, terms
        return rgb, transmittance, depth_sum, radii

    @staticmethod
    @once_differentiable
    def backward(ctx, v_rgb, v_transmittance, v_depth_sum, _v_radii):
        *fields, gates, displacements, transmittance, rgb = ctx.saved_tensors
        cotangents = [None if v is None else v.contiguous() for v in (v_rgb, v_transmittance, v_depth_sum)]
        gradients = empty_gradients(fields, ctx.terms, ctx.needs_input_grad[-len(fields) :])
        screen = fields[0].new_empty(fields[0].shape[0], 2)
        of_gates = None if gates is None else torch.empty_like(gates)
        with phase("splat backward"):
            status = native.load_library().splat_backward(
                ctx.lease.workspace.handle,
                byref(ctx.view),
                byref(_rows(fields, ctx.terms, displacements, gates, gradients[SHAPE:])),
                transmittance.data_ptr(),
                byref(native.pointers(*cotangents)),
                byref(native.pointers(*gradients[:SHAPE], screen, of_gates)),
            )
        _raise_for(status, fields, ctx.terms, displacements, native.CReport())
        if ctx.changes is not None:
            ctx.changes.found = _gathered(ctx.lease, ctx.view, ctx.changes, len(screen), rgb, transmittance)
        return screen, of_gates, None, None, None, None, None, *gradients


def _gathered(
    lease: Lease, view: native.CView, changes: LeaveOneOutSums, rows: int, rgb: Tensor, transmittance: Tensor
) -> LeaveOneOut:
    """What the lists and the image of a rendering say of its rows: half of ``leave_one_out``, as both are there."""
    largest, weight = torch.empty(2, rows, dtype=torch.float64)
    squared = torch.empty(rows, COUNTINGS, dtype=torch.float64)
    behind, weights = (None if one is None else one.contiguous() for one in (changes.background, changes.pixel_weights))
    with phase("splat backward"):
        status = native.load_library().splat_gather(
            lease.workspace.handle,
            byref(view),
            rows,
            byref(native.pointers(rgb, transmittance, None)),
            byref(native.pointers(behind, weights)),
            byref(native.pointers(largest, squared, weight)),
        )
    if status != native.STATUS_OK:
        raise MemoryError("no memory for the changes of the splat op: render a smaller image or fewer rows")
    return LeaveOneOut(largest, squared, weight)


def _moved(gaussians: Gaussians) -> Tensor | None:
    moved = gaussians.displacements
    return None if moved is None else moved.detach().contiguous()


def _view(camera: Camera, settings: SplatSettings, every_tile: bool = False) -> native.CView:
    pose, intrinsics = camera.camera_from_world.tolist(), camera.intrinsics.tolist()
    view = native.CView(
        rotation=(c_double * 9)(*(value for row in pose[:3] for value in row[:3])),
        position=(c_double * 3)(*exact_position(camera).tolist()),
        fx=intrinsics[0][0],
        fy=intrinsics[1][1],
        cx=intrinsics[0][2],
        cy=intrinsics[1][2],
        alpha_min=settings.alpha_min,
        alpha_max=settings.alpha_max,
        transmittance_min=settings.transmittance_min,
        eps2d=settings.eps2d,
        near_plane=settings.near_plane,
        max_sigma=settings.max_sigma,
        width=camera.width,
        height=camera.height,
        exclusive_stop=settings.stop == "exclusive",
        antialias=settings.antialias,
        half_colors=settings.half_colors,
        clamp_colors=settings.clamp_colors,
        detach_directions=settings.detach_directions,
        plain_gradients=settings.plain_gradients,
        depth_bits=settings.depth_bits,
        has_lens=camera.distortion is not None,
        has_shutter=camera.shutter is not None,
        every_tile=every_tile,
        pair_limit=PAIR_LIMIT,
        threads=native.thread_count(),
    )
    if camera.distortion is not None:
        view.distortion[:] = camera.distortion.tolist()
        view.fold = fold_radius_squared(camera.distortion)
    if camera.shutter is not None:
        view.shutter_translation[:] = camera.shutter.translation.tolist()
        view.shutter_rotation[:] = camera.shutter.rotation.tolist()
        view.shutter_columns = camera.shutter.reads_columns
        view.shutter_sign = camera.shutter.sign
    return view


def _rows(
    fields: Sequence[Tensor],
    terms: int | None,
    displacements: Tensor | None,
    gates: Tensor | None = None,
    gradients: Sequence[Tensor | None] | None = None,
) -> native.CRows:
    """``gradients``: those of the tables of harmonics; None where they are not asked for."""
    tables = fields[SHAPE:]
    parts = _harmonics(tables, terms, [None] * len(tables) if gradients is None else gradients)
    shape = native.pointers(*fields[:SHAPE], displacements, gates)
    return native.CRows(fields[0].shape[0], len(parts), parts, *shape)


def _harmonics(
    tables: Sequence[Tensor], terms: int | None, gradients: Sequence[Tensor | None]
) -> Array[native.CHarmonics]:
    if terms is None:
        (sh,), (v_sh,) = tables, gradients
        stored, v_rest = sh.shape[1], None if v_sh is None else v_sh[:, 1:]
        pointers = native.pointers(sh, sh[:, 1:], v_sh, v_rest)
        return (native.CHarmonics * 1)((len(sh), stored, stored - 1, 3 * stored, 3 * stored, *pointers))
    half = len(tables) // 2
    parts = []
    for first, rest, *of_both in zip(tables[:half], tables[half:], gradients[:half], gradients[half:], strict=True):
        stored, pointers = rest.shape[1], native.pointers(first, rest, *of_both)
        parts.append((len(first), min(1 + stored, terms), stored, 3, 3 * stored, *pointers))
    return (native.CHarmonics * half)(*parts)


def _raise_for(
    status: int,
    fields: Sequence[Tensor],
    terms: int | None,
    displacements: Tensor | None,
    report: native.CReport,
) -> None:
    if status == native.STATUS_OK:
        return
    if status == native.STATUS_BAD_VALUE:
        check_values(Gaussians.of_learned(fields, terms, displacements))
    if status == native.STATUS_TOO_MANY_PAIRS:
        worst = [(row, pairs) for row, pairs in zip(report.worst_rows, report.worst_pairs, strict=True) if row >= 0]
        raise PairLimitError.of(report.pairs, PAIR_LIMIT, worst)
    if status == native.STATUS_OUT_OF_MEMORY:
        raise MemoryError("no memory for the buffers of the splat op: render a smaller image or fewer rows")
    raise RuntimeError(f"the splat library answered status {status}, which this package does not know")
