"""``sparsestreet evaluate run=RUN``: measure a trained run again."""

import sys
from pathlib import Path

import torch

from sparsestreet.cli.assemble import assemble, evaluate_assembly
from sparsestreet.cli.compose import load_run_config
from sparsestreet.evaluation.records import read_summary, summary_path

USAGE = "sparsestreet evaluate run=RUN    RUN is a folder that train wrote; its records and pictures are made anew"


def evaluate(arguments: list[str]) -> int:
    """Rebuild the run's scene, load its last checkpoint, write records and pictures anew."""
    given = dict(text.split("=", 1) for text in arguments if "=" in text)
    if set(given) != {"run"}:
        print(USAGE, file=sys.stderr if arguments and "--help" not in arguments else sys.stdout)
        return 0 if "--help" in arguments else 2
    run = Path(given["run"])
    cfg = load_run_config(run)
    parts = assemble(cfg)
    checkpoint = torch.load(run / "checkpoints" / "last.ckpt", map_location="cpu", weights_only=True)
    parts.system.load_state_dict(checkpoint["state_dict"])
    seconds = read_summary(summary_path(run)).run.training_seconds
    evaluate_assembly(parts, cfg, run, training_seconds=seconds)
    return 0
