"""The command line; the only place that sees a config."""

import importlib
import os
import sys

from sparsestreet.cli.process import prepare_process

USAGE = """\
SparseStreet: train scene graphs of 3D Gaussians from driving logs, make them small, measure what it costs.

  sparsestreet demo                                   make a street, train it three ways, show table and pictures
  sparsestreet train                                  train StreetGS on the embedded synthetic street
  sparsestreet train sparsify=paper_short             the same with the paper's masks and background pruning
  sparsestreet train method=3dgs sparsify=removal data=drivestudio data.root=DIR    on a drive of your own
  sparsestreet train -m sparsify=none,paper_short,removal seed=0,1,2                a sweep
  sparsestreet train +sweep=streets                   a sweep of conf/sweep; sparsestreet report sweep=DIR shows it
  sparsestreet jobs +sweep=table1_waymo,table5_ablation data.root=DIR,DIR           what sweeps would train
  sparsestreet train resume=RUN                       go on after an interruption
  sparsestreet evaluate RUN                           measure a trained run again, without training
  sparsestreet report DIR [DIR ...]                   tables from the records of runs
  sparsestreet render RUN drive.mp4                   a video of a trained street, along its log or beside it
  sparsestreet objects RUN                            what is in it that can be removed, moved or copied (edits=FILE)
  sparsestreet view RUN                               fly through it in the browser, hide and move objects
  sparsestreet export RUN street.html                 one page that plays it, in any browser, offline
  sparsestreet export RUN street.ply                  its Gaussians for viewers, at a time, or one object of it
  sparsestreet serve RUN[,RUN] port=50051             pictures for simulators (AlpaSim, NuRec's clients) over gRPC
  sparsestreet data check DIR                         everything that is wrong with a log, at once
  sparsestreet data convert from=DIR to=OUT           any log in DriveStudio's layout
  sparsestreet data make seed=1                       write a synthetic street to disk
  sparsestreet effects data=auto data.root=DIR        which effects of cameras and light a log calls for, and why
  sparsestreet presets streetgs                       our presets beside DriveStudio's settings, key by key
  sparsestreet bench                                  what the splat op costs in time, memory and accuracy
  sparsestreet check                                  whether a GPU can train here, and what is missing

Every command takes --help. Options of train are Hydra overrides; `sparsestreet train --cfg job` prints them all.
"""

COMMANDS = (
    "demo", "train", "jobs", "evaluate", "report", "render", "export", "objects", "view", "serve", "data", "effects",
    "presets",
    "bench", "check",
)  # fmt: skip


MODULES = {"check": "gpu_check"}
"""Command -> the module that holds it, where that has another name."""
READER_GONE = 128 + 13
"""Status of a program that SIGPIPE ended, as a shell counts."""


def main(arguments: list[str] | None = None) -> None:
    """Hand the arguments to the command; exit with its status."""
    arguments = sys.argv[1:] if arguments is None else arguments
    command, rest = (arguments[0], arguments[1:]) if arguments else ("--help", [])
    try:
        status = _run(command, rest)
        sys.stdout.flush()
    except BrokenPipeError:
        # Whoever read the output has enough (``| head -1``); Python would flush it once more at its end, and complain.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        status = READER_GONE
    sys.exit(status)


def _run(command: str, rest: list[str]) -> int:
    if command in ("-h", "--help", "help"):
        print(USAGE)
        return 0
    prepare_process()
    if command in COMMANDS:
        # Each command is the function of its name, in a module that is imported only when it is called: lightning alone
        # takes seconds to import, and a report needs none of it.
        module = importlib.import_module(f"sparsestreet.cli.commands.{MODULES.get(command, command)}")
        return getattr(module, command)(rest)
    from sparsestreet.naming import nearest

    close = nearest(command, COMMANDS)
    meant = f"; did you mean {close[0]!r}?" if close else ""
    print(f"sparsestreet: no command {command!r}{meant}\n\n{USAGE}", file=sys.stderr)
    return 2
