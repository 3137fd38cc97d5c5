#!/bin/bash
# mkwt.sh NAME [REV]: worktree /work/wt-NAME on branch NAME, with a .venv that shares main's packages
set -e
N=$1; W=/work/wt-$N
git -C /work/main worktree add -q -B $N $W ${2:-main}
M=/work/main/.venv
python3.11 -m venv --without-pip $W/.venv
SP=$W/.venv/lib/python3.11/site-packages
printf '%s\n%s\n' "$W" "$M/lib/python3.11/site-packages" > $SP/shared.pth
for f in $M/bin/*; do b=$(basename $f); [ -e $W/.venv/bin/$b ] && continue
  if head -c 2 $f | grep -q '#!'; then sed "s#/work/main/.venv/bin/python3*#$W/.venv/bin/python#" $f > $W/.venv/bin/$b; chmod +x $W/.venv/bin/$b
  else ln -s $f $W/.venv/bin/$b; fi; done
LIB=$(find $M/lib/python3.11/site-packages /work/main/build -name 'libsparsestreet_splat*.so' | head -1)
mkdir -p $W/.cache/tmp; touch $W/.venv/.ok
cat > $W/env.sh <<X
cd $W; export PATH=$W/.venv/bin:\$PATH TMPDIR=$W/.cache/tmp XDG_CACHE_HOME=$W/.cache MPLCONFIGDIR=$W/.cache/matplotlib OMP_NUM_THREADS=1 SPARSESTREET_SPLAT_LIBRARY=$LIB
unset PYTHONDONTWRITEBYTECODE
X
grep -q '^env.sh' $(git -C $W rev-parse --git-common-dir)/info/exclude || printf 'env.sh\n' >> $(git -C $W rev-parse --git-common-dir)/info/exclude
echo $W lib=$LIB
