"""The command line; the only place that sees a config."""

import sys

USAGE = """\
SparseStreet: train scene graphs of 3D Gaussians from driving logs, make them small, measure what it costs.

  sparsestreet demo                                   make a street, train it plain and pruned, show table and pictures
  sparsestreet train                                  train the baseline on the embedded synthetic street
  sparsestreet train experiment=streetgs_ours         the same with node-aware masks and background pruning
  sparsestreet train experiment=streetgs_ours data=drivestudio data.root=DIR    on a drive of your own
  sparsestreet train -m experiment=streetgs,streetgs_ours seed=0,1,2            a sweep
  sparsestreet train resume=RUN/checkpoints/last.ckpt ...                       go on after an interruption
  sparsestreet evaluate run=RUN                       measure a trained run again, without training
  sparsestreet report DIR [DIR ...]                   tables from the records of runs, one a scene
  sparsestreet render scene=RUN out=drive.mp4         a video of a trained street, along its log or beside it
  sparsestreet export scene=RUN out=street.ply        its Gaussians for viewers, at a time, or one object of it
  sparsestreet data check data.root=DIR               everything that is wrong with a log, at once
  sparsestreet data make seed=1                       write a synthetic street to disk
  sparsestreet bench                                  what the splat op costs in time, memory and accuracy

Every command takes --help. Options are Hydra overrides (key=value); `sparsestreet train --cfg job` prints them all.
"""


def main(arguments: list[str] | None = None) -> None:
    """Hand the arguments to the command; exit with its status."""
    arguments = sys.argv[1:] if arguments is None else arguments
    command, rest = (arguments[0], arguments[1:]) if arguments else ("--help", [])
    if command in ("-h", "--help", "help"):
        print(USAGE)
        sys.exit(0)
    sys.exit(_run(command, rest))


def _run(command: str, rest: list[str]) -> int:
    # Imported here: lightning alone takes seconds to import, and a report needs none of it.
    if command == "train":
        from sparsestreet.cli.train import train

        return train(rest)
    if command == "evaluate":
        from sparsestreet.cli.evaluate import evaluate

        return evaluate(rest)
    if command == "report":
        from sparsestreet.cli.report import report

        return report(rest)
    if command == "render":
        from sparsestreet.cli.render import render

        return render(rest)
    if command == "export":
        from sparsestreet.cli.export import export

        return export(rest)
    if command == "data":
        from sparsestreet.cli.data import data

        return data(rest)
    if command == "demo":
        from sparsestreet.cli.demo import demo

        return demo(rest)
    if command == "bench":
        from sparsestreet.cli.bench import bench

        return bench(rest)
    print(f"sparsestreet: no command {command!r}\n\n{USAGE}", file=sys.stderr)
    return 2
