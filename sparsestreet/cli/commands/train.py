"""``sparsestreet train``: compose, then ``training/run.py``, once or for each job of a sweep."""

import os
import signal
import sys
import time
from contextlib import nullcontext
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import InstantiationException
from hydra.types import RunMode
from omegaconf import DictConfig

from sparsestreet.cli.config.compose import CONF, as_typed, composed, resolved, without_flags
from sparsestreet.cli.config.log_from_options import with_found_data
from sparsestreet.cli.config.validate import flag_problem, override_problem, with_effect_keys
from sparsestreet.cli.process import is_worker_rank, name_beside_first, set_log_prefix
from sparsestreet.cli.runs.folder import check_resumed, folder_problem, leave_folder, resumed_overrides
from sparsestreet.cli.runs.jobs import give_back_trunks, jobs_of_shard, shard_problem, without_shard, words_of_job
from sparsestreet.cli.runs.locks import sole_writer
from sparsestreet.cli.runs.sweep import (
    SweepFolder,
    as_sweep,
    job_problem,
    note_of_sweep,
    restored_handlers,
    run_job,
    sentence,
    sweep_problem,
    sweep_status,
    with_fixed_keys,
)
from sparsestreet.demand import as_demand
from sparsestreet.naming import printable

_started = 0.0
"""``time.perf_counter`` when the command began."""


def train(arguments: list[str]) -> int:
    """Run the Hydra app on these overrides.

    Returns 2 if they are wrong, 1 if the data is or a job of a sweep failed. A signal ends it with 128 + its number.
    """
    global _started
    _started = time.perf_counter()
    shard = None
    if "--help" not in arguments:
        try:
            parts, arguments = _without_parts(arguments)
            shard, arguments = without_shard(arguments)
            problem = flag_problem(arguments)
            if problem is None:
                arguments = as_sweep(as_typed(arguments))
                arguments, found = with_found_data(resumed_overrides(with_effect_keys(arguments), parts))
                if found:
                    print(f"sparsestreet train: {found}", file=sys.stderr)
                problem = sweep_problem(arguments) or override_problem(arguments) or _problem_of_values(arguments)
                problem = problem or shard_problem(shard, arguments) or job_problem(arguments)
                arguments = _shown(with_fixed_keys(arguments))
        except (FileNotFoundError, ValueError) as error:
            problem = str(error)
        if problem:
            print(printable(f"sparsestreet train: {problem}"), file=sys.stderr)
            return 2
        if note := note_of_sweep(arguments):
            print(f"sparsestreet train: {note}", file=sys.stderr)
    SweepFolder.folder = None  # of an earlier command of this process
    own = None if shard is None else jobs_of_shard(shard, arguments)
    try:
        for words in [arguments] if own is None else (words_of_job(job) for job in own):
            sys.argv = [sys.argv[0], *words]  # which Hydra reads
            with restored_handlers():
                app()
    except KeyboardInterrupt:
        print("sparsestreet train: stopped; the same command goes on from the newest checkpoints", file=sys.stderr)
        return 128 + signal.SIGINT
    give_back_trunks(arguments, own)
    return sweep_status(None if own is None else {job.out for job in own})


def _without_parts(arguments: list[str]) -> tuple[list[str], list[str]]:
    """The modules of ``parts=[...]``, and the other arguments. Raises ValueError where no run is opened."""
    said = [text.partition("=")[2].strip("[]") for text in arguments if text.startswith("parts=")]
    if said and not any(text.startswith("resume=") for text in arguments):
        raise ValueError("parts=[...] says which modules of resume=RUN are trusted: training takes your own without it")
    parts = [part.strip() for words in said for part in words.split(",")]
    return parts, [text for text in arguments if not text.startswith("parts=")]


def _shown(arguments: list[str]) -> list[str]:
    """Flags first, wherever they stood; with ``--resolve`` the run's folder, which only a running app knows."""
    # argparse takes overrides only where they stand together.
    overrides = without_flags(arguments)
    flags = [text for text in arguments if text not in overrides]
    return [*flags, *overrides, *(["folder=${out}"] if "--resolve" in arguments else [])]


def _problem_of_values(arguments: list[str]) -> str | None:
    """What the values of one run say that cannot be; sweeps and questions to Hydra are looked at job by job."""
    from sparsestreet.cli.config.validate import config_problem, unresolvable

    if "--resolve" in arguments:
        return unresolvable(composed(without_flags(arguments)))
    if any(text.startswith("-") for text in arguments):
        return None
    cfg = composed(arguments)
    problem = folder_problem(cfg, Path(cfg.out)) or config_problem(cfg)
    if problem is None and cfg.resume:
        # Before Hydra writes the configuration of this start over that of the run.
        check_resumed(resolved(cfg), Path(cfg.resume))
    return problem


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="train")
def app(cfg: DictConfig) -> float | None:
    """One training with its evaluation; returns a full-image PSNR for sweepers (held out, else of training views)."""
    # The jobs of a sweep begin here.
    started = time.perf_counter() if HydraConfig.get().mode == RunMode.MULTIRUN else _started
    # Lightning starts further processes with what stands here, behind this program (``python -m sparsestreet`` or the
    # installed script): they need the command's name, which Hydra does not know, and the overrides of this job alone.
    sys.argv = [sys.argv[0], "train", *HydraConfig.get().overrides.task]
    out = Path(HydraConfig.get().runtime.output_dir)
    if name := name_beside_first(cfg.trainer):
        set_log_prefix(name)
    if HydraConfig.get().mode == RunMode.MULTIRUN:
        return run_job(cfg, out, lambda: _run(cfg, out, started))
    try:
        # Again, because hydra.run.dir may lead elsewhere than out.
        if problem := folder_problem(cfg, out):
            raise ValueError(problem)
        return _run(cfg, out, started)
    except (InstantiationException, ValueError, OSError, ImportError) as error:
        # Where somebody looks for a fault, Hydra's own report with the whole trace is better.
        if "HYDRA_FULL_ERROR" in os.environ:
            raise
        name = name_beside_first(cfg.trainer)
        print(f"sparsestreet train{f', {name}' if name else ''}: {sentence(error)}", file=sys.stderr)
        sys.exit(1)
    except Exception as error:
        demand = as_demand(error)
        if demand is None or "HYDRA_FULL_ERROR" in os.environ:
            raise
        print(f"sparsestreet train: {demand}", file=sys.stderr)
        sys.exit(1)
    finally:
        leave_folder(out, f"{HydraConfig.get().job.name}.log")


def _run(cfg: DictConfig, out: Path, started: float) -> float | None:
    # The first of several processes of a run holds the folder for all.
    with nullcontext() if is_worker_rank(cfg.trainer) else sole_writer(out):
        from sparsestreet.cli.runs.run import (
            run,  # torch and Lightning: seconds, which a refused start does not wait for
        )

        return run(cfg, out, started)
