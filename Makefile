# Every target works on a bare machine with Python 3.11, 3.12 or 3.13 and make.
PYTHON ?= $(firstword $(foreach v,3.11 3.12 3.13,$(shell command -v python$(v))) python3.11)
VENV := .venv
BIN := $(VENV)/bin
LEROBOT := tests/benchmarks/lerobot
LEROBOT_VENV ?= .venv-lerobot
OPENPI_VENV ?= .venv-openpi
LEROBOT_POLICY_VENV ?= .venv-lerobot-policy
API_CLIENT_VENV ?= .venv-api-client
RAY_VENV ?= .venv-ray
STAGE ?= store loader acquisition clocks calibration retargeting teleoperation alignment closure twin world-model starts objects evaluator agreement rollouts
MADE := runs/reproduce
DOCS_VENV ?= .venv-docs
SITE := build/docs
export OMP_NUM_THREADS ?= 1

SCREENS ?= build/screens
.PHONY: demo test test-long check slow from-recordings browser screens kills vm containers fuzz mutants fix clean docs bench gpu stress bench-lerobot check-lerobot-export check-lerobot-policy check-openpi check-api-client check-ray check-environments check-zarr-readers wheel-test vendor release \
	reproduce reproduce-checkpoints
.DEFAULT_GOAL := demo

$(VENV)/.runtime: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[all]'
	touch $@

# aiowuji contains the manufacturer's hand model, for tests; --no-deps, since they include a driver with telemetry.
$(VENV)/.dev: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt --no-deps aiowuji
	touch $@ $(VENV)/.runtime

demo: $(VENV)/.runtime   ## record, align, predict and evaluate on this machine
	$(BIN)/dextouch demo

# Bytecode is cached, since tests start many processes that would otherwise each compile all modules.
test: $(VENV)/.dev       ## the default test run
	PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -q -n logical --dist loadfile

test-long: $(VENV)/.dev  ## whole services, pages, trainings and benchmarks in small
	PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -q -m "long and not slow" -n logical --dist loadfile

screens: $(VENV)/.dev    ## pictures of every screen of the dashboard in build/screens, at 1366 and 1920 px, light and dark
	mkdir -p $(SCREENS)
	DEXTOUCH_SCREENS=$(SCREENS) $(BIN)/python -m pytest -q -m "slow or not slow" tests/browser/test_screens.py

slow: $(VENV)/.dev       ## the long tests
	$(BIN)/python -m pytest -q -m slow

from-recordings: $(VENV)/.dev   ## a lab's way without a simulation: record, train world model, judge and policy, score; docs/tutorials/from_recordings.md
	$(BIN)/python -m pytest -q -s -m slow tests/integration/test_from_recordings.py

browser: $(VENV)/.dev    ## all tests of the pages, in Chromium; apt-get install chromium
	$(BIN)/python -m pytest -q -m "slow or not slow" tests/browser $(ARGS)

wheel-test: $(VENV)/.dev   ## build the wheel, install it outside the checkout, run its demo and its services
	$(BIN)/python -m pytest -q -m slow tests/system/test_wheel.py

kills: $(VENV)/.dev      ## kill -9 one of two workers 20 times while 16 rollouts run; apt-get install redis-server haproxy
	$(BIN)/python -m pytest -q -s -m slow tests/system/test_worker_kills.py

vm: $(VENV)/.dev         ## real drivers on a Debian kernel's devices; apt-get install qemu-system-x86 busybox-static cpio kmod
	$(BIN)/python -m pytest -q -s -m vm tests/vm

# Keep the images for the next run (then seconds instead of minutes): DEXTOUCH_CONTAINERS=FOLDER make containers
containers: $(VENV)/.dev   ## build both images and run the compose file from them, as root without a daemon; 10 GB; docs/images.md
	$(BIN)/python -m pytest -q -m containers tests/containers $(ARGS)

fuzz: $(VENV)/.dev       ## fuzz glove packets, guided by coverage, then requests to all services; ARGS="--seconds 600"
	PYTHONPATH=.:shared $(BIN)/python -m tests.fuzz.mutate $(ARGS)
	$(BIN)/python -m pytest -q -m slow tests/integration/test_openapi_conformance.py

mutants: $(VENV)/.dev    ## plant known bugs one at a time and count those that a test detects; ARGS="--area geometry"
	PYTHONPATH=.:shared $(BIN)/python -m tests.mutants.run $(ARGS)

