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
BUDGET=465       # seconds for everything, so that the whole call stays below 480
GSPLAT_UNTIL=270 # what is not compiled then is given up, so that the benchmark keeps its time

case "${1:-}" in
  --dry-run) DRY=1 ;;
  "") DRY=0 ;;
  *) echo "usage: scripts/gpu_check.sh [--dry-run]" >&2; exit 2 ;;
esac

. scripts/gpu_parts.sh
trap cleanup EXIT
rm -f "$OUT"/{table.txt,{setup,check,gsplat,parity,kernels,train,bench}.log,gpu.jsonl,train.json}

# What would fail in every part, named with its remedy; its kernels are in the cache then.
run_check() {
  [ "$DRY" = 1 ] || run_part check 60 "$OUT/check.log" "$PYTHON" -m sparsestreet check
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

say_needs
start_gsplat "$GSPLAT_UNTIL"
run_check
build_library
run_parity 120
# A benchmark beside the compiler would be disturbed: these have the time until then, or what is left at the end.
OTHERS=(run_training run_kernels)
while compiling && [ "${#OTHERS[@]}" -gt 0 ]; do
  "${OTHERS[0]}"
  OTHERS=("${OTHERS[@]:1}")
done
finish_gsplat
run_bench
for part in "${OTHERS[@]}"; do "$part"; done
{
  print_table
  grep -E '^(sparsestreet|gsplat) ' "$OUT/bench.log" 2>/dev/null
} | tee "$OUT/table.txt"
exit "$FAILED"
