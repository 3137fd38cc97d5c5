"""Density control on hand-made scenes, as several test files walk it."""

from sparsestreet.scene.nodes import Node
from sparsestreet.training.callbacks import DensityControl
from sparsestreet.training.schedule import Interval
from sparsestreet.training.system import StreetSystem
from tests.training.stubs import AskedStrategy, Listener, StubTrainer, make_system

NEVER = Interval(0.0, 0.0)


def every_ten(
    reset_in: Interval = NEVER, *, pause: int = 0, seed: int = 0, densify_until: float = 0.9
) -> DensityControl:
    """Refines at 10, 20 ... 90 of 100 steps."""
    return DensityControl(Interval(0.1, 0.9, every=10), densify_until, reset_in, pause_after_reset=pause, seed=seed)


def started(control: DensityControl, **nodes: Node) -> tuple[StubTrainer, StreetSystem, Listener]:
    listener = Listener()
    system = make_system(nodes)
    trainer = StubTrainer(system, [control, listener])
    trainer.start()
    return trainer, system, listener


def asked_at(strategy: AskedStrategy, what: str) -> list[int]:
    return [round(100 * given["progress"]) for given in strategy.asked if given["what"] == what]
