# Parts of a run on a GPU, each with a limit of its own, and their table: gpu_check.sh and gpu_quarter.sh source this.
#
# Wanted beforehand: ROOT, the folder of the sources; OUT, a folder for logs and records; PYTHON, the interpreter; BUDGET,
# seconds for everything; DRY, 1 for tiny inputs on the CPU. SITE may name the folder of unpacked wheels, PREDICTED hold
# seconds by the name of a part, after_part be a function that is called behind each.
#
# A part that fails hides no other: the table says so, and FAILED is 1.

WORK="$(mktemp -d)"
SITE="${SITE:-$WORK/site}"
FAILED=0
GSPLAT_PID=""
declare -p PREDICTED >/dev/null 2>&1 || declare -A PREDICTED

cleanup() {
  [ -z "$GSPLAT_PID" ] || kill "$GSPLAT_PID" 2>/dev/null
  rm -rf "$WORK"
}

mkdir -p "$OUT" "$SITE"
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

# AT_LIMIT: what a part is whose limit ends it (default: failed). KILL_AFTER: seconds that it has to end then.
run_part() { # part, limit in seconds, log, command...
  local part="$1" limit="$2" log="$3" began="$SECONDS" left status foreseen
  shift 3
  left=$((BUDGET - SECONDS))
  [ "$DRY" = 0 ] || limit=$((5 * limit)) # nothing is measured, and the machine may be busy
  [ "$limit" -le "$left" ] || limit="$left"
  if [ "$limit" -lt 5 ]; then
    row "$part" failed 0 "no time was left"
    return 1
  fi
  echo "== $part (at most $limit s)"
  # As Ctrl-C: pytest then says what had failed, and what was running; a training writes a checkpoint.
  timeout --signal=INT --kill-after="${KILL_AFTER:-10}" "$limit" "$@" >>"$log" 2>&1
  status=$?
  foreseen="${PREDICTED[$part]:+(${PREDICTED[$part]} s foreseen) }"
  case "$status" in
    0) row "$part" ok $((SECONDS - began)) "$foreseen$(last_line "$log")" ;;
    124 | 137) row "$part" "${AT_LIMIT:-failed}" $((SECONDS - began)) "stopped at its limit of $limit s; $(last_line "$log")" ;;
    *) row "$part" failed $((SECONDS - began)) "exit status $status: $(last_line "$log")" ;;
  esac
  ! declare -F after_part >/dev/null || after_part
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
start_gsplat() { # until when, in seconds
  if [ "$DRY" = 1 ] || lacks gsplat; then
    row gsplat skipped 0 "$(lacks gsplat && echo 'is not installed' || echo 'dry run: would be compiled')"
    return
  fi
  export TORCH_CUDA_ARCH_LIST="$CAPABILITY" MAX_JOBS="${MAX_JOBS:-8}"
  timeout --kill-after=5 $(($1 - SECONDS)) "$PYTHON" -c \
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

# Whether kernels of today's default draw and differentiate what the reference does.
run_parity() { # limit in seconds
  local files=(tests/ops/test_parity.py tests/ops/triton/test_{lists,parts,gates}.py -k triton)
  [ "$DRY" = 0 ] || files=(tests/ops/triton/test_work.py)
  run_tests parity "$1" "${files[@]}"
}

print_table() {
  echo
  echo "${MACHINE:-}"
  [ "$DRY" = 0 ] || echo "DRY RUN: nothing here was measured on a GPU"
  echo "commit $(git rev-parse --short HEAD 2>/dev/null || echo unknown); $SECONDS s in all"
  printf '%-8s %-8s %8s  %s\n' part status time result
  cat "$WORK/parts"
}
