# make demo: the main job, from nothing. make test: all tests but training. make help: the rest.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
PIP    := $(BIN)/python -m pip install --quiet --disable-pip-version-check
NATIVE := CMakeLists.txt $(shell find kernels/cpu runtime power/bench -name '*.[ch]' -o -name '*.cpp' -o -name 'CMakeLists.txt')
SHELL  := bash
SHARED := $(firstword $(wildcard ../shared/data))

.PHONY: help setup demo test test-c test-c-all test-train lint bench soak fpga dist model stubs accuracy clean
.DELETE_ON_ERROR:

help:
	@echo "make demo        simulated 20 Hz sensor through the upsampler, then a report with pictures"
	@echo "make test        set up, then all tests but training"
	@echo "make test-train  the tests that need PyTorch"
	@echo "make setup       build .venv; the command line is then $(BIN)/upbeam"
	@echo "make lint        style and types"
	@echo "make bench       kernels beside their bound, compilers and other runtimes (minutes)"
	@echo "make fpga        build the FPGA cores and renew their baselines (half an hour)"
	@echo "make soak        the long runs (about 50 minutes)"
	@echo "make model       train and quantise the shipped models anew"
	@echo "make accuracy    every method beside every other (trains what is not shipped: half an hour)"
	@echo "make clean       remove everything built"

setup: $(VENV)/.installed
	@echo "ready: $(BIN)/upbeam"

$(VENV)/.tools: pyproject.toml
	@echo "== setting up $(VENV) (once; packages are downloaded)"
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10) and "upbeam needs Python 3.10 or newer, this is " + sys.version.split()[0])'
	@$(PYTHON) -m venv $(VENV) || { echo "no venv module: install python3-venv"; exit 1; }
	@$(PIP) "scikit-build-core>=0.11" "nanobind>=2.4" "cmake>=3.26" "ninja>=1.11" "setuptools>=70.1" # the last: of packages without a wheel (cobs)
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

test: $(VENV)/.dev test-c
	$(BIN)/python -m pytest -m "not train" --numprocesses auto --dist loadfile

# $(call c_tests,FOLDER,CMAKE OPTIONS,CTEST OPTIONS): configure, build, run one variant of the C tests.
CMAKE := $(abspath $(BIN))/cmake
define c_tests
	@mkdir -p build
	@$(CMAKE) -S . -B build/$(1) -G Ninja -DCMAKE_MAKE_PROGRAM=$(abspath $(BIN))/ninja -DUPBEAM_TESTS=ON -DUPBEAM_WERROR=ON $(2) \
		> build/$(1).log 2>&1 && $(CMAKE) --build build/$(1) >> build/$(1).log 2>&1 || { tail -40 build/$(1).log; exit 1; }
	@echo "== C tests: $(1)"
	@$(abspath $(BIN))/ctest --test-dir build/$(1) --output-on-failure $(3) | grep -v "Start \|^Internal\|^$$" ; exit $${PIPESTATUS[0]}
endef

test-c: $(VENV)/.tools
	$(call c_tests,c,-DCMAKE_BUILD_TYPE=Release)

test-c-all: $(VENV)/.tools
	$(call c_tests,c-sanitize,-DCMAKE_BUILD_TYPE=RelWithDebInfo -DUPBEAM_SANITIZE=ON)
	$(call c_tests,c-thread,-DCMAKE_BUILD_TYPE=RelWithDebInfo -DCMAKE_C_FLAGS=-fsanitize=thread,-R "live|stream|upbeamd")
	$(call c_tests,c-clang,-DCMAKE_BUILD_TYPE=Release -DCMAKE_C_COMPILER=clang)
	$(call c_tests,c-aarch64,-DCMAKE_BUILD_TYPE=Release -DCMAKE_TOOLCHAIN_FILE=runtime/cmake/aarch64.cmake)

test-train: $(VENV)/.train
	$(BIN)/python -m pytest -m train

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/clang-format --dry-run --Werror $$(git ls-files '*.c' '*.h' '*.cpp')
	$(BIN)/mypy -p upbeam
	$(BIN)/lint-imports

