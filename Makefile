# make quickstart   the whole pipeline on the built-in landmark (under 4 minutes on 2 cores)
# make test         everything that a machine without a cluster can show: 11 minutes on 2 cores
# make check        the fast part, for every commit
# make test-cluster clusters of several nodes on this machine, and nodes that are lost: under 30 minutes
# make test-nerfbaselines the method for nerfbaselines, in an environment of its own (it takes numpy below 2): 3 minutes
# make soak         training that is killed again and again for 20 minutes
#
# A laptop without a GPU: `make quickstart TORCH_INDEX=https://download.pytorch.org/whl/cpu` takes torch's small CPU build.

PYTHON ?= python3
TORCH_INDEX ?=
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
BASELINES := .venv-nerfbaselines

.PHONY: install quickstart check check-a-k check-l-z test test-a-k test-l-z test-cluster test-nerfbaselines soak lint
.PHONY: format clean

install: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	test -x $(BIN)/pip || $(PYTHON) -m venv $(VENV) || \
	    { rm -rf $(VENV); echo "crossray: no venv could be made; on Debian and Ubuntu: apt install python3-venv" >&2; exit 1; }
	$(BIN)/python -m pip install --quiet --disable-pip-version-check \
	    $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX)) --constraint constraints.txt --editable ".[dev]"
	touch $(STAMP)

quickstart: install
	$(BIN)/crossray quickstart

# Both keep two processes busy the whole time: tests/ingest and the end of tests/pipeline's alphabet are one half.
TWICE = @OMP_NUM_THREADS=1 $(MAKE) --no-print-directory --jobs=2 --output-sync
TEST = $(BIN)/python -m pytest -q -m
A_TO_K = tests --ignore=tests/ingest --ignore-glob='tests/pipeline/test_[l-z]*.py'
L_TO_Z = tests/ingest tests/pipeline/test_[l-z]*.py

check: install
	$(TWICE) check-a-k check-l-z lint

test: install
	$(TWICE) test-a-k test-l-z

check-a-k: install
	$(TEST) "not slow and not real and not cluster" $(A_TO_K)

check-l-z: install
	$(TEST) "not slow and not real and not cluster" $(L_TO_Z)

test-a-k: install
	$(TEST) "not cluster" $(A_TO_K)

test-l-z: install
	$(TEST) "not cluster" $(L_TO_Z)

test-cluster: install
	$(BIN)/python -m pytest -q -m cluster

test-nerfbaselines: $(BASELINES)/.installed
	OMP_NUM_THREADS=1 $(BASELINES)/bin/python -m pytest -q tests/nerfbaselines

$(BASELINES)/.installed: pyproject.toml constraints.txt
	test -x $(BASELINES)/bin/pip || $(PYTHON) -m venv $(BASELINES)
	grep -vE '^(numpy|pandas|plyfile)==' constraints.txt > $(BASELINES)/constraints.txt
	$(BASELINES)/bin/python -m pip install --quiet --disable-pip-version-check \
	    $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX)) --constraint $(BASELINES)/constraints.txt \
	    --editable ".[nerfbaselines]" "pytest>=8.3" "hypothesis>=6.120"
	touch $@

soak: install
	OMP_NUM_THREADS=1 $(BIN)/python tests/faults/soak.py

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: install
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) $(BASELINES) build *.egg-info
