#!/usr/bin/env bash
# A street of real size to its end on a CUDA device: plain, the paper's method, ours (conf/sweep/real_size.yaml).
#
#   scripts/gpu_street.sh [options of train]
#
# Where a machine is lent for minutes, call it again until it says that all runs are finished: each call goes on from the
# newest checkpoints in outputs/sweeps/real_size, and then leaves what a person needs in OUT. Checkpoints and scenes stay.
#   LIMIT    seconds for training in this call (default: 540); the step ends, a checkpoint is written
#   OUT      where records, curves, tables and logs go as one archive (default: outputs/gpu_street)
#   PYTHON   the interpreter (default: python3)
#   SPARSESTREET_WHEELS   folder of pure wheels, as for gpu_check.sh
#
# Exit status: 0 when all runs are finished and timed, 75 when another call goes on, else that of what failed.
set -uo pipefail

ROOT="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
cd "$ROOT" || exit 2
PYTHON="${PYTHON:-python3}"
OUT="${OUT:-outputs/gpu_street}"
SWEEP=outputs/sweeps/real_size
AGAIN=75 # sysexits.h: temporary failure
SITE="$(mktemp -d)"
mkdir -p "$OUT"
"$PYTHON" scripts/gpu_needs.py "$SITE" ${SPARSESTREET_WHEELS:+"$SPARSESTREET_WHEELS"} || exit 2
export PYTHONPATH="$ROOT:$SITE${PYTHONPATH:+:$PYTHONPATH}" PYTHONUNBUFFERED=1

bring_home() {
  rm -rf "$SITE"
  [ ! -d "$SWEEP" ] || find "$SWEEP" -type f -size -4M \
    \( -path '*/records/*' -o -path '*/curves/*' -o -path '*/report/*' -o -name run.json -o -name '*.log' \) -print0 |
    tar --create --gzip --file "$OUT/real_size.tar.gz" --null --files-from -
}
trap bring_home EXIT

timeout --signal=INT --kill-after=60 "${LIMIT:-540}" \
  "$PYTHON" -m sparsestreet train +sweep=real_size trainer=gpu "$@" 2>&1 | tee -a "$OUT/train.log"
status="${PIPESTATUS[0]}"
case "$status" in
  0) ;;
  124 | 130) echo "the time is up: call this again to go on" && exit "$AGAIN" ;;
  *) exit "$status" ;;
esac

"$PYTHON" -m sparsestreet report "sweep=$SWEEP" | tee "$OUT/report.txt"
# Frames a second before and after pruning, at the size of training and at twice that; gsplat beside, where it is.
for run in "$SWEEP"/*_seed*; do
  timed="$OUT/$(basename "$run")"
  [ -f "$timed/gpu.jsonl" ] || "$PYTHON" -m benchmarks.gpu "street=$run" enlarge=2 "out=$timed" || exit
done
echo "all runs are finished: $OUT"
