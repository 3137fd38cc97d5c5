"""Protocols: named choices of the metrics that a table shows (no torch). Records hold all metrics."""

from dataclasses import dataclass

from sparsestreet.metrics.definitions import DEFINITIONS


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """Ids of metrics by their name in a table. Raises ValueError for an id without a definition.

    >>> PROTOCOLS["strict"].psnr, PROTOCOLS["drivestudio"].psnr
    ('psnr8_no_hood', 'psnr_full')
    """

    name: str
    psnr: str
    ssim: str
    lpips: tuple[str, ...]
    human: tuple[str, str]
    """PSNR and SSIM of the pixels of people."""
    vehicle: tuple[str, str]
    """PSNR and SSIM of the pixels of vehicles."""

    def __post_init__(self) -> None:
        unknown = [metric for metric in self.metrics if metric not in DEFINITIONS]
        if unknown:
            raise ValueError(f"protocol {self.name} names {unknown}, which have no definition: see DEFINITIONS")

    @property
    def metrics(self) -> tuple[str, ...]:
        """All ids, in the order of a table."""
        return (self.psnr, self.ssim, *self.lpips, *self.human, *self.vehicle)


DRIVESTUDIO = Protocol(
    name="drivestudio",
    psnr="psnr_full",
    ssim="ssim_uniform7_full",
    lpips=("lpips_alex_full",),
    human=("psnr_human", "ssim_uniform7_human"),
    vehicle=("psnr_vehicle", "ssim_uniform7_vehicle"),
)
"""The metrics of DriveStudio, to compare with its tables and the paper's: without rounding, the hood included."""

STRICT = Protocol(
    name="strict",
    psnr="psnr8_no_hood",
    ssim="ssim_gauss11_no_hood",
    lpips=("lpips_alex_no_hood", "lpips_vgg_no_hood"),
    human=("psnr8_human", "ssim_gauss11_human"),
    vehicle=("psnr8_vehicle", "ssim_gauss11_vehicle"),
)
"""What a viewer sees: 8 bits, without the recording car; SSIM with its paper's window, and both LPIPS."""

PROTOCOLS = {protocol.name: protocol for protocol in (DRIVESTUDIO, STRICT)}
