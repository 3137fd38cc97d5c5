PY ?= python3
VENV := .venv
BIN := $(VENV)/bin

# Caches and temporary files stay inside the clone.
export TMPDIR := $(CURDIR)/.cache/tmp
export XDG_CACHE_HOME := $(CURDIR)/.cache
$(shell mkdir -p .cache/tmp)
export MPLCONFIGDIR := $(CURDIR)/.cache/matplotlib

.PHONY: test demo lint bench clean FORCE

# An editable install knows the modules it was made with: a new or renamed one calls for another.
.cache/modules: FORCE
	@find sparsestreet -name '*.py' | sort | cmp -s - $@ || find sparsestreet -name '*.py' | sort >$@
FORCE:

# Everything a fresh clone needs; rebuilt when the project's own files change.
$(VENV)/.ok: pyproject.toml constraints.txt CMakeLists.txt .cache/modules $(wildcard sparsestreet/ops/cpu/src/*)
	test -x $(BIN)/python || $(PY) -m venv $(VENV)
	$(BIN)/python -m pip install --disable-pip-version-check -q -c constraints.txt -e '.[dev]'
	@if $(BIN)/python -m pip list 2>/dev/null | grep -q '^torchvision '; then \
	  echo 'torchvision must not be installed beside the CPU build of torch: it breaks torchmetrics and lightning'; exit 1; fi
	touch $@

test: $(VENV)/.ok
	$(BIN)/python -m ruff check
	$(BIN)/lint-imports
	# One thread a process: tests are small, and threads that wait for each other cost more than they bring.
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadgroup

demo: $(VENV)/.ok
	$(BIN)/sparsestreet demo

lint: $(VENV)/.ok
	$(BIN)/python -m ruff check
	$(BIN)/python -m ruff format --check
	$(BIN)/lint-imports

bench: $(VENV)/.ok
	$(BIN)/sparsestreet bench blend
	$(BIN)/sparsestreet bench knobs
	$(BIN)/sparsestreet bench scaling

clean:
	rm -rf $(VENV) build outputs/demo outputs/streets
