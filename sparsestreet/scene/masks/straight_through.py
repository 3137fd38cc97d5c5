"""The binary mask with the gradient of its score (the paper's eq. for M_k; Bengio et al. 2013)."""

from jaxtyping import Float
from torch import Tensor


def straight_through(scores: Float[Tensor, " n"], threshold: float) -> Float[Tensor, " n"]:
    """1[score > threshold] forward, d/dscore = 1 backward. Scores are sigmoids already: no second one here."""
    # score - score.detach() is exactly 0, so the product with a closed mask is exactly 0 in every dtype.
    hard = (scores > threshold).to(scores.dtype)
    return hard + (scores - scores.detach())
