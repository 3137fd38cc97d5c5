"""Several processes that train one scene: what they exchange in a step, and how they notice that they differ."""

from sparsestreet.training.parallel.agreement import DisagreementError, check_agreement
from sparsestreet.training.parallel.exchange import exchange
from sparsestreet.training.parallel.strategy import DataParallel

__all__ = ["DataParallel", "DisagreementError", "check_agreement", "exchange"]
