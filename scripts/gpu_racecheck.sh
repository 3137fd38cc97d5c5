#!/usr/bin/env bash
# Racecheck of a pinhole, a lens, a shutter, both, and gates, each in a process of its own, so that reports can be told
# apart.
#
#   scripts/gpu_racecheck.sh            with compute-sanitizer of the CUDA toolkit
#   scripts/gpu_racecheck.sh --dry-run  the same renderings in Triton's interpreter, on the CPU
#
#   OUT     where logs go (default: outputs/gpu_racecheck)
#   PYTHON  the interpreter (default: python3)
#
# One line a case: how many reports, and how many of them name project_rows_backward. Status 1: a case did not run.
set -uo pipefail

ROOT="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
cd "$ROOT" || exit 2
PYTHON="${PYTHON:-python3}"
OUT="${OUT:-$ROOT/outputs/gpu_racecheck}"
export PYTHONPATH="$ROOT${PYTHONPATH:+:$PYTHONPATH}"
FAILED=0
WATCH=()

case "${1:-}" in
  --dry-run) export TRITON_INTERPRET=1 ;;
  "") WATCH=(compute-sanitizer --tool racecheck --racecheck-report all --print-limit 1000) ;;
  *) echo "usage: scripts/gpu_racecheck.sh [--dry-run]" >&2; exit 2 ;;
esac
[ ${#WATCH[@]} = 0 ] || command -v "${WATCH[0]}" >/dev/null || {
  echo "no compute-sanitizer: put the CUDA toolkit's bin on PATH, or take --dry-run" >&2
  exit 2
}

mkdir -p "$OUT"
for name in plain lens shutter both gates; do
  log="$OUT/$name.log"
  # Kernels are compiled first, so that the tool watches no compiler.
  if "$PYTHON" scripts/gpu_race_case.py "$name" >"$log" 2>&1 &&
    { [ ${#WATCH[@]} = 0 ] || "${WATCH[@]}" "$PYTHON" scripts/gpu_race_case.py "$name" >>"$log" 2>&1; }; then
    echo "$name: $(grep -ci 'hazard' "$log") lines of reports, $(grep -c 'project_rows_backward' "$log") name project_rows_backward"
  else
    echo "$name: failed, see $log"
    FAILED=1
  fi
done
exit $FAILED
