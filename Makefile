# A bare clone needs only make demo and make test. tools/setup.sh installs what they require.

SHELL := /bin/sh
.DEFAULT_GOAL := help
.PHONY: help setup demo test oldest lint docs fuzz lock audit bench online endurance validation precision convergence pathologies real-data bags bag-readers faults mutants clean
.NOTPARALLEL:

# Many tests start commands; without bytecode on disk each compiles what it loads.
unexport PYTHONDONTWRITEBYTECODE

RUN := .venv/bin/python
# processes that run tests: one more than two cores, for tests of nodes wait most of the time
WORKERS ?= 3
# of fuzzing, for each target
SECONDS ?= 600
OLDEST_PYTHON ?= python3.12

help:
	@echo 'make demo         calibrate, correct and reconstruct the recorded rig in bags/ over real ROS 2 nodes'
	@echo 'make test         run all tests'
	@echo 'make oldest       run the tests that need no ROS with the oldest supported versions of all packages'
	@echo 'make lint         run ruff, mypy and the import contracts (also part of the tests)'
	@echo 'make docs         build the documentation and the API reference in docs/_build/html'
	@echo 'make fuzz         fuzz every reader with atheris, SECONDS=600 each: docs/reliability.md'
	@echo 'make lock         resolve requirements.in into requirements.lock, with hashes'
	@echo 'make audit        compare requirements.lock with known vulnerabilities (needs pypi.org or osv.dev)'
	@echo 'make setup        create or update .venv: packages, ROS 2 and messages; demo, test, ... run it first'
	@echo 'make bench        run the benchmarks and write docs/how_good/speed.md'
	@echo 'make online       benchmark the nodes at lab rates against relays, points in space and images (10 min)'
	@echo 'make endurance    stream one hour of data faster than real time: frame counts and memory (15 min)'
	@echo 'make validation   repeat and extend the experiment of the paper: docs/how_good/accuracy.md (10 min)'
	@echo 'make precision    compare errors of 200 simulations with their standard deviations: docs/how_good.md (3 min)'
	@echo 'make convergence  calibrate 200 random rigs with poor start values: docs/how_good.md (5 min)'
	@echo 'make pathologies  calibrate rigs unlike the virtual rig: docs/how_good/pathologies.md (30 min)'
	@echo 'make real-data    calibrate public data of real cameras: docs/how_good/real_data.md (downloads 4 MB, 30 min)'
	@echo 'make bags         regenerate the bags in bags/'
	@echo 'make bag-readers  read bags of all kinds with mcap, rosbags and the npm packages of Foxglove (needs npm)'
	@echo 'make faults       kill, interrupt and cut off programs, damage bags, join hosts: docs/reliability.md (2 h)'
	@echo 'make mutants      put single bugs into the code and count those that the quick tests catch, by room (1 h)'
	@echo 'make clean        delete .venv, .build and caches'
	@echo
	@echo 'PYTHON=python3.12 make setup        selects the Python version (3.10 to 3.13)'
	@echo 'make test ARGS="-k simulation"      passes arguments on (also for bags, bench, demo, ...)'

setup:
	@sh tools/setup.sh

demo: setup
	@.venv/bin/fluoro_calib_demo $(ARGS)

test: setup
	@$(RUN) -m pytest tests -n $(WORKERS) --dist loadfile $(ARGS)

oldest:
	@$(OLDEST_PYTHON) -m venv .oldest
	@.oldest/bin/python -m pip install --quiet --requirement requirements-oldest.txt
	@.oldest/bin/python -m pytest tests -n $(WORKERS) --dist loadfile \
	    --ignore tests/ros --ignore tests/nodes --ignore tests/test_lint.py \
	    --ignore tests/test_packaging.py \
	    --deselect tests/io/test_points.py::test_trc_is_read_by_opensim -m "not long and not ros" $(ARGS)

lint: setup
	@.venv/bin/ruff check .
	@.venv/bin/ruff format --check .
	@.venv/bin/mypy
	@.venv/bin/lint-imports

docs: setup
	@$(RUN) -m sphinx -W --keep-going -q -b html docs docs/_build/html
	@echo 'docs/_build/html/index.html'

# atheris is no part of the lock: it is there for Linux and some Pythons only.
fuzz: setup
	@$(RUN) -c 'import importlib.util, sys; sys.path.insert(0, ".fuzz/packages"); sys.exit(importlib.util.find_spec("atheris") is None)' \
	    || $(RUN) -m pip install --quiet --target .fuzz/packages atheris==3.0.0
	@PYTHONPATH=.fuzz/packages $(RUN) -m fuzz all $(SECONDS) $(ARGS)

lock: setup
	@sh tools/lock.sh $(ARGS)

audit: setup
	@sh tools/audit.sh

bench: setup
	@$(RUN) -m benchmarks $(ARGS)

online: setup
	@$(RUN) -m benchmarks.online $(ARGS)
	@$(RUN) -m benchmarks.reconstruction
	@$(RUN) -m benchmarks.images

endurance: setup
	@$(RUN) -m benchmarks.endurance $(ARGS)

validation: setup
	@$(RUN) -m benchmarks.validation $(ARGS)

precision: setup
	@$(RUN) -m benchmarks.precision $(ARGS)

convergence: setup
	@$(RUN) -m benchmarks.convergence $(ARGS)

pathologies: setup
	@$(RUN) -m benchmarks.pathologies.run $(ARGS)

real-data: setup
	@$(RUN) -m benchmarks.real_data --download $(ARGS)

bags: setup
	@.venv/bin/fluoro-calib simulate --out bags $(ARGS)

bag-readers: setup
	@cd tools/bag_readers && npm install --no-audit --no-fund --silent
	@$(RUN) tools/bag_readers/read_bags.py $(ARGS)

faults: setup
	@$(RUN) -m benchmarks.faults $(ARGS)

mutants: setup
	@$(RUN) -m tools.mutants $(ARGS)

clean:
	rm -rf .venv .oldest .fuzz .audit .build demo_result .pytest_cache .mypy_cache .ruff_cache docs/_build *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
