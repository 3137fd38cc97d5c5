"""Lightning's strategy for several processes that train one scene: the scene on each, an image of the step for each."""

from collections.abc import Callable
from datetime import timedelta
from typing import Any

from lightning.pytorch.strategies import DDPStrategy
from torch import Tensor
from torch.optim import Optimizer

from sparsestreet.phases import phase
from sparsestreet.ranks import ALONE, Ranks
from sparsestreet.training.parallel.agreement import check_agreement
from sparsestreet.training.parallel.exchange import exchange


class DataParallel(DDPStrategy):
    """Lightning's DDP without its wrapper: that keeps buckets of parameters, and rows change.

    Launchers, process groups (gloo on CPUs, NCCL on GPUs) and barriers are Lightning's. The gradient of a step is the
    mean over the images of all processes, as it is in one process over ``accumulate_grad_batches`` of them.
    """

    ranks: Ranks = ALONE
    wish: int = 0
    """Number of a signal after which this process wants all to stop; 0: none."""
    agreed: int = 0
    """What the processes agreed on in the last step."""

    def __init__(self, patience: float = 1800.0, **kwargs: Any) -> None:
        """``patience``: seconds until a process that is there and does not answer counts as lost; the first wait is
        for the others to read their data. A process that dies is noticed at once on CPUs, and by what started the
        processes (Lightning, torchrun, SLURM) everywhere.
        """
        if not patience > 0:
            raise ValueError(f"patience must be above 0 seconds, got {patience}")
        super().__init__(timeout=timedelta(seconds=patience), **kwargs)

    def configure_ddp(self) -> None:
        """No wrapper."""

    def setup_distributed(self) -> None:
        super().setup_distributed()
        self.ranks = Ranks(self.global_rank, self.world_size, self._moment)

    def on_train_start(self) -> None:
        check_agreement(self._system().scene, self.ranks)

    def backward(self, closure_loss: Tensor, optimizer: Optimizer | None, *args: Any, **kwargs: Any) -> Tensor:
        return super().backward(closure_loss / self.world_size, optimizer, *args, **kwargs)

    def optimizer_step(self, optimizer: Optimizer, closure: Callable[[], Any], model: Any = None, **kwargs: Any) -> Any:
        parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]

        def of_all() -> Any:
            loss = closure()
            with phase("exchange"):
                self.agreed = exchange(parameters, self.ranks, self.wish)
            return loss

        return super().optimizer_step(optimizer, of_all, model, **kwargs)

    def barrier(self, *args: Any, **kwargs: Any) -> None:
        with self.ranks.answering():
            super().barrier(*args, **kwargs)

    def broadcast(self, obj: Any, src: int = 0) -> Any:
        with self.ranks.answering():
            return super().broadcast(obj, src)

    def _moment(self) -> str:
        return f"after step {self._system().trainer.global_step}"

    def _system(self) -> Any:
        return self.lightning_module
