# make demo: the main job, from nothing. make test: all tests but training. make help: the rest.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
PIP    := $(BIN)/python -m pip install --quiet --disable-pip-version-check
NATIVE := CMakeLists.txt $(shell find kernels/cpu runtime -name '*.[ch]' -o -name '*.cpp' -o -name 'CMakeLists.txt')
SHARED := $(firstword $(wildcard ../shared/data))

.PHONY: help setup demo test test-train lint bench soak model stubs clean
.DELETE_ON_ERROR:

help:
	@echo "make demo        simulated 20 Hz sensor through the upsampler, then a report with pictures"
	@echo "make test        set up, then all tests but training"
	@echo "make test-train  the tests that need PyTorch"
	@echo "make setup       build .venv; the command line is then $(BIN)/upbeam"
	@echo "make lint        style and types"
	@echo "make bench       kernel tests and benchmarks"
	@echo "make soak        the long runs (about 15 minutes)"
	@echo "make model       train the shipped model anew"
	@echo "make clean       remove everything built"

setup: $(VENV)/.installed
	@echo "ready: $(BIN)/upbeam"

$(VENV)/.tools: pyproject.toml
	@echo "== setting up $(VENV) (once; packages are downloaded)"
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10) and "upbeam needs Python 3.10 or newer, this is " + sys.version.split()[0])'
	@$(PYTHON) -m venv $(VENV) || { echo "no venv module: install python3-venv"; exit 1; }
	@$(PIP) "scikit-build-core>=0.11" "nanobind>=2.4" "cmake>=3.26" "ninja>=1.11"
	@touch $@

$(VENV)/.installed: $(VENV)/.tools $(NATIVE)
	@echo "== building the C runtime"
	@$(PIP) --no-build-isolation --editable .
	@touch $@

$(VENV)/.dev: $(VENV)/.installed
	@$(PIP) --no-build-isolation --editable ".[dev]"
	@touch $@

$(VENV)/.train: $(VENV)/.dev
	@echo "== installing PyTorch"
	@$(PIP) --no-build-isolation --editable ".[dev,train]"
	@touch $@

demo: $(VENV)/.installed
	@$(BIN)/upbeam stream --source sim --frames 200 --report build/demo

test: $(VENV)/.dev build/c/build.ninja
	@$(MAKE) --no-print-directory test-c
	$(BIN)/python -m pytest -m "not train"

build/c/build.ninja: $(VENV)/.tools CMakeLists.txt
	@$(BIN)/cmake -S . -B build/c -G Ninja -DCMAKE_MAKE_PROGRAM=$(abspath $(BIN))/ninja -DCMAKE_BUILD_TYPE=Release -DUPBEAM_TESTS=ON -DUPBEAM_WERROR=ON > build/c-configure.log 2>&1 || { cat build/c-configure.log; exit 1; }

.PHONY: test-c
test-c: build/c/build.ninja
	@$(BIN)/cmake --build build/c
	@$(BIN)/ctest --test-dir build/c --output-on-failure

test-train: $(VENV)/.train
	$(BIN)/python -m pytest -m train

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/clang-format --dry-run --Werror $$(git ls-files '*.c' '*.h' '*.cpp')
	$(BIN)/mypy -p upbeam
	$(BIN)/lint-imports

model: $(VENV)/.train
	$(BIN)/upbeam train --recipe default --out quant/models/default.ubm --evaluate $(SHARED)/kitti/frames

stubs: $(VENV)/.installed
	$(BIN)/python -m nanobind.stubgen -m upbeam.runtime._native -o runtime/_native.pyi

clean:
	rm -rf $(VENV) build dist
