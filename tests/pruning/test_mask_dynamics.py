"""How long a Gaussian that no image calls for survives its mask: Adam's epsilon decides, not lambda."""

import math

import pytest
import torch

from sparsestreet.scene.gaussians import Rows
from tests.scene.street import static_mask

MASK = static_mask()
LEARNING_RATE = 0.01
WEIGHTS = torch.tensor([2.5e-3, 1e-4, 1e-5])  # the paper's lambda_n: background, rigid, people
ROWS_IN_SCENE = 1_500_000


def steps_to_removal(epsilon: float, limit: int) -> list[int]:
    """For an unseen Gaussian of each weight: the step at which the rule drops it (``limit`` if it survives)."""
    rows = Rows(MASK.initial_columns(len(WEIGHTS)))
    adam = torch.optim.Adam(rows.parameters(), lr=LEARNING_RATE, eps=epsilon)
    removed_at = [limit] * len(WEIGHTS)
    for step in range(1, limit):
        adam.zero_grad()
        # Only the sparsity term: sum_n lambda_n sum_k sigma(m_k) / K
        loss = (WEIGHTS * MASK.scores(rows)).sum() / ROWS_IN_SCENE
        loss.backward()
        adam.step()
        keep = MASK.keep(rows).keep
        removed_at = [min(at, step) if not kept else at for at, kept in zip(removed_at, keep.tolist(), strict=True)]
        if not keep.any():
            break
    return removed_at


def scalar_adam(weight: float, epsilon: float) -> int:
    """The same for one row, written out in Python floats (Kingma & Ba 2015, algorithm 1)."""
    logit, first, second, step = 1.0, 0.0, 0.0, 0
    while 1 / (1 + math.exp(-logit)) > MASK.settings.threshold:
        step += 1
        score = 1 / (1 + math.exp(-logit))
        gradient = weight / ROWS_IN_SCENE * score * (1 - score)
        first = 0.9 * first + 0.1 * gradient
        second = 0.999 * second + 0.001 * gradient**2
        corrected = math.sqrt(second / (1 - 0.999**step))
        logit -= LEARNING_RATE * first / (1 - 0.9**step) / (corrected + epsilon)
    return step


@pytest.mark.lengthy
def test_unseen_gaussians_go_at_the_same_time_under_any_weight():
    steps = steps_to_removal(1e-15, limit=1600)
    oracle = [scalar_adam(float(weight), 1e-15) for weight in WEIGHTS]
    # Two steps: near the threshold one step moves sigma by 1e-4, float32 rounding shifts the crossing by at most one.
    assert steps == pytest.approx(oracle, abs=2)
    assert all(1400 <= step <= 1420 for step in steps)


@pytest.mark.lengthy
def test_the_default_epsilon_of_adam_keeps_them_alive():
    # Gradients are 3e-10 and less, far below 1e-8; the surest one to go would take more than 14,000 steps.
    assert steps_to_removal(1e-8, limit=2000) == [2000] * len(WEIGHTS)


def test_bfloat16_logits_would_never_close():
    """Why scores and logits are float32: from -4.0 on, a bfloat16 logit does not move by 0.01 any more."""
    logit = torch.tensor(1.0, dtype=torch.bfloat16)
    for _ in range(2000):
        logit -= LEARNING_RATE
    assert torch.sigmoid(logit.float()) > MASK.settings.threshold
