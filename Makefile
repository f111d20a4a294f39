# The two commands for a fresh machine are `make demo` and `make test`. All of them make their own
# virtual environments; PYTHON chooses the interpreter (3.10 or newer).
PYTHON ?= python3
SOURCES := $(shell find core bindings python -type f -not -path '*/__pycache__/*' -not -name '_*.pyi') \
           CMakeLists.txt pyproject.toml constraints.txt
BENCH := $(shell find benchmarks -type f -not -path '*/__pycache__/*' \
  -not -path 'benchmarks/build/*' -not -path 'benchmarks/results/*')
CPP := $(shell find core bindings -name '*.cpp' -o -name '*.h') benchmarks/ceilings.cpp
JOBS := $(shell nproc 2>/dev/null || echo 2)
cmake = $(1)/bin/cmake -G Ninja -DCMAKE_MAKE_PROGRAM=$(abspath $(1)/bin/ninja) -DCMAKE_BUILD_TYPE=Release
export PIP_DISABLE_PIP_VERSION_CHECK = 1

.PHONY: help demo bench test test-python test-ray test-cpp test-cpp-bridges test-arm sanitize sanitize-memory sanitize-threads \
  sanitize-python-memory sanitize-python-threads coverage fuzz torture check docs format clean
help:
	@echo "make demo      run the main job on the sample that ships"
	@echo "make bench     measure speed beside peers (BENCH_OPTIONS='--scale quick')"
	@echo "make test      run the tests (C++ and Python)"
	@echo "make test-ray  run the tests of builds and replicas on a Ray cluster"
	@echo "make test-cpp-bridges  run the C++ tests and examples that need OpenCV and Eigen"
	@echo "make test-arm  run the C++ tests for 64-bit ARM under qemu-user"
	@echo "make sanitize  run the tests of the core under sanitizers (memory, undefined behaviour, threads)"
	@echo "make coverage  print the lines of the core that its C++ tests run"
	@echo "make fuzz      feed mutated files to every reader of the core (FUZZ_SECONDS=60 each)"
	@echo "make torture   kill savers, fill disks (KILLS=600)"
	@echo "make check     formatting, lint and types of both languages, links of the docs"
	@echo "make docs      build the site of the docs into build/site"
	@echo "make format    rewrite sources in the project's format"

demo: .venv/installed
	.venv/bin/protomark demo

# The peers are large: they have an environment of their own.
BENCH_OPTIONS ?=
bench: .venv-bench/installed
	.venv-bench/bin/protomark bench $(BENCH_OPTIONS)

test: test-cpp test-python

# One thread each, as there is a process for each core; a file's tests share what they made.
test-python: .venv-test/installed .venv-test/bench
	OMP_NUM_THREADS=1 .venv-test/bin/python -m pytest -n $(JOBS) --dist loadfile

# Distributed builds and replicas on a Ray cluster of this machine.
test-ray: .venv-ray/installed
	OMP_NUM_THREADS=1 .venv-ray/bin/python -m pytest tests/test_distributed_ray.py \
	  tests/test_serving_shards.py 'tests/test_docs.py::test_blocks_run[city.md]'

test-cpp: .venv-test/installed
	$(call cmake,.venv-test) -S core -B build/core -DPROTOMARK_BUILD_TESTS=ON \
	  -DPROTOMARK_TEST_BRIDGES=OFF -DCMAKE_DISABLE_FIND_PACKAGE_OpenCV=ON > /dev/null
	.venv-test/bin/cmake --build build/core -j$(JOBS)
	.venv-test/bin/ctest --test-dir build/core --output-on-failure
	# The installed library, as another project finds it.
	.venv-test/bin/cmake --install build/core --prefix build/prefix > /dev/null
	$(call cmake,.venv-test) -S core/examples -B build/consumer \
	  -DCMAKE_PREFIX_PATH=$(abspath build/prefix) -DCMAKE_DISABLE_FIND_PACKAGE_OpenCV=ON > /dev/null
	.venv-test/bin/cmake --build build/consumer
	.venv-test/bin/ctest --test-dir build/consumer --output-on-failure