check: $(VENV)/.dev      ## format, lint, types, import contracts
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy -p dextouch -p services -p benchmarks
	PYTHONPATH=.:shared $(BIN)/lint-imports

bench: $(VENV)/.dev      ## measure time and error of each stage; STAGE=clocks ARGS="--quick" for one
	@missed=; for stage in $(STAGE); do echo "== $$stage"; \
	$(BIN)/python -m benchmarks $$stage --out runs/bench $(ARGS) || missed="$$missed $$stage"; done; \
	if [ -n "$$missed" ]; then echo "make bench: failed:$$missed" >&2; exit 1; fi

gpu: $(VENV)/.dev        ## train and serve the full size with random weights on one CUDA card, in minutes; needs torch for CUDA
	$(BIN)/python -m benchmarks gpu --out runs/gpu $(ARGS)

stress: $(VENV)/.dev     ## check every stage against numerical hazards; ARGS="--quick", or names of stages
	$(BIN)/python -m benchmarks stress $(ARGS)

reproduce: $(VENV)/.runtime   ## the paper's tables in miniature, in runs/reproduction; some hours; ARGS="design --list"; docs/reproduction.md
	$(BIN)/python -m benchmarks reproduction $(ARGS)

# Run again to resume after an interruption. The last step reports which bounds are met and which figures match docs/evaluator.json.
reproduce-checkpoints: $(VENV)/.runtime   ## record data, train the package's state model and cloned policies, calibrate its judge, and measure them, in runs/reproduce
	$(BIN)/dextouch train data --store $(MADE)/train --count 800 --images 4 --varied 0.7 --resized 0.2
	$(BIN)/dextouch train data --store $(MADE)/judge --first 1000 --count 250 --images 4 --varied 0.7 --resized 0.4
	$(BIN)/dextouch train data --store $(MADE)/kinds --mix development --first 21000 --count 180 --images 4 --resized 0.4
	$(BIN)/dextouch train data --store $(MADE)/development --mix ladder --first 20000 --count 144 --images 4
	$(BIN)/dextouch train world-model --episodes $(MADE)/train --output $(MADE)/cores.safetensors --jobs 3
	$(BIN)/dextouch train world-model --init $(MADE)/cores.safetensors --learn success --episodes $(MADE)/judge \
		--core.num-steps 1200 --output $(MADE)/state.safetensors
	$(BIN)/dextouch train imagined --episodes $(MADE)/development --store $(MADE)/imagined_development \
		--checkpoint $(MADE)/state.safetensors
	$(BIN)/dextouch train imagined --episodes $(MADE)/kinds --store $(MADE)/imagined_development \
		--checkpoint $(MADE)/state.safetensors
	$(BIN)/dextouch train judge --base services/evaluation/pretrained/success_probe.safetensors \
		--episodes $(MADE)/kinds,$(MADE)/development,$(MADE)/imagined_development \
		--output $(MADE)/success_probe.safetensors
	$(BIN)/dextouch train data --store $(MADE)/exact --mix exact --first 700 --count 50 --images 8
	$(BIN)/dextouch train policy --episodes $(MADE)/train --episodes $(MADE)/exact --early-at 0.1 \
		--training.num-training-steps 3600 --training.max-cpu-s 150 --output $(MADE)/cloned.safetensors
	$(BIN)/python -m benchmarks evaluator --world $(MADE)/state.safetensors --probe $(MADE)/success_probe.safetensors \
		--cloned cloned=$(MADE)/cloned.safetensors --cloned "cloned early=$(MADE)/cloned_early.safetensors" \
		--kinds none --first-seed 30020 --starts 5 --repeats docs/evaluator.json --keep $(MADE)/evaluator --out $(MADE)/bench

fix: $(VENV)/.dev        ## format the code and apply automatic lint fixes
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

release: $(VENV)/.dev    ## make a release: VERSION=0.2.0 writes version and changelog, builds the wheels in dist, commits and tags
	$(BIN)/python deploy/release.py $(VERSION)

vendor:                  ## fetch the vendored files of the pages again (needs npm); git diff shows whether they changed
	$(PYTHON) deploy/fetch_vendored.py services/dashboard/static/vendor
	$(PYTHON) deploy/fetch_vendored.py shared/dextouch/serving/static/vendor

