"""SSIM and its gradient, one kernel each: ``sparsestreet.ops.ssim`` in the sum and the difference of the two images.

Let s = x + y and d = x - y, with window means m_s, m_d and variances V_s, V_d. Then 2 xy = (s^2 - d^2) / 2 and
x^2 + y^2 = (s^2 + d^2) / 2. So four window means replace five, and the small difference of similar images keeps its
digits. SSIM = l c, with luminance l = (m_s^2 - m_d^2 + 2 C1) / (m_s^2 + m_d^2 + 2 C1) and
c = (V_s - V_d + 2 C2) / (V_s + V_d + 2 C2).

A program owns a strip of columns and walks down its lines. Across, taps are read from the image; down, the last eleven
lines stay in registers. Channels are interleaved: the next tap is three numbers away, and kernels ignore channels.
"""

import torch
import triton.language as tl
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from sparsestreet.ops.ssim_window import C1, C2, WINDOW, window
from sparsestreet.ops.triton.launch import constant, jit, launch

LANES = 128
LINES = 32
"""Lines of a program; ten more are read above them."""
TAPS = constant(window())
COUNT = constant(WINDOW)
PAD = constant(WINDOW - 1)
CHANNELS = constant(3)
MAX_NUMBERS = 1 << 31
"""Most numbers in the three maps of derivatives, because kernels count in int32."""
TWICE_C1, TWICE_C2 = constant(2 * C1), constant(2 * C2)


