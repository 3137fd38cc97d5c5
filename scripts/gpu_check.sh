#!/usr/bin/env bash
# Everything a CUDA device can show, in one call of less than eight minutes; one table last.
#
#   scripts/gpu_check.sh            all parts; without a CUDA device a dry run
#   scripts/gpu_check.sh --dry-run  says what it would do and runs what the CPU can, tiny
#
# Needs a python with torch, triton, numpy, jaxtyping, lightning and pytest; with beartype the tests also check shapes
# and types. Packages that are missing beside them (those and hydra-core, omegaconf, antlr4-python3-runtime, kornia;
# gsplat to compare with) come as wheels in a folder. Test files that need another package (hypothesis, scipy,
# matplotlib) are left out, and the table names them; training needs scipy, matplotlib, safetensors, rich, beartype.
#   SPARSESTREET_WHEELS   folder of wheels, installed into a temporary folder without an index and without dependencies
#   OUT                   where logs and records go (default: outputs/gpu_check)
#   PYTHON                the interpreter (default: python3)
#
# The package runs from the source tree. Each part has its own time limit; a part that fails hides no other, the table
# says so and the exit status is 1.
set -uo pipefail

ROOT="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
cd "$ROOT" || exit 1
PYTHON="${PYTHON:-python3}"
OUT="${OUT:-$ROOT/outputs/gpu_check}"
WHEELS="${SPARSESTREET_WHEELS:-}"
WORK="$(mktemp -d)"
SITE="$WORK/site"
BUDGET=465 # seconds for everything, so that the whole call stays below 480
FAILED=0
GSPLAT_PID=""

cleanup() {
  [ -z "$GSPLAT_PID" ] || kill "$GSPLAT_PID" 2>/dev/null
  rm -rf "$WORK"
}
trap cleanup EXIT

mkdir -p "$OUT" "$SITE"
rm -f "$OUT"/{table.txt,setup.log,gsplat.log,tests.log,train.log,bench.log,gpu.jsonl,train.json}
export PYTHONPATH="$ROOT:$ROOT/scripts:$SITE${PYTHONPATH:+:$PYTHONPATH}"
export PYTHONUNBUFFERED=1
export TORCH_EXTENSIONS_DIR="$WORK/extensions"
export MPLCONFIGDIR="$WORK/matplotlib"

export SUMMARIZE='
import json, sys

record = json.load(open(sys.argv[1]))
seconds, psnr = record["run"]["training_seconds"], record["quality"]["held_out"]["psnr_full"]["mean"]
print(f"{seconds:.1f} s of training, held-out PSNR {psnr:.2f} dB")'

has() { "$PYTHON" -c "import $1" >/dev/null 2>&1; }

has torch || { echo "gpu_check: $PYTHON has no torch; name another interpreter with PYTHON=" >&2; exit 2; }
DRY=0
case "${1:-}" in
  --dry-run) DRY=1 ;;
  "") "$PYTHON" -c 'import sys, torch; sys.exit(not torch.cuda.is_available())' || DRY=1 ;;
  *) echo "usage: scripts/gpu_check.sh [--dry-run]" >&2; exit 2 ;;
esac

remaining() { echo $((BUDGET - SECONDS)); }

row() { # part, status, seconds, result
  printf '%-8s %-8s %6s s  %s\n' "$1" "$2" "$3" "$4" >>"$WORK/parts"
  [ "$2" != failed ] || FAILED=1
}

last_line() { grep -v '^[[:space:]]*$' "$1" 2>/dev/null | tail -n 1 | tr -d '\r' | cut -c 1-110; }

run_part() { # part, limit in seconds, log, command...
  local part="$1" limit="$2" log="$3" began="$SECONDS" left status
  shift 3
  left="$(remaining)"
  [ "$limit" -le "$left" ] || limit="$left"
  echo "== $part (at most $limit s)"
  if [ "$limit" -lt 5 ]; then
    row "$part" failed 0 "no time was left"
    return 1
  fi
  timeout --kill-after=5 "$limit" "$@" >>"$log" 2>&1
  status=$?
  case "$status" in
    0) row "$part" ok $((SECONDS - began)) "$(last_line "$log")" ;;
    124 | 137) row "$part" failed $((SECONDS - began)) "stopped at its limit of $limit s; $(last_line "$log")" ;;
    *) row "$part" failed $((SECONDS - began)) "exit status $status: $(last_line "$log")" ;;
  esac
  return "$status"
}

