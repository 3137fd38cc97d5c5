#!/usr/bin/env bash
# A quarter of an hour on a GPU: what only a device can say, the most valuable first, in two calls of at most 580 s.
#
#   scripts/gpu_quarter.sh first     parity, a step of training, graphs, times beside gsplat, frames; a training begins
#   scripts/gpu_quarter.sh second    the training goes on, is pruned from its branch; frames and times of both
#   scripts/gpu_quarter.sh first --dry-run    the same parts, tiny, on the CPU (also where there is no device)
#
# Nobody decides anything meanwhile. `make gpu-pack` prepares what is carried.
#   PACK     folder of what is carried (default: .gpu); without it the street is traced and what needs scenes is skipped
#   OUT      what comes home: an archive a call, renewed after each part, and scenes in pieces of 15 MB (default:
#            outputs/gpu_quarter/home)
#   STAY     what a second call on the same machine finds again (default: outputs/gpu_quarter). On a bare machine the
#            second call trains anew, as many steps as its time allows.
#   PYTHON   the interpreter (default: python3)
#
# The table has what each part took and what was foreseen. Status 1: a part failed; 2: nothing can run.
set -uo pipefail

ROOT="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
cd "$ROOT" || exit 2
PYTHON="${PYTHON:-python3}"
PACK="${PACK:-$ROOT/.gpu}"
STAY="${STAY:-$ROOT/outputs/gpu_quarter}"
HOME_FOLDER="${OUT:-$STAY/home}"
BUDGET=570       # seconds; the archive, and a training that writes its checkpoint, have what is left of 580
GSPLAT_UNTIL=260 # what is not compiled then is given up, so that the comparison keeps its time
# Guesses from records of an H100 and shares of a CPU's time, before any device saw this script.
declare -A PREDICTED=([parity]=90 [step]=75 [graph]=20 [replay]=45 [ours]=90 [theirs]=55 [frames]=25 [train]=110 [export]=20
  [pruned]=60 [frames2]=25 [street]=40 [export2]=8)

CALL="${1:-}"
DRY=0
case "$CALL ${2:-}" in
  "first " | "second ") ;;
  "first --dry-run" | "second --dry-run") DRY=1 ;;
  *) echo "usage: scripts/gpu_quarter.sh first|second [--dry-run]" >&2; exit 2 ;;
esac

OUT="$STAY/$CALL"
SITE="$STAY/site"
export TORCH_EXTENSIONS_DIR="$STAY/extensions" TRITON_CACHE_DIR="$STAY/triton"
# Of the newest gsplat, whose build takes these: what is measured here is plain 3DGS.
export BUILD_3DGUT=0 BUILD_2DGS=0 BUILD_RELOC=0 BUILD_LOSSES=0
[ ! -f "$PACK/libsparsestreet_splat.so" ] || export SPARSESTREET_SPLAT_LIBRARY="$PACK/libsparsestreet_splat.so"
rm -rf "$OUT"
mkdir -p "$HOME_FOLDER" "$STAY/runs"
# Unpacked again, they would be newer than what was compiled of them.
[ -d "$SITE" ] || [ ! -d "$PACK/wheels" ] || SPARSESTREET_WHEELS="$PACK/wheels"
[ "$DRY" = 0 ] || BUDGET=3000
. scripts/gpu_parts.sh

PLAIN="$STAY/runs/plain" PRUNED="$STAY/runs/pruned"
BRANCH="$PLAIN/checkpoints/before_0.93334.ckpt"

# Each record is home before the next is measured.
after_part() {
  (cd "$STAY" && find "$CALL" runs -type f -size -4M \
    \( -path "$CALL/*" -o -path '*/records/*' -o -path '*/curves/*' -o -name run.json -o -name '*.log' \) -print0 |
    tar --create --gzip --file "$HOME_FOLDER/.$CALL.tar.gz" --null --files-from -) &&
    mv "$HOME_FOLDER/.$CALL.tar.gz" "$HOME_FOLDER/$CALL.tar.gz"
}

leave() {
  print_table >"$OUT/table.txt" 2>/dev/null
  after_part
  cleanup
}
trap leave EXIT

left() { echo $((BUDGET - SECONDS - $1)); } # seconds, but for so many

skip() { row "$1" skipped 0 "$2"; }

# Lines of a log that say more than its last one.
quote() { # part, pattern
  grep -hE "$2" "$OUT/$1.log" 2>/dev/null | cut -c 1-200 | while read -r line; do more "$line"; done
}

unpack_sources() {
  [ -f "$PACK/gsplat.tar.gz" ] && [ -n "${SPARSESTREET_WHEELS:-}" ] || return
  rm -rf "$SITE"/gsplat "$SITE"/gsplat-*
  "$PYTHON" -m tarfile -e "$PACK/gsplat.tar.gz" "$SITE"
}

# The street and how it is trained: 960x640, three cameras, a million first Gaussians, 30,000 steps.
choose_training() {
  STREET=(data.log.settings.width=960 data.log.settings.height=640 data.log.settings.jpeg=95)
  TRAIN=(trainer=gpu schedule=paper capacity=paper node.background.max_gaussians=1500000 trainer.val_check_interval=1000
    checkpoint_every=5000)
  if [ "$DRY" = 1 ]; then
    STREET=(data.log.settings.{width=64,height=48,num_frames=10,num_cameras=1})
    TRAIN=(trainer=cpu schedule.max_steps=40 trainer.val_check_interval=40 node.background.num_points=300
      image_points=none moved_views=none
      evaluation.timing.{warmup=1,repeats=2,rounds=1})
  fi
  [ ! -f "$PACK/street.options" ] || mapfile -t STREET <"$PACK/street.options"
  TRAIN+=("${STREET[@]}" "data.log.root=$STAY/street" "cache=$STAY/cache" "branch_points=[0.93334]")
  [ -d "$STAY/street" ] || [ ! -f "$PACK/street.tar.xz" ] ||
    { mkdir -p "$STAY/street" && "$PYTHON" -m tarfile -e "$PACK/street.tar.xz" "$STAY/street"; }
}