# protomark/opencv.h and protomark/eigen.h, and the examples with OpenCV's PnP.
test-cpp-bridges: .venv-test/installed
	@pkg-config --exists opencv4 eigen3 || { \
	  echo "make test-cpp-bridges needs: apt-get install libopencv-dev libeigen3-dev"; exit 1; }
	$(call cmake,.venv-test) -S core -B build/core -DPROTOMARK_BUILD_TESTS=ON \
	  -DPROTOMARK_TEST_BRIDGES=ON -DCMAKE_DISABLE_FIND_PACKAGE_OpenCV=OFF > /dev/null
	.venv-test/bin/cmake --build build/core -j$(JOBS) --target test_opencv test_eigen 04_relocalize
	.venv-test/bin/ctest --test-dir build/core --output-on-failure \
	  -R '^(opencv|eigen|example_04_relocalize)$$'

# 64-bit ARM, NEON included, by Debian's cross compiler and qemu-user.
test-arm: .venv-test/installed
	@command -v aarch64-linux-gnu-g++ >/dev/null && command -v qemu-aarch64 >/dev/null || { \
	  echo "make test-arm needs: apt-get install g++-aarch64-linux-gnu qemu-user"; exit 1; }
	$(call cmake,.venv-test) -S core -B build/arm -DPROTOMARK_BUILD_TESTS=ON \
	  -DCMAKE_TOOLCHAIN_FILE=aarch64-linux.cmake > /dev/null
	.venv-test/bin/cmake --build build/arm -j$(JOBS)
	.venv-test/bin/ctest --test-dir build/arm --output-on-failure

# The C++ tests under each set of sanitizers, then the Python tests that need none of the larger
# packages, each in a module that was built with it.
comma := ,
sanitizers = -g -O1 -fno-omit-frame-pointer -fno-sanitize-recover=all -fsanitize=$(1)
memory := $(call sanitizers,address$(comma)undefined)
threads := $(call sanitizers,thread)
CORE_TESTS := $(addprefix tests/test_,among.py appearances.py appearances_sealed.py cli.py compact_maps.py encoder.py evaluation_protocol.py example_reader.py \
  features.py files.py hamming.py index.py journal.py limits.py map_file.py \
  metadata.py mutated_maps.py mutated_tracks.py prototypes.py sealed_sections.py sharing.py \
  tracks_file.py training_sampling.py)
sanitize: sanitize-memory sanitize-threads sanitize-python-memory sanitize-python-threads

# Python itself was built without them, so the sanitizer's library has to come first.
library = $(shell $(CXX) -print-file-name=$(1))
runtime-memory := libasan.so
runtime-threads := libtsan.so
sanitize-python-memory sanitize-python-threads: sanitize-python-%: build/sanitize-python/%/installed
	LD_PRELOAD="$(call library,$(runtime-$*)) $(call library,libstdc++.so)" \
	ASAN_OPTIONS=detect_leaks=0 \
	PYTHONPATH=$(dir $<)packages \
	  .venv-sanitize/bin/python -m pytest -p no:cacheprovider $(CORE_TESTS)

# Without most of what the package needs: these tests do not.
build/sanitize-python/%/installed: $(SOURCES) .venv-sanitize/tools
	.venv-sanitize/bin/pip install --quiet -c constraints.txt scikit-build-core nanobind numpy \
	  safetensors rich typer hypothesis pytest
	.venv-sanitize/bin/pip install --quiet --upgrade --target $(@D)/packages \
	  --no-deps --no-build-isolation . -C build-dir=$(@D)/build -C cmake.build-type= \
	  -C cmake.define.PROTOMARK_BUILD_STUBS=OFF -C cmake.define.CMAKE_CXX_FLAGS="$($*)"
	touch $@

sanitize-memory sanitize-threads: sanitize-%: .venv-sanitize/tools
	$(call cmake,.venv-sanitize) -S core -B build/sanitize-$* -DPROTOMARK_BUILD_EXAMPLES=OFF \
	  -DCMAKE_BUILD_TYPE= -DCMAKE_CXX_FLAGS="$($*)" > /dev/null
	.venv-sanitize/bin/cmake --build build/sanitize-$* -j$(JOBS)
	.venv-sanitize/bin/ctest --test-dir build/sanitize-$* --output-on-failure

coverage: .venv-sanitize/tools
	$(call cmake,.venv-sanitize) -S core -B build/coverage -DPROTOMARK_BUILD_EXAMPLES=OFF \
	  -DCMAKE_BUILD_TYPE= -DCMAKE_CXX_FLAGS="-O1 --coverage -fprofile-update=atomic" > /dev/null
	.venv-sanitize/bin/cmake --build build/coverage -j$(JOBS)
	find build/coverage -name '*.gcda' -delete
	.venv-sanitize/bin/ctest --test-dir build/coverage --output-on-failure
	.venv-sanitize/bin/gcovr --root core --filter core/src --filter core/include \
	  --gcov-ignore-parse-errors=suspicious_hits.warn_once_per_file \
	  --exclude-throw-branches --fail-under-line 90 build/coverage