# Networks are trained, then quantised on simulated frames; the same commands give the same bytes.
MODELS := default:hdl-64e hidden-8:hdl-64e-8 hidden-6:hdl-64e-6 hdl-32e:hdl-32e vlp-32c:vlp-32c
model: $(VENV)/.train
	@mkdir -p build/model
	@set -e; for pair in $(MODELS); do recipe=$${pair%%:*}; name=$${pair##*:}; \
		$(BIN)/upbeam train --recipe $$recipe --out build/model/$$name.ubm; \
		cp build/model/$$name.csv quant/models/; \
		$(BIN)/upbeam quantize build/model/$$name.ubm -o quant/models/$$name.ubm; done

$(VENV)/.bench: $(VENV)/.dev
	@echo "== installing the peers of the benchmark"
	@$(PIP) --no-build-isolation --editable ".[dev,bench]"
	@touch $@

bench: test-c $(VENV)/.bench
	build/c/tests/kernels/checkkernels --bench --model quant/models/hdl-64e.ubm
	$(BIN)/upbeam bench --report build/bench
	$(BIN)/upbeam estimate --validate-cpu

# What takes minutes: millions of damaged model files, packets and serial bytes, every scenario with every check taken out, ten minutes of
# packets through upbeamd, ten minutes of frames in real time.
soak: test-c $(VENV)/.dev
	build/c/tests/runtime/c/test_model --count 1000000
	build/c/tests/runtime/c/test_stream --count 20000
	build/c/tests/runtime/packets/fuzz_packets --count 10000000
	build/c/runtime/bus/tests/test_bus_fuzz --count 10000000
	build/c/runtime/daemon/test_daemon --count 10000000
	$(BIN)/upbeam hil run --sabotage
	$(BIN)/python tests/runtime/daemon/soak_upbeamd.py --seconds 600
	$(BIN)/upbeam stream --frames 12000 --report build/soak

# Synthesis, place and route of every core in hw_sim/fpga/baselines.json (half an hour); what is unchanged is kept.
fpga: $(VENV)/.dev
	$(BIN)/python -m upbeam.hw_sim.fpga.baselines build/fpga

dist: $(VENV)/.dev
	@rm -rf build/dist build/dist-venv
	@$(BIN)/python -m build --outdir build/dist . > build/dist.log 2>&1 || { tail -40 build/dist.log; exit 1; }
	@$(PYTHON) -m venv build/dist-venv
	@build/dist-venv/bin/python -m pip install --quiet --disable-pip-version-check build/dist/*.whl
	@cd build && dist-venv/bin/upbeam doctor --json > dist-doctor.json && dist-venv/bin/upbeam stream --frames 5 --clock virtual --json > /dev/null
	@ls -l build/dist | awk 'NR > 1 { print $$NF ": " $$5 " bytes" }'

stubs: $(VENV)/.installed
	$(BIN)/python -m nanobind.stubgen -m upbeam.runtime._native -o runtime/_native.pyi
	$(BIN)/python -m nanobind.stubgen -m upbeam.runtime.bus._bus -o runtime/bus/_bus.pyi
	$(BIN)/ruff check --quiet --select I --fix runtime/bus/_bus.pyi && $(BIN)/ruff format --quiet runtime/bus/_bus.pyi
	$(BIN)/python -m nanobind.stubgen -m upbeam.runtime.packets._packets -o runtime/packets/_packets.pyi
	$(BIN)/python -m nanobind.stubgen -m upbeam.runtime.daemon._daemon -o runtime/daemon/_daemon.pyi
	$(BIN)/ruff check --quiet --fix runtime/daemon/_daemon.pyi && $(BIN)/ruff format --quiet runtime/daemon/_daemon.pyi

clean:
	rm -rf $(VENV) build dist

# Every method beside every other: trains what is not shipped (once), then prints the tables of docs/accuracy.md.
DATA     := $(or $(UPBEAM_DATA),$(SHARED))
FRAMES   := $(wildcard $(DATA)/kitti/frames)
TRAINED  := build/accuracy/$(if $(FRAMES),kitti,simulated)
BESIDE    = --with $(TRAINED)/paper-ring.ubm --with $(TRAINED)/shan-small.pt

$(TRAINED)/%.ubm: model/recipes/%.yaml | $(VENV)/.train
	@mkdir -p $(@D)
	UPBEAM_DATA=$(DATA) $(BIN)/upbeam train --recipe $* --out $@ $(if $(FRAMES),,--simulated 16)

$(TRAINED)/%.pt: model/recipes/%.yaml | $(VENV)/.train
	@mkdir -p $(@D)
	UPBEAM_DATA=$(DATA) $(BIN)/upbeam train --recipe $* --out $@ $(if $(FRAMES),,--simulated 16)

accuracy: $(TRAINED)/paper-ring.ubm $(TRAINED)/shan-small.pt $(if $(FRAMES),$(TRAINED)/paper-small.ubm)
ifneq ($(FRAMES),)
	$(BIN)/upbeam evaluate $(FRAMES) --drive drive-a $(BESIDE)
	$(BIN)/upbeam evaluate $(FRAMES) --drive drive-a --rows elevation $(BESIDE) --with $(TRAINED)/paper-small.ubm
else
	$(BIN)/upbeam evaluate sim --frames 10 $(BESIDE)
endif
