PY ?= python3
VENV := .venv
BIN := $(VENV)/bin

# Caches and temporary files stay inside the clone.
export TMPDIR := $(CURDIR)/.cache/tmp
export XDG_CACHE_HOME := $(CURDIR)/.cache
$(shell mkdir -p .cache/tmp)
export MPLCONFIGDIR := $(CURDIR)/.cache/matplotlib
# Set in many containers. Without compiled files each process compiles all modules and tests again: ten seconds.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help quick elsewhere test test-all stress lint style types docs numbers demo bench tables claims figure gpu-pack clean FORCE

help: ## this list
	@awk 'BEGIN { FS = ":.*## " } /^[a-z-]+:.*## / { printf "make %-9s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

# An editable install knows the modules it was made with: a new or renamed one calls for another.
.cache/modules: FORCE
	@find sparsestreet -name '*.py' | sort | cmp -s - $@ || find sparsestreet -name '*.py' | sort >$@
FORCE:

# Everything a fresh clone needs; rebuilt when the project's own files change. Of the 11,500 modules of its packages the
# first import compiles the third that is imported; all would take 20 s.
$(VENV)/.ok: pyproject.toml constraints.txt CMakeLists.txt .cache/modules $(wildcard sparsestreet/ops/cpu/src/*)
	test -x $(BIN)/python || $(PY) -m venv $(VENV)
	$(BIN)/python -m pip install --disable-pip-version-check -q --no-compile -c constraints.txt -e '.[dev]'
	@if $(BIN)/python -m pip list 2>/dev/null | grep -q '^torchvision '; then \
	  echo 'torchvision must not be installed beside the CPU build of torch: it breaks torchmetrics and lightning'; exit 1; fi
	touch $@

# One thread a process: tests are small, and threads that wait for each other cost more than they bring. Files in the order
# of their names: trainings (tests/cli) come early, where files of few tests would come last and leave a process idle.
PROCESSES ?= $(shell test "$$(getconf _NPROCESSORS_ONLN)" -gt 3 && echo 4 || echo 2)
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(PROCESSES) --dist loadfile --no-loadscope-reorder

quick: style ## the loop of daily work, one to three minutes: style and unit tests without trainings and Triton's interpreter
	$(PYTEST) --ignore=tests/cli -m 'not slow and not lengthy and not interpreted'

elsewhere: $(VENV)/.ok ## the fast tests as on another processor, in another time zone, locale and order of hashes
	ATEN_CPU_CAPABILITY=default PYTHONHASHSEED=7 TZ=Asia/Kolkata LC_ALL=C $(PYTEST) --ignore=tests/cli \
	  -m 'not slow and not lengthy and not interpreted'

test: style ## what a change must pass, beside make types: lint and all tests but those marked slow
	$(PYTEST) -m "not slow" --durations=20

test-all: style ## lint and all tests: every kernel for every architecture, every size of tiles
	$(PYTEST) -m "not stress"

stress: $(VENV)/.ok ## kills, damaged and hostile files, 20,000 steps, shared caches: seven minutes
	$(PYTEST) -m stress --durations=20 tests/stress

lint: style types ## style, format, imports that go downwards, types

style: $(VENV)/.ok ## lint without types: seconds
	$(BIN)/python -m ruff check
	$(BIN)/python -m ruff format --check
	$(BIN)/lint-imports

types: $(VENV)/.ok
	$(BIN)/pyright

docs: $(VENV)/.ok ## these pages as a site, without a network: outputs/site/index.html; a broken link is an error
	$(BIN)/python -m sphinx -q -E -a -W --keep-going -n -d .cache/doctrees docs outputs/site

numbers: $(VENV)/.ok ## numbers of the pages beside their records: what differs, and what has no record
	$(BIN)/python scripts/check_numbers.py

demo: $(VENV)/.ok ## a synthetic street, trained plain and pruned: one table, pictures in outputs/demo
	$(BIN)/sparsestreet demo

bench: $(VENV)/.ok ## what accuracy costs in time: records and figures
	$(BIN)/sparsestreet bench settings

# Two runs beside each other, a thread each; what stands is skipped. What fails stands in the tables.
TRAIN := OMP_NUM_THREADS=1 $(BIN)/sparsestreet train hydra/launcher=joblib hydra.launcher.n_jobs=2

tables: $(VENV)/.ok ## five methods, pruned, and controls on three streets (75 trainings): outputs/sweeps/streets/report
	$(TRAIN) +sweep=streets; status=$$?; \
	$(BIN)/sparsestreet report sweep=outputs/sweeps/streets; exit $$status

claims: $(VENV)/.ok ## what the paper claims, at equal count, and what accuracy costs a trained scene (39 trainings): outputs/sweeps
	for sweep in claims renders; do $(TRAIN) +sweep=$$sweep || exit $$?; done
	for sweep in claims renders; do $(BIN)/sparsestreet report sweep=outputs/sweeps/$$sweep; done

figure: $(VENV)/.ok ## quality against training and frame time on the default streets (9 trainings): docs/figures/time.png
	$(TRAIN) +sweep=readme; status=$$?; \
	$(BIN)/sparsestreet report sweep=outputs/sweeps/readme figure=docs/figures/time.png; exit $$status

gpu-pack: $(VENV)/.ok ## what travels to a GPU for scripts/gpu_quarter.sh: .gpu; PLAIN=RUN PRUNED=RUN STREET=DIR GSPLAT=DIR name parts
	$(BIN)/python scripts/gpu_pack.py wheels=true $(if $(PLAIN),plain=$(PLAIN)) $(if $(PRUNED),pruned=$(PRUNED)) \
	  $(if $(STREET),street=$(STREET)) $(if $(GSPLAT),gsplat=$(GSPLAT))

clean: ## removes what the targets made
	rm -rf $(VENV) build outputs/demo outputs/site outputs/streets outputs/cache