install_wheels() {
  if [ -z "$WHEELS" ]; then
    row wheels skipped 0 "SPARSESTREET_WHEELS names no folder"
    return
  fi
  if [ "$DRY" = 1 ]; then
    row wheels skipped 0 "dry run: $(find "$WHEELS" -name '*.whl' | wc -l) wheels would be installed"
    return
  fi
  run_part wheels 40 "$OUT/setup.log" "$PYTHON" -m pip install --quiet --no-index --no-deps --no-compile \
    --no-cache-dir --disable-pip-version-check --target "$SITE" "$WHEELS"/*.whl
}

# Without these no part, or hardly one, can do anything.
check_needed() {
  local package
  for package in numpy jaxtyping pytest lightning triton; do
    has "$package" || row needs failed 0 "no $package: install it or put its wheel into SPARSESTREET_WHEELS"
  done
}

build_library() {
  local library=sparsestreet/ops/cpu/libsparsestreet_splat.so
  if "$PYTHON" -c 'from sparsestreet.ops.cpu.library import load_library; load_library()' >/dev/null 2>&1; then
    row build skipped 0 "the C++ backend is built already"
  elif ! command -v cmake >/dev/null; then
    row build skipped 0 "no cmake: without the C++ backend"
  else
    run_part build 60 "$OUT/setup.log" bash -c '
      cmake -S . -B "$1" && cmake --build "$1" --parallel && cp "$1"/libsparsestreet_splat.so "$2.part" &&
        mv "$2.part" "$2"' build "$WORK/build" "$library"
  fi
}

# gsplat's wheel holds sources that are compiled when they are first used; that takes minutes, beside the other parts.
# What is not compiled after 300 s is given up, so that the benchmark keeps its time.
start_gsplat() {
  if [ "$DRY" = 1 ] || ! has gsplat; then
    row gsplat skipped 0 "$([ "$DRY" = 1 ] && echo 'dry run: would be compiled' || echo 'cannot be imported')"
    return
  fi
  TORCH_CUDA_ARCH_LIST="$("$PYTHON" -c 'import torch; print("%d.%d" % torch.cuda.get_device_capability())')"
  export TORCH_CUDA_ARCH_LIST MAX_JOBS="${MAX_JOBS:-$(nproc)}"
  timeout --kill-after=5 "$((300 - SECONDS))" "$PYTHON" -c 'from gsplat.cuda._backend import _C; print("compiled:", _C is not None)' \
    >"$OUT/gsplat.log" 2>&1 &
  GSPLAT_PID=$!
}

finish_gsplat() {
  [ -n "$GSPLAT_PID" ] || return
  if wait "$GSPLAT_PID" && grep -q 'compiled: True' "$OUT/gsplat.log"; then
    row gsplat ok "$SECONDS" "compiled"
  else
    row gsplat failed "$SECONDS" "$(last_line "$OUT/gsplat.log")"
    rm -rf "$SITE"/gsplat "$SITE"/gsplat-* # or the benchmark would try to compile it once more
  fi
  GSPLAT_PID=""
}

run_tests() {
  local options=(-p no:cacheprovider -p leave_out_missing)
  # Without beartype the shape annotations are not checked and the project's filters, which name it, cannot be read.
  has beartype || options+=(-o "addopts=-q --strict-markers" -o "filterwarnings=default")
  if [ "$DRY" = 1 ]; then
    echo "(a device would run all of tests/ops and tests/bench)"
    run_part tests 120 "$OUT/tests.log" "$PYTHON" -m pytest "${options[@]}" tests/bench tests/ops/test_errors.py
  else
    ! has xdist || options+=(-n 4)
    run_part tests 120 "$OUT/tests.log" "$PYTHON" -m pytest "${options[@]}" tests/ops tests/bench
  fi
  has beartype || row tests note 0 "no beartype: shapes and types were not checked"
  sed -n 's/^left out: //p' "$OUT/tests.log" 2>/dev/null | while read -r file; do row tests "left out" 0 "$file"; done
}

run_training() {
  local steps=400 trainer=gpu
  [ "$DRY" = 0 ] || { steps=20 trainer=cpu; }
  run_part train 75 "$OUT/train.log" bash -c '"$@" && cp "$0/train/records/summary.json" "$0/train.json" &&
    "$1" -c "$SUMMARIZE" "$0/train.json"' "$WORK" "$PYTHON" -m sparsestreet train "trainer=$trainer" \
    "schedule.max_steps=$steps" data.log.settings.width=160 data.log.settings.height=96 \
    data.log.settings.num_frames=10 "data.log.root=$WORK/street" "out=$WORK/train"
  [ ! -f "$WORK/train.json" ] || cp "$WORK/train.json" "$OUT/train.json"
}

run_bench() {
  local options=(bench gpu --out "$OUT")
  [ "$DRY" = 0 ] || options+=(--quick)
  run_part bench 240 "$OUT/bench.log" "$PYTHON" -m sparsestreet "${options[@]}"
}

describe_machine() {
  "$PYTHON" - <<'PYTHON'
import platform
import torch

found = torch.cuda.is_available()
device = torch.cuda.get_device_name() if found else "no CUDA device"
print(f"{device}; python {platform.python_version()}, torch {torch.__version__}, CUDA {torch.version.cuda}")
PYTHON
}

print_table() {
  echo
  describe_machine
  [ "$DRY" = 0 ] || echo "DRY RUN: nothing here was measured on a GPU"
  echo "commit $(git rev-parse --short HEAD 2>/dev/null || echo unknown); $SECONDS s in all"
  printf '%-8s %-8s %8s  %s\n' part status time result
  cat "$WORK/parts"
  grep -E '^(sparsestreet|gsplat) ' "$OUT/bench.log" 2>/dev/null
}

install_wheels
check_needed
build_library
start_gsplat
run_tests
run_training
finish_gsplat
run_bench
print_table | tee "$OUT/table.txt"
exit "$FAILED"