$(LEROBOT_VENV)/.complete: $(LEROBOT)/make_venv.sh $(LEROBOT)/requirements.txt $(LEROBOT)/prepare.py
	PYTHON=$(PYTHON) $(LEROBOT)/make_venv.sh $(LEROBOT_VENV)

bench-lerobot: $(LEROBOT_VENV)/.complete   ## opt-in: compare our store with LeRobotDataset v3; ARGS="--rounds 5"
	$(LEROBOT_VENV)/bin/python $(LEROBOT)/bench.py --out runs/bench_lerobot $(ARGS)

check-lerobot-export: $(LEROBOT_VENV)/.complete   ## opt-in: check that lerobot itself opens our exports, and we what it writes
	$(LEROBOT_VENV)/bin/python $(LEROBOT)/check_export.py
	$(LEROBOT_VENV)/bin/python $(LEROBOT)/check_import.py

$(OPENPI_VENV)/.complete:
	$(PYTHON) -m venv $(OPENPI_VENV)
	$(OPENPI_VENV)/bin/pip install --quiet --disable-pip-version-check openpi-client==0.1.2 'websockets>=13' typing_extensions
	touch $@

check-openpi: $(VENV)/.dev $(OPENPI_VENV)/.complete   ## opt-in: check interoperability with openpi's own client and packing
	$(BIN)/python tests/system/openpi/check.py $(OPENPI_VENV)/bin/python

$(API_CLIENT_VENV)/.complete:
	$(PYTHON) -m venv $(API_CLIENT_VENV)
	$(API_CLIENT_VENV)/bin/pip install --quiet --disable-pip-version-check openapi-python-client==0.29.1
	touch $@

check-api-client: $(VENV)/.dev $(API_CLIENT_VENV)/.complete   ## opt-in: generate clients of all services by their OpenAPI documents, and run a rollout with one
	PYTHONPATH=.:shared $(BIN)/python -m tests.system.api_client.check $(abspath $(API_CLIENT_VENV))/bin/python

check-zarr-readers: $(VENV)/.dev   ## opt-in: list and read an episode with zarr-python, xarray and tensorstore in environments without this package; ARGS="--python python3.13"
	PYTHONPATH=.:shared $(BIN)/python tests/system/zarr_readers/check.py $(ARGS)

$(LEROBOT_POLICY_VENV)/.complete:
	$(PYTHON) -m venv $(LEROBOT_POLICY_VENV)
	$(LEROBOT_POLICY_VENV)/bin/pip install --quiet --disable-pip-version-check '.[lerobot]'
	touch $@

check-lerobot-policy: $(VENV)/.dev $(LEROBOT_POLICY_VENV)/.complete   ## opt-in: compare a served LeRobot policy with LeRobot's own control loop (8 GB)
	$(BIN)/python tests/system/lerobot/check.py $(LEROBOT_POLICY_VENV)/bin/python

$(RAY_VENV)/.complete: pyproject.toml
	$(PYTHON) -m venv $(RAY_VENV)
	$(RAY_VENV)/bin/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[scale,twin]' psutil pytest
	touch $@

check-ray: $(RAY_VENV)/.complete   ## opt-in: kill replicas of a local Ray Serve deployment while rollouts run, and workers of a cluster while takes are recorded; 600 MB; apt-get install redis-server
	RAY_SERVE_PROXY_READY_CHECK_TIMEOUT_S=60 PYTHONPATH=.:shared $(RAY_VENV)/bin/python -m tests.system.ray_serve.check $(ARGS)
	PYTHONPATH=.:shared $(RAY_VENV)/bin/python -m tests.system.ray_jobs.check

# The site reads the docstrings of dextouch and needs neither torch nor mujoco, so it has an environment of its own.
$(DOCS_VENV)/.complete: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(DOCS_VENV)
	$(DOCS_VENV)/bin/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[docs]'
	touch $@

docs: $(DOCS_VENV)/.complete   ## build the documentation site in build/docs; warnings are errors
	$(DOCS_VENV)/bin/python -m sphinx --builder html --fresh-env --write-all --fail-on-warning --quiet docs $(SITE)
	@echo "open $(SITE)/index.html"

check-environments:      ## opt-in: install the package beside LeRobot and with the oldest and newest packages of its ranges, for several Pythons; needs uv (pip install uv); 10 GB; ARGS="store" for some
	$(PYTHON) tests/environments/check.py $(ARGS)

clean:
	rm -rf $(SITE) demo .pytest_cache .mypy_cache .ruff_cache .import_linter_cache