run_step() { # part, limit in seconds, options of bench step...
  local options=("out=$OUT/$1" "${@:3}")
  [ "$DRY" = 0 ] || options+=(quick=true)
  run_part "$1" "$2" "$OUT/$1.log" "$PYTHON" -m sparsestreet bench step "${options[@]}" "${TRAIN[@]}"
  quote "$1" '^(a step|on |floors:)'
}

run_graph() {
  local options=("$OUT/graph.jsonl")
  [ "$DRY" = 0 ] || { options+=(--dry-run) && export TRITON_INTERPRET=1; }
  run_part graph 45 "$OUT/graph.log" "$PYTHON" scripts/gpu_capture.py "${options[@]}"
  unset TRITON_INTERPRET
  quote graph 'rows, '
}

run_bench() { # part, limit in seconds, scene, options of benchmarks.gpu...
  local part="$1" limit="$2" options=("out=$OUT/$1" "street=$3" "${@:4}")
  [ -e "$3" ] || { skip "$part" "there is no $3"; return; }
  [ "$DRY" = 0 ] || options+=(quick=true)
  run_part "$part" "$limit" "$OUT/$part.log" "$PYTHON" -m benchmarks.gpu "${options[@]}"
  quote "$part" '^(sparsestreet|gsplat) '
}

run_frames() { # part, scenes...
  local part="$1" scene scenes="" options=("out=$OUT/$1")
  for scene in "${@:2}"; do [ ! -e "$scene" ] || scenes+="${scenes:+,}$scene"; done
  [ -n "$scenes" ] || { skip "$part" "there is no scene: ${*:2}"; return; }
  [ "$DRY" = 0 ] || options+=(repeats=2 widths=64)
  run_part "$part" 60 "$OUT/$part.log" "$PYTHON" -m benchmarks.streets "scenes=[$scenes]" "${options[@]}"
  quote "$part" ' a second'
}

run_training() { # seconds
  local options=("out=$PLAIN")
  if [ -f "$PLAIN/records/summary.json" ] && [ ! -f "$PLAIN/checkpoints/interrupted.ckpt" ]; then
    skip train "it is finished"
    return
  fi
  # The same command goes on; on a bare machine it is another run, whose steps fit into the time.
  if [ "$CALL" = second ] && { [ ! -d "$PLAIN" ] || [ -f "$STAY/runs/budget" ]; }; then
    touch "$STAY/runs/budget"
    options+=("budget.minutes=$([ "$DRY" = 1 ] && echo 0.5 || echo $(($1 / 60)))")
  fi
  AT_LIMIT=stopped KILL_AFTER=30 run_part train "$1" "$OUT/train.log" \
    "$PYTHON" -m sparsestreet train "${TRAIN[@]}" "${options[@]}"
  quote train '(stopped after step|PSNR)'
}

# The checkpoint of the branch stays on the machine: with Adam's moments it is too large to be carried.
run_pruned() { # seconds
  [ -f "$BRANCH" ] || { skip pruned "the training has not come to 0.93334"; return; }
  AT_LIMIT=stopped KILL_AFTER=30 run_part pruned "$1" "$OUT/pruned.log" \
    "$PYTHON" -m sparsestreet train "resume=$BRANCH" sparsify=importance "out=$PRUNED"
  quote pruned '(stopped after step|PSNR)'
}

# Rounded rows, no moments, 15 to 20 bytes a Gaussian: docs/shipping.md says what that costs, some 0.02 dB.
run_export() { # part, run
  local name
  name="$(basename "$2")"
  [ -e "$2/scene.safetensors" ] || { skip "$1" "there is no scene in $2"; return; }
  run_part "$1" 45 "$OUT/$1.log" "$PYTHON" -m sparsestreet export "$2" "$STAY/$name.street" || return
  rm -f "$HOME_FOLDER/$name.street."*
  split --bytes=15M --numeric-suffixes "$STAY/$name.street" "$HOME_FOLDER/$name.street."
}

call_first() {
  run_parity 120
  run_step step 120
  run_graph
  run_step replay 90 render.replay=true
  while compiling; do sleep 1; done
  finish_gsplat
  run_bench ours 120 "$PACK/plain.street" refine=3 enlarge=2 "rows=[1500000,100000]"
  run_bench theirs 80 "$PACK/plain.street" refine=3 enlarge=2 "rows=[1500000,100000]" first=gsplat compares=false
  run_frames frames "$PACK/plain.street" "$PACK/pruned.street"
  run_training "$(left 60)"
  run_export export "$PLAIN"
}

call_second() {
  run_training "$(left 190)"
  run_pruned "$(left 110)"
  run_frames frames2 "$PLAIN" "$PRUNED"
  finish_gsplat
  run_bench street 50 "$PLAIN" enlarge=2 "rows=[100000]"
  run_export export2 "$PRUNED"
  run_export export "$PLAIN"
}

say_needs
unpack_sources
start_gsplat "$GSPLAT_UNTIL"
build_library
nvidia-smi -q >"$OUT/nvidia-smi.txt" 2>/dev/null
choose_training
"call_$CALL"
print_table
exit "$FAILED"