def mean_ssim(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> Float[Tensor, ""]:
    """``sparsestreet.ops.ssim.ssim`` of contiguous float32 images; raises as ``similarity_sums`` does."""
    return _MeanSSIM.apply(image, truth)


def similarity_sums(image: Tensor, truth: Tensor, keep: bool) -> tuple[Tensor, Tensor]:
    """Return each program's sum of similarities, and if ``keep`` the three derivatives [3, h-10, 3 (w-10)].

    Raises ValueError above 239 million pixels."""
    height, width, _ = image.shape
    if 9 * (height - WINDOW + 1) * (width - WINDOW + 1) > MAX_NUMBERS:
        raise ValueError(
            f"SSIM by backend 'triton' takes images of up to {MAX_NUMBERS // 9 / 1e6:.0f} million pixels, got "
            f"{width}x{height}: use smaller images or backend='torch'"
        )
    height, width = height - WINDOW + 1, 3 * (width - WINDOW + 1)
    strips, lanes = _programs(height, width)
    sums = image.new_empty(strips * (lanes // LANES))
    partials = image.new_empty(3 if keep else 0, height, width)
    launch(
        similarity, strips * lanes, LANES,
        image, truth, partials, sums, height, width, LINES=LINES, PARTIALS=keep,
    )  # fmt: skip
    return sums, partials


def similarity_gradient(image: Tensor, truth: Tensor, partials: Tensor, v_mean: Tensor) -> Tensor:
    """Return the gradient of the image from that of the mean."""
    _, height, width = partials.shape
    strips, lanes = _programs(image.shape[0], 3 * image.shape[1])
    v_image = torch.empty_like(image)
    launch(
        similarity_backward, strips * lanes, LANES,
        image, truth, partials, v_mean, v_image, height, width, 1 / (height * width), LINES=LINES,
    )  # fmt: skip
    return v_image


class _MeanSSIM(torch.autograd.Function):
    """Forward keeps three partial derivatives per number of the SSIM map; backward blurs them."""

    @staticmethod
    def forward(ctx, image, truth):
        sums, partials = similarity_sums(image, truth, ctx.needs_input_grad[0])
        ctx.save_for_backward(image, truth, partials)
        return sums.sum() / partials.shape[1:].numel()

    @staticmethod
    @once_differentiable
    def backward(ctx, v_mean):
        return similarity_gradient(*ctx.saved_tensors, v_mean), None


def _programs(height: int, width: int) -> tuple[int, int]:
    """Number of strips of lines, and of lanes in a strip, rounded up to whole programs."""
    return -(-height // LINES), -(-width // LANES) * LANES


@jit
def place(width, LINES: tl.constexpr, BLOCK: tl.constexpr):
    """First line and columns of a program of an image ``width`` numbers wide."""
    across = tl.cdiv(width, BLOCK)
    return tl.program_id(0) // across * LINES, tl.program_id(0) % across * BLOCK + tl.arange(0, BLOCK)


@jit
def empty_lines(column, FIELDS: tl.constexpr):
    """Zeros for the ten lines above the first."""
    lines = ()
    for _ in tl.static_range(PAD * FIELDS):
        lines += (tl.zeros_like(column).to(tl.float32),)
    return lines


@jit
def down(lines, FIELDS: tl.constexpr, FIELD: tl.constexpr):
    """The window's mean of one field over eleven lines that hold FIELDS each."""
    total = TAPS[0] * lines[FIELD]
    for k in tl.static_range(1, COUNT):
        total += TAPS[k] * lines[k * FIELDS + FIELD]
    return total


@jit
def across_images(image, truth, at, level, mask):
    """Interval means along a line of s - level, d and their squares, for windows that begin ``at``."""
    zero = tl.zeros_like(at).to(tl.float32)
    mean_s, mean_d, mean_ss, mean_dd = zero, zero, zero, zero
    for k in tl.static_range(COUNT):
        x, y = tl.load(image + at + k * CHANNELS, mask, 0.0), tl.load(truth + at + k * CHANNELS, mask, 0.0)
        s, d = (x + y) - level, x - y
        mean_s += TAPS[k] * s
        mean_d += TAPS[k] * d
        mean_ss += TAPS[k] * (s * s)
        mean_dd += TAPS[k] * (d * d)
    return mean_s, mean_d, mean_ss, mean_dd


@jit
def derivatives(s, d, var_s, var_d):
    """SSIM of window means and variances, and its derivatives by the mean of x, by V_s and by V_d (as E s^2, E d^2).

    1 - l is 2 m_d^2 over l's denominator, and 1 - c is 2 V_d over c's. With these no derivative is a difference of
    nearly equal numbers.
    """
    by_luminance = 1 / (s * s + d * d + TWICE_C1)
    by_contrast = 1 / (var_s + var_d + TWICE_C2)
    luminance, contrast = (s * s - d * d + TWICE_C1) * by_luminance, (var_s - var_d + TWICE_C2) * by_contrast
    v_var_s = 2 * luminance * var_d * by_contrast * by_contrast
    v_var_d = -luminance * (1 + contrast) * by_contrast
    v_s = 4 * contrast * s * d * d * by_luminance * by_luminance
    v_d = -2 * contrast * (1 + luminance) * d * by_luminance
    return luminance * contrast, v_s + v_d - 2 * s * v_var_s - 2 * d * v_var_d, v_var_s, v_var_d


@jit
def similarity(
    image, truth, partials, sums, height, width, LINES: tl.constexpr, PARTIALS: tl.constexpr, BLOCK: tl.constexpr
):
    """Sum of the SSIM map [height, width] over each program, and its partial derivatives [3, height, width].

    The images are ten lines higher and ten pixels wider than the map.
    """
    first, column = place(width, LINES, BLOCK)
    inside = column < width
    # A lane's variances are taken about a number of its own column. About zero, a bright flat sky would leave no
    # digits.
    corner = first * (width + PAD * CHANNELS) + column
    level = tl.load(image + corner, inside, 0.0) + tl.load(truth + corner, inside, 0.0)
    lines = empty_lines(column, 4)
    total = tl.zeros_like(column).to(tl.float32)
    for i in range(tl.minimum(LINES, height - first) + PAD):
        lines += across_images(image, truth, corner + i * (width + PAD * CHANNELS), level, inside)
        if i >= PAD:
            s, d = down(lines, 4, 0), down(lines, 4, 1)
            var_s, var_d = down(lines, 4, 2) - s * s, down(lines, 4, 3) - d * d
            value, v_mean, v_var_s, v_var_d = derivatives(s + level, d, var_s, var_d)
            total += tl.where(inside, value, 0.0)
            if PARTIALS:
                at = (first + i - PAD) * width + column
                tl.store(partials + at, v_mean, inside)
                tl.store(partials + height * width + at, v_var_s, inside)
                tl.store(partials + 2 * height * width + at, v_var_d, inside)
        lines = lines[4:]
    tl.store(sums + tl.program_id(0), tl.sum(total))


@jit
def across_partials(partials, line, column, height, width):
    """Interval means along a line of the three partial derivatives, for windows that end at ``column``; 0 outside."""
    zero = tl.zeros_like(column).to(tl.float32)
    of_mean, of_var_s, of_var_d = zero, zero, zero
    for k in tl.static_range(COUNT):
        tap = column - k * CHANNELS
        inside = (tap >= 0) & (tap < width) & (line >= 0) & (line < height)
        at = partials + line * width + tap
        of_mean += TAPS[k] * tl.load(at, inside, 0.0)
        of_var_s += TAPS[k] * tl.load(at + height * width, inside, 0.0)
        of_var_d += TAPS[k] * tl.load(at + 2 * height * width, inside, 0.0)
    return of_mean, of_var_s, of_var_d


@jit
def similarity_backward(
    image, truth, partials, v_mean, v_image, height, width, share, LINES: tl.constexpr, BLOCK: tl.constexpr
):
    """Gradient of the image [height + 10, width + 30]; the window is symmetric, so its transpose is itself.

    d(E s) / dx and d(E d) / dx are the window, d(E s^2) / dx is 2 s times it, d(E d^2) / dx 2 d times it.
    """
    wide = width + PAD * CHANNELS
    first, column = place(wide, LINES, BLOCK)
    given = column < wide
    scale = tl.load(v_mean) * share
    lines = empty_lines(column, 3)
    for i in range(tl.minimum(LINES, height + PAD - first) + PAD):
        lines += across_partials(partials, first + i - PAD, column, height, width)
        if i >= PAD:
            at = (first + i - PAD) * wide + column
            x, y = tl.load(image + at, given, 0.0), tl.load(truth + at, given, 0.0)
            v = down(lines, 3, 0) + 2 * ((x + y) * down(lines, 3, 1) + (x - y) * down(lines, 3, 2))
            tl.store(v_image + at, scale * v, given)
        lines = lines[3:]
