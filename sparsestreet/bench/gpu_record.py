"""What is measured of one renderer at one size of a GPU, and its line in the table."""

from dataclasses import dataclass

from sparsestreet.bench.accuracy import Errors
from sparsestreet.bench.tile_loads import TileLoads
from sparsestreet.bench.timing import TimeSpread


@dataclass(frozen=True)
class GpuRecord:
    """One renderer at one size. Times are milliseconds, memory is MB (10^6 bytes)."""

    renderer: str
    device: str
    scene: str
    rows: int
    width: int
    height: int
    tuning: dict[str, int | bool] | None = None
    """The choices of our kernels; None for gsplat."""
    pairs: int | None = None
    """(splat, tile) pairs."""
    samples: int | None = None
    """(splat, pixel) samples of the forward pass; None for gsplat."""
    failed: str | None = None
    """Why a measurement is missing; earlier measurements stay."""
    inference: TimeSpread | None = None
    """Forward without gradients."""
    forward: TimeSpread | None = None
    backward: TimeSpread | None = None
    step: TimeSpread | None = None
    """A whole step of training (gpu_step.py)."""
    stages: dict[str, TimeSpread] | None = None
    """Device time by stage of the kernels of one forward and backward; None without a CUDA device."""
    kernels: dict[str, TimeSpread] | None = None
    """The same by name (device_profile.py)."""
    launches: int | None = None
    """Kernels, copies and fills of one forward and backward, and how often the host waits in them."""
    waits: int | None = None
    tiles: TileLoads | None = None
    """How the pairs lie on the tiles; gsplat splits none."""
    memory_before: float | None = None
    memory_peak: float | None = None
    """Peak during one forward and backward, including what was there before: the Gaussians."""
    parity: Errors | None = None
    """For gsplat: against us. For us: against the C++ backend in float64, if it is built. None above TRUTH_ROWS."""
    agrees: bool | None = None

    @property
    def ok(self) -> bool:
        return self.failed is None and self.agrees is not False


def line(record: GpuRecord) -> str:
    """One row of the table: medians and inter-quartile ranges."""
    start = f"{record.renderer:<23} {record.scene:<16}{record.rows:>9} {record.width}x{record.height:<6}"
    if record.forward is None or record.backward is None:
        return f"{start} FAILED: {record.failed}"
    inference = _short(record.inference) if record.inference else "-"
    text = f"{start} forward {_short(record.forward)}  backward {_short(record.backward)}  no grad {inference} ms"
    if record.step is not None:
        text += f"  step {_short(record.step)}"
    if record.pairs is not None:
        text += f"  {1e-6 * record.pairs:.2f} M pairs"
    if record.samples is not None:
        text += f", {1e-6 * record.samples:.0f} M samples"
    if record.tiles is not None:
        tiles = record.tiles
        text += f"  tiles {tiles.mean:.0f} pairs, longest {tiles.longest}, {tiles.split} split in {tiles.parts} parts"
    if record.memory_peak is not None:
        text += f"  peak {record.memory_peak:7.0f} MB"
    if record.waits is not None and record.launches is not None:
        text += f"  {record.launches} launches, {record.waits} waits"
    if record.stages:
        text += "  [" + ", ".join(f"{name} {_short(value)}" for name, value in record.stages.items()) + "]"
    if record.parity is not None:
        psnr = record.parity.image.psnr
        text += f"  {'agrees' if record.agrees else 'DISAGREES'}: {'equal' if psnr is None else f'{psnr:.1f} dB'}"
    return text + (f"  FAILED: {record.failed}" if record.failed else "")


def _short(value: TimeSpread) -> str:
    return f"{value.median:.3f}" + ("" if value.iqr is None else f" (iqr {value.iqr:.3f})")
