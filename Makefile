# Two commands do all the set-up: `make sortie` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
LIGHT := $(VENV)/.flies
STAMP := $(VENV)/.installed
SCENARIO ?= scenarios/library/track_target.yaml
SECONDS_EACH ?= 600
NOTEBOOKS ?= notebooks
# compiled files are kept: otherwise each of hundreds of processes compiles what it imports, and each worker all tests
export PYTHONDONTWRITEBYTECODE :=

.PHONY: help sortie screenshot test test-all nightly lint check format bench bench-all research figures validate-ns3 ns3 mavproxy mutate clean scenarios scenarios-short notebooks outputs fuzz docs test-lowest

help: ## show this list
	@grep -hE '^[a-z0-9-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-10s %s\n", $$1, $$2}'

# what the main job needs: torch, by its CPU build where that can be had, and the viewer. uv is quicker than pip where it is there.
$(LIGHT): pyproject.toml constraints.txt
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@# an older clone's metadata would name entry points that are no more
	@rm -rf *.egg-info
	@echo 'installing what the main job needs into $(VENV)'
	@{ command -v uv >/dev/null && uv pip install --quiet --python $(BIN)/python --torch-backend cpu -c constraints.txt -e '.[torch,view]'; } \
		|| { $(BIN)/python -m pip install --quiet --no-compile -c constraints.txt torch \
		&& $(BIN)/python -m pip install --quiet --no-compile -c constraints.txt -e '.[torch,view]'; }
	@echo 'compiling loops, which later runs reuse: a minute on slow cores'
	@$(BIN)/sortie fly track_target --set duration_s=2 --out $(VENV)/compiled --replace >/dev/null
	@touch $@

# what tests, lint and research need besides
$(STAMP): $(LIGHT)
	$(BIN)/python -m pip install --quiet --no-compile -c constraints.txt -e '.[dev]'
	@touch $@

sortie: $(LIGHT) ## fly the main scenario, print its outcome and what sharing is worth (SCENARIO=... for another)
	$(BIN)/sortie fly $(SCENARIO) --over silence

screenshot: $(LIGHT) ## fly the paper's replay with contention and take docs/sortie.png from the real viewer (needs mesa-vulkan-drivers)
	$(BIN)/sortie fly paper_replay_contention --set perception.detector=surrogate --out runs/screenshot --replace
	$(BIN)/sortie view runs/screenshot --picture docs/sortie.png --at 64.2

test: $(STAMP) ## run the test suite but for its slow tests and those of pages, a worker a core
	$(BIN)/python -m pytest -n auto -m 'not slow and not pages'

test-all: $(STAMP) ## run the whole test suite, with other random examples each time
	$(BIN)/python -m pytest -n auto --hypothesis-profile explore

test-lowest: ## test the lowest versions that pyproject.toml allows, without torch, in .venv-lowest (Python 3.11)
	$(PYTHON) -m venv --clear .venv-lowest
	.venv-lowest/bin/python -m pip install --quiet uv
	.venv-lowest/bin/uv pip install --quiet --python .venv-lowest/bin/python --resolution lowest-direct \
		-e '.[mavlink,ros2,verify]' 'pytest>=8.2' 'hypothesis>=6.100' 'pytest-benchmark>=5' 'pyulog>=1.1' 'shapely>=2.0.6' 'networkx>=3.3' 'filelock>=3.12'
	.venv-lowest/bin/sortie fly track_target --set perception.detector=surrogate --set duration_s=5 --out .venv-lowest/run
	@# the one left out counts the operations of the torch network
	.venv-lowest/bin/python -m pytest -m 'not slow' tests/scenarios tests/policies tests/radio tests/fleet --ignore tests/fleet/test_fleet_computer.py

lint: $(STAMP) ## style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# torch's threads would wait in a busy loop, which takes the cores from other workers
scenarios: $(STAMP) ## fly the library's scenarios and test what each expects (minutes each)
	OMP_WAIT_POLICY=passive $(BIN)/python -m pytest -n auto --dist loadfile scenarios/library

# the search is the largest fleet, and its point shows in a quarter of its time
scenarios-short: $(STAMP) ## the same with the surrogate in place of the detector, seconds each
	$(BIN)/python -m pytest -n auto --dist loadfile scenarios/library --ignore scenarios/library/search_grid.yaml --sortie-set perception.detector=surrogate
	$(BIN)/python -m pytest scenarios/library/search_grid.yaml --sortie-set perception.detector=surrogate --sortie-set duration_s=30

fuzz: $(STAMP) ## try every reader with damaged inputs, ten minutes of processor time each (SECONDS_EACH=n, READER=name)
	$(BIN)/python tests/fuzz $(READER) --seconds $(SECONDS_EACH)

notebooks: $(STAMP) ## execute the notebooks (NOTEBOOKS=notebooks/name.ipynb for one)
	OMP_WAIT_POLICY=passive $(BIN)/python -m pytest -n auto --nbmake --nbmake-timeout=1200 $(NOTEBOOKS)

outputs: $(STAMP) ## execute the notebooks and keep their outputs, which the site shows (NOTEBOOK=name for one)
	$(BIN)/python docs/site/run_notebooks.py $(NOTEBOOK)

docs: $(STAMP) ## build the documentation site into build/site; a broken link, page or command fails
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[docs]'
	$(BIN)/python -m sphinx -W --keep-going -q -j auto -c docs/site . build/site
	$(BIN)/python -m pytest -q -m 'pages and not slow' tests/site

check: lint test ## lint, types, tests

nightly: ## run everything that CI leaves out because it is slow and rarely breaks (hours): before an issue is called resolved
	bash .ci/run nightly

format: $(STAMP) ## format and fix what can be fixed
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(STAMP) ## print what Sortie costs on one page, beside its peers and the last release (BENCH="--gradys PYTHON")
	$(BIN)/python -m research.validation.bench_page $(BENCH)

bench-all: $(STAMP) ## run every benchmark, ten minutes
	$(BIN)/python -m pytest tests/benchmarks --benchmark-enable --benchmark-only

research: $(STAMP) ## run the laboratory's commands: make research RUN='paper --frames 3'
	$(BIN)/python -m research $(RUN)

figures: $(STAMP) ## measure the pages' figures again, hours in all (FIGURE=name for one; FIGURE=--list, FIGURE=--render)
	$(BIN)/python -m research.validation.figures $(FIGURE)

validate-ns3: ns3 ## run the same plans through ns-3 and through the radio, and write the table of research/pages/radio.md (needs g++)
	$(BIN)/python -m research.validation.figures ns3

ns3: $(STAMP) ## install ns-3's wheel (Linux on x86-64; 450 MB)
	$(BIN)/python -m pip install --quiet --retries 1 -c constraints.txt -e '.[ns3]'

mavproxy: ## install the ground station MAVProxy in .venv-mavproxy, for its test
	test -x .venv-mavproxy/bin/python || $(PYTHON) -m venv .venv-mavproxy
	.venv-mavproxy/bin/python -m pip install --quiet --retries 1 MAVProxy

mutate: $(STAMP) ## change the code that decides figures in small ways, and count what no test notices (hours, can be resumed; MUTATE="--room fleet")
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[mutate]'
	$(BIN)/python -m research.validation.mutate $(MUTATE)

clean: ## remove runs and caches, keep .venv
	rm -rf runs .pytest_cache .mypy_cache .ruff_cache build *.egg-info
