#!/usr/bin/env python3
"""Plant single faults in a copy of the checkout, one at a time, and print which of them the tests find.

    python scripts/plant_faults.py COPY [IDS ...] [--check] [--timeout 240]

COPY is a clone with a .venv of its own; its files are restored after each fault. Two runs need two copies.
benchmarks/faults.yaml lists them: a text that occurs once in the package, what replaces it, the tests that guard it.
--check only looks whether every text still occurs once (status 1 otherwise): use it after modules have moved.
"""

import argparse
import os
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path

import yaml

FAULTS = Path(__file__).parents[1] / "benchmarks" / "faults.yaml"


def find(package: Path, old: str) -> tuple[Path | None, int]:
    hits = [(path, text.count(old)) for path in package.rglob("*.py") if old in (text := path.read_text())]
    return (hits[0][0], hits[0][1]) if len(hits) == 1 else (None, sum(count for _, count in hits))


def drop_compiled(file: Path) -> None:
    for pyc in (file.parent / "__pycache__").glob(f"{file.stem}.*.pyc"):
        pyc.unlink(missing_ok=True)


def run(tree: Path, tests: list[str], timeout: float) -> tuple[str, str]:
    python = tree / ".venv/bin/python"
    command = [
        str(python if python.exists() else sys.executable),
        "-B",
        "-m",
        "pytest",
        "-x",
        "-q",
        "-p",
        "no:cacheprovider",
        "-m",
        "not slow and not stress",
        "--no-header",
        "--tb=line",
        *tests,
    ]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    try:
        done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, timeout=timeout)
    except subprocess.TimeoutExpired:
        return "timeout", ""
    by = next(
        (line[7:].split(" - ")[0] for line in done.stdout.splitlines() if line.startswith(("FAILED ", "ERROR "))), ""
    )
    if done.returncode < 0:
        return "killed", f"signal {-done.returncode}"  # the process ended within a test
    if done.returncode == 1 or (done.returncode == 2 and by):
        return "killed", by
    if done.returncode == 0:
        return "survived", ""
    return f"rc{done.returncode}", (done.stdout + done.stderr)[-200:].replace("\n", " ")


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("worktree", type=Path)
    parser.add_argument("ids", nargs="*")
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--timeout", type=float, default=240)
    given = parser.parse_intermixed_args()
    faults = yaml.safe_load(FAULTS.read_text())
    if given.ids:
        faults = [one for one in faults if one["id"] in given.ids]
    package = given.worktree / "sparsestreet"
    rates, bad = defaultdict(lambda: [0, 0]), []
    for one in faults:
        if "gone" in one:
            continue
        file, count = find(package, one["old"])
        if file is None or count != 1:
            bad.append(one["id"])
            print(f"{one['id']}\tNOT PLANTED: old occurs {count} times ({one['module']})", flush=True)
            continue
        if given.check:
            continue
        tests = [test for test in one["tests"] if (given.worktree / test.split("::")[0]).exists()]
        absent = sorted(set(one["tests"]) - set(tests))
        runs = [[one["first"]]] if one.get("first") and (given.worktree / one["first"].split("::")[0]).exists() else []
        runs += [tests] if tests else []
        content, began, verdict, by = file.read_bytes(), time.time(), "no tests", ""
        try:
            file.write_bytes(content.replace(one["old"].encode(), one["new"].encode()))
            drop_compiled(file)
            for some in runs:
                verdict, by = run(given.worktree, some, given.timeout)
                if verdict in ("killed", "timeout"):
                    break
        finally:
            file.write_bytes(content)
            drop_compiled(file)
        room = one.get("room") or one["module"].split("/")[1]
        rates[room][0] += verdict in ("killed", "timeout")
        rates[room][1] += 1
        line = f"{one['id']}\t{verdict}\t{time.time() - began:.0f} s\t{file.relative_to(package)}\t{one['fault']}\t{by}"
        print(line + (f"\tABSENT: {absent}" if absent else ""), flush=True)
    if not given.check:
        for room, (killed, planted) in sorted(rates.items()):
            print(f"{room}: {killed} of {planted}")
        killed, planted = map(sum, zip(*rates.values(), strict=True))
        print(f"all: {killed} of {planted} killed; not planted: {bad or 'none'}")
    return 1 if bad else 0


sys.exit(main())
