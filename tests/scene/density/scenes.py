"""Small tables of rows with every column a node has."""

import torch

from sparsestreet.scene.density import DensityStatistics
from sparsestreet.scene.gaussians import Rows


def make_rows(number: int, generator: torch.Generator, scale: float = 0.1) -> Rows:
    """Random rows with mask logits and instances, scales around ``scale`` meters."""
    return Rows(
        {
            "means": torch.randn(number, 3, generator=generator),
            "log_scales": torch.log(torch.tensor(scale)) + 0.3 * torch.randn(number, 3, generator=generator),
            "quaternions": torch.randn(number, 4, generator=generator),
            "opacity_logits": torch.randn(number, generator=generator),
            "sh_dc": torch.randn(number, 1, 3, generator=generator),
            "sh_rest": torch.randn(number, 3, 3, generator=generator),
            "mask_logits": torch.randn(number, generator=generator),
        },
        buffers={"instances": torch.arange(number) % 3},
        transient=["mask_logits"],
    )


def with_statistics(gradients: list[float], screens: list[float] | None = None) -> DensityStatistics:
    """Statistics of one visit a row with these mean gradients and screen sizes."""
    statistics = DensityStatistics(len(gradients))
    statistics.gradient_sum = torch.tensor(gradients, dtype=torch.float32)
    statistics.visits = torch.ones(len(gradients), dtype=torch.int64)
    if screens is not None:
        statistics.largest_screen = torch.tensor(screens, dtype=torch.float32)
    return statistics
