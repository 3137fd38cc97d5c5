#!/usr/bin/env bash
# What a CUDA device can show, in one call of less than eight minutes; one table last.
#
#   scripts/gpu_check.sh            all parts; without a CUDA device a dry run
#   scripts/gpu_check.sh --dry-run  the same parts, tiny, on the CPU
#
# What is missing here is said in the first second, each with its remedy (gpu_needs.py).
#   SPARSESTREET_WHEELS           folder of pure wheels, unpacked into a temporary folder
#   SPARSESTREET_SPLAT_LIBRARY    the built C++ backend; else it is built here, where cmake is
#   TORCH_EXTENSIONS_DIR          where a compiled gsplat may lie
#   TRITON_CACHE_DIR              where compiled kernels may lie
#   OUT                           where logs and records go (default: outputs/gpu_check)
#   PYTHON                        the interpreter (default: python3)
#
# The package runs from the source tree. Each part has its own time limit; a part that fails hides no other, the table
# says so and the exit status is 1. It is 2 where nothing can run.
set -uo pipefail

ROOT="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
cd "$ROOT" || exit 2
PYTHON="${PYTHON:-python3}"
OUT="${OUT:-$ROOT/outputs/gpu_check}"
WORK="$(mktemp -d)"
SITE="$WORK/site"
BUDGET=465       # seconds for everything, so that the whole call stays below 480
GSPLAT_UNTIL=270 # what is not compiled then is given up, so that the benchmark keeps its time
FAILED=0
GSPLAT_PID=""

cleanup() {
  [ -z "$GSPLAT_PID" ] || kill "$GSPLAT_PID" 2>/dev/null
  rm -rf "$WORK"
}
trap cleanup EXIT

case "${1:-}" in
  --dry-run) DRY=1 ;;
  "") DRY=0 ;;
  *) echo "usage: scripts/gpu_check.sh [--dry-run]" >&2; exit 2 ;;
esac

mkdir -p "$OUT" "$SITE"
rm -f "$OUT"/{table.txt,{setup,check,gsplat,parity,kernels,train,bench}.log,gpu.jsonl,train.json}
export PYTHONPATH="$ROOT:$ROOT/scripts:$SITE${PYTHONPATH:+:$PYTHONPATH}"
export PYTHONUNBUFFERED=1
unset TRITON_INTERPRET # the tests set it where there is no device
export TORCH_EXTENSIONS_DIR="${TORCH_EXTENSIONS_DIR:-$WORK/extensions}"
export TRITON_CACHE_DIR="${TRITON_CACHE_DIR:-$WORK/triton}"
export MPLCONFIGDIR="$WORK/matplotlib"
# Half of the cores compile gsplat, the others run tests: most of their time is the compilation of kernels.
JOBS=$((($(nproc) + 1) / 2))
[ "$JOBS" -le 8 ] || JOBS=8

row() { # part, status, seconds, result
  printf '%-8s %-8s %6s s  %s\n' "$@" | tee -a "$WORK/parts"
  [ "$2" != failed ] || FAILED=1
}

more() { printf '%-27s%s\n' "" "$1" | tee -a "$WORK/parts"; } # about the row above

last_line() { grep -v '^[[:space:]]*$' "$1" 2>/dev/null | tail -n 1 | tr -d '\r' | cut -c 1-110; }

run_part() { # part, limit in seconds, log, command...
  local part="$1" limit="$2" log="$3" began="$SECONDS" left status
  shift 3
  left=$((BUDGET - SECONDS))
  [ "$limit" -le "$left" ] || limit="$left"
  if [ "$limit" -lt 5 ]; then
    row "$part" failed 0 "no time was left"
    return 1
  fi
  echo "== $part (at most $limit s)"
  # As Ctrl-C: pytest then says what had failed, and what was running.
  timeout --signal=INT --kill-after=10 "$limit" "$@" >>"$log" 2>&1
  status=$?
  case "$status" in
    0) row "$part" ok $((SECONDS - began)) "$(last_line "$log")" ;;
    124 | 137) row "$part" failed $((SECONDS - began)) "stopped at its limit of $limit s; $(last_line "$log")" ;;
    *) row "$part" failed $((SECONDS - began)) "exit status $status: $(last_line "$log")" ;;
  esac
  return "$status"
}

lacks() { grep -q "^no $1 " "$WORK/needs"; }

say_needs() {
  local status=0 line
  "$PYTHON" scripts/gpu_needs.py "$SITE" ${SPARSESTREET_WHEELS:+"$SPARSESTREET_WHEELS"} >"$WORK/needs" || status=2
  while read -r line; do [ -z "$line" ] || row needs missing 0 "$line"; done <"$WORK/needs"
  [ "$status" = 0 ] || exit 2
  local said
  mapfile -t said < <("$PYTHON" scripts/gpu_says.py machine 2>"$OUT/setup.log")
  MACHINE="${said[0]:-}" CAPABILITY="${said[1]:-}" LIBRARY="${said[2]:-}"
  [ -n "$MACHINE" ] || { cat "$OUT/setup.log" >&2; exit 2; }
  [ -n "$CAPABILITY" ] || DRY=1
  echo "$MACHINE"
}

# What would fail in every part, named with its remedy; its kernels are in the cache then.
run_check() {
  [ "$DRY" = 1 ] || run_part check 60 "$OUT/check.log" "$PYTHON" -m sparsestreet check
}

