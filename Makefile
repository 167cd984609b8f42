# make demo | make test are all that a bare clone needs. What they do first is in tools/setup.sh.

SHELL := /bin/sh
.DEFAULT_GOAL := help
.PHONY: help setup demo test lint docs bench online endurance validation precision convergence bags clean
.NOTPARALLEL:

RUN := .venv/bin/python

help:
	@echo 'make demo    calibrate the recorded rig in bags/, with real ROS 2 nodes (sets up first)'
	@echo 'make test    run all tests (sets up first)'
	@echo 'make lint    ruff, mypy and the import contracts (the tests run them too)'
	@echo 'make docs    the documentation with the API reference, into docs/_build/html'
	@echo 'make setup   make or refresh .venv: packages, ROS 2, messages; nothing is done twice'
	@echo 'make bench   run the benchmarks'
	@echo 'make online  the nodes at lab rates beside relays that do nothing, points in space, images (10 minutes)'
	@echo 'make endurance   an hour of the stream, faster than real time: counts and memory (15 minutes)'
	@echo 'make validation  the experiment of the paper, and more, against the truth: docs/accuracy.md (10 minutes)'
	@echo 'make precision   errors of 200 simulated calibrations over what is claimed: docs/precision.md (5 minutes)'
	@echo 'make convergence 200 random rigs with bad start values: docs/convergence.md (15 minutes)'
	@echo 'make bags    write the bags in bags/ anew'
	@echo 'make clean   delete .venv, .build and caches'
	@echo
	@echo 'PYTHON=python3.12 make setup   chooses the Python (3.10 to 3.13)'
	@echo 'make test ARGS="-k simulation" hands arguments on (also to demo, bench, bags)'

setup:
	@sh tools/setup.sh

demo: setup
	@.venv/bin/fluoro_calib_demo $(ARGS)

test: setup
	@$(RUN) -m pytest tests $(ARGS)

lint: setup
	@.venv/bin/ruff check .
	@.venv/bin/ruff format --check .
	@.venv/bin/mypy
	@.venv/bin/lint-imports

docs: setup
	@$(RUN) -m sphinx -W --keep-going -q -b html docs docs/_build/html
	@echo 'docs/_build/html/index.html'

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

bags: setup
	@.venv/bin/fluoro-calib simulate --out bags $(ARGS)

clean:
	rm -rf .venv .build demo_result .pytest_cache .mypy_cache .ruff_cache docs/_build *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