FUZZ_SECONDS ?= 60
CLANG ?= clang++
fuzz: .venv-sanitize/tools
	@command -v $(CLANG) > /dev/null || { \
	  echo "make fuzz needs clang with libFuzzer: apt-get install clang llvm, or set CLANG"; exit 1; }
	$(call cmake,.venv-sanitize) -S core -B build/fuzz -DPROTOMARK_BUILD_FUZZERS=ON \
	  -DPROTOMARK_BUILD_TESTS=OFF -DPROTOMARK_BUILD_EXAMPLES=OFF -DCMAKE_BUILD_TYPE= \
	  -DCMAKE_CXX_COMPILER=$(CLANG) \
	  -DCMAKE_CXX_FLAGS="$(memory) -fprofile-instr-generate -fcoverage-mapping" > /dev/null
	.venv-sanitize/bin/cmake --build build/fuzz -j$(JOBS)
	core/fuzz/run.sh build/fuzz $(FUZZ_SECONDS)

KILLS ?= 600
torture: .venv/installed
	.venv/bin/python tests/torture/run.py --kills $(KILLS)

# Strict: dead links and anchors, pages out of the navigation and absent snippets are errors.
docs: .venv-check/installed
	NO_MKDOCS_2_WARNING=1 .venv-check/bin/mkdocs build --strict
	.venv-check/bin/python -m pytest --quiet tests/test_docs.py -k links

check: .venv-check/installed docs
	.venv-check/bin/ruff format --check
	.venv-check/bin/ruff check
	cp .venv-check/lib/python3*/site-packages/protomark/_*.pyi python/protomark/
	.venv-check/bin/mypy
	.venv-check/bin/clang-format --dry-run -Werror $(CPP)
	$(call cmake,.venv-check) -S core -B build/tidy -DPROTOMARK_BUILD_TESTS=OFF \
	  -DCMAKE_EXPORT_COMPILE_COMMANDS=ON > /dev/null
	.venv-check/bin/clang-tidy --quiet -p build/tidy $(filter-out core/src/kernels/%,$(wildcard core/src/*/*.cpp))

format: .venv-check/installed
	.venv-check/bin/ruff format
	.venv-check/bin/ruff check --fix
	.venv-check/bin/clang-format -i $(CPP)

clean:
	rm -rf build .venv .venv-bench .venv-ray .venv-test .venv-sanitize .venv-check

.venv/installed: $(SOURCES)
	test -x .venv/bin/python || $(PYTHON) -m venv .venv
	.venv/bin/pip install --quiet -c constraints.txt '.[map]'
	touch $@

.venv-bench/installed: $(SOURCES) $(BENCH)
	test -x .venv-bench/bin/python || $(PYTHON) -m venv .venv-bench
	.venv-bench/bin/pip install --quiet -c constraints.txt . ./benchmarks
	touch $@

.venv-test/installed: $(SOURCES)
	test -x .venv-test/bin/python || $(PYTHON) -m venv .venv-test
	.venv-test/bin/pip install --quiet -c constraints.txt cmake ninja
	.venv-test/bin/pip install --quiet -c constraints.txt '.[test,train]'
	touch $@

# Without the peers: the tests that need one are skipped.
.venv-test/bench: .venv-test/installed $(BENCH)
	.venv-test/bin/pip install --quiet --no-deps ./benchmarks
	touch $@

# Ray beside what the other tests have.
.venv-ray/installed: .venv-test/installed
	test -x .venv-ray/bin/python || $(PYTHON) -m venv .venv-ray
	ls -d $(abspath .venv-test)/lib/python3*/site-packages > \
	  $$(ls -d .venv-ray/lib/python3*/site-packages)/tests.pth
	.venv-ray/bin/pip install --quiet -c constraints.txt fsspec 'ray[serve]'
	touch $@

.venv-sanitize/tools:
	test -x .venv-sanitize/bin/python || $(PYTHON) -m venv .venv-sanitize
	.venv-sanitize/bin/pip install --quiet -c constraints.txt cmake ninja gcovr
	touch $@

.venv-check/installed: $(SOURCES)
	test -x .venv-check/bin/python || $(PYTHON) -m venv .venv-check
	.venv-check/bin/pip install --quiet -c constraints.txt cmake ninja ruff mypy clang-format clang-tidy
	.venv-check/bin/pip install --quiet -c constraints.txt '.[test,docs]'
	touch $@