build_library() {
  if [ -n "$LIBRARY" ]; then
    export SPARSESTREET_SPLAT_LIBRARY="$LIBRARY"
    row build skipped 0 "the C++ backend is built already"
  elif run_part build 60 "$OUT/setup.log" bash -c 'cmake -S . -B "$0" && cmake --build "$0" --parallel' "$WORK/build"
  then
    export SPARSESTREET_SPLAT_LIBRARY="$WORK/build/libsparsestreet_splat.so"
  else
    unset SPARSESTREET_SPLAT_LIBRARY
    row build note 0 "no C++ backend: left out of tests, and no comparison in float64"
  fi
}

# gsplat's wheel holds sources that are compiled when they are first used; that takes minutes, beside the other parts.
start_gsplat() {
  if [ "$DRY" = 1 ] || lacks gsplat; then
    row gsplat skipped 0 "$(lacks gsplat && echo 'is not installed' || echo 'dry run: would be compiled')"
    return
  fi
  export TORCH_CUDA_ARCH_LIST="$CAPABILITY" MAX_JOBS="${MAX_JOBS:-8}"
  timeout --kill-after=5 $((GSPLAT_UNTIL - SECONDS)) "$PYTHON" -c \
    'from gsplat.cuda._backend import _C; print("\ncompiled:", _C is not None)' >"$OUT/gsplat.log" 2>&1 &
  GSPLAT_PID=$!
}

compiling() { [ -n "$GSPLAT_PID" ] && kill -0 "$GSPLAT_PID" 2>/dev/null; }

finish_gsplat() {
  [ -n "$GSPLAT_PID" ] || return
  if wait "$GSPLAT_PID" && grep -q 'compiled: True' "$OUT/gsplat.log"; then
    row gsplat ok "$SECONDS" "compiled"
  else
    row gsplat failed "$SECONDS" "$(grep -m 1 'error:' "$OUT/gsplat.log" || last_line "$OUT/gsplat.log")"
    # Or the benchmark would try to compile it once more.
    rm -rf "$SITE"/gsplat
    echo 'raise ImportError("not compiled, see gsplat.log")' >"$SITE/gsplat.py"
  fi
  GSPLAT_PID=""
}

run_tests() { # part, limit in seconds, arguments of pytest...
  local part="$1" limit="$2" log="$OUT/$1.log" options line
  shift 2
  : >"$log"
  # Warnings are errors where the project chooses the versions; here others have.
  options=(-rfE --tb=short -p no:cacheprovider -p leave_out_missing -o filterwarnings=default
    -o faulthandler_timeout=60 --durations=15)
  # Without beartype the shape annotations are not checked.
  ! lacks beartype || options+=(-o "addopts=-q --strict-markers")
  lacks xdist || options+=(-n "$JOBS" --dist load)
  OMP_NUM_THREADS=1 run_part "$part" "$limit" "$log" "$PYTHON" -m pytest "${options[@]}" "$@"
  { grep -E '^(FAILED|ERROR) ' "$log" | head -n 5; grep '^left out: ' "$log"; } | cut -c 1-150 |
    while read -r line; do more "$line"; done
}

run_parity() {
  local files=(tests/ops/test_parity.py tests/ops/triton/test_{lists,parts,gates}.py -k triton)
  [ "$DRY" = 0 ] || files=(tests/ops/triton/test_work.py)
  run_tests parity 120 "${files[@]}"
}

# All other tests that launch kernels on the device; those that only compile need none.
run_kernels() {
  local files=(tests/ops -k triton --ignore-glob='*machine_code*')
  files+=(--ignore=tests/ops/test_parity.py --ignore=tests/ops/triton/test_{lists,parts,gates}.py)
  [ "$DRY" = 0 ] || files=(tests/ops/triton/test_refused.py)
  run_tests kernels 75 "${files[@]}"
}

run_training() {
  local steps=400 trainer=gpu
  [ "$DRY" = 0 ] || { steps=20 trainer=cpu; }
  run_part train 100 "$OUT/train.log" "$PYTHON" -m sparsestreet train "trainer=$trainer" \
    "schedule.max_steps=$steps" data.log.settings.width=160 data.log.settings.height=96 \
    data.log.settings.num_frames=10 "data.log.root=$WORK/street" "out=$WORK/train" || return
  cp "$WORK/train/records/summary.json" "$OUT/train.json"
  more "$("$PYTHON" scripts/gpu_says.py training "$OUT/train.json")"
}

run_bench() {
  local options=("out=$OUT")
  [ "$DRY" = 0 ] || options+=(quick=true)
  run_part bench 200 "$OUT/bench.log" "$PYTHON" -m benchmarks.gpu "${options[@]}"
}

print_table() {
  echo
  echo "$MACHINE"
  [ "$DRY" = 0 ] || echo "DRY RUN: nothing here was measured on a GPU"
  echo "commit $(git rev-parse --short HEAD 2>/dev/null || echo unknown); $SECONDS s in all"
  printf '%-8s %-8s %8s  %s\n' part status time result
  cat "$WORK/parts"
  grep -E '^(sparsestreet|gsplat) ' "$OUT/bench.log" 2>/dev/null
}

say_needs
start_gsplat
run_check
build_library
run_parity
# A benchmark beside the compiler would be disturbed: these have the time until then, or what is left at the end.
OTHERS=(run_training run_kernels)
while compiling && [ "${#OTHERS[@]}" -gt 0 ]; do
  "${OTHERS[0]}"
  OTHERS=("${OTHERS[@]:1}")
done
finish_gsplat
run_bench
for part in "${OTHERS[@]}"; do "$part"; done
print_table | tee "$OUT/table.txt"
exit "$FAILED"
