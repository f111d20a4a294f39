# The two commands for a fresh machine are `make demo` and `make test`. All of them make their own
# virtual environments; PYTHON chooses the interpreter (3.10 or newer).
PYTHON ?= python3
SOURCES := $(shell find core bindings python -type f -not -path '*/__pycache__/*' -not -name '_*.pyi') \
           CMakeLists.txt pyproject.toml constraints.txt
CPP := $(shell find core bindings -name '*.cpp' -o -name '*.h')
JOBS := $(shell nproc 2>/dev/null || echo 2)
cmake = $(1)/bin/cmake -G Ninja -DCMAKE_MAKE_PROGRAM=$(abspath $(1)/bin/ninja) -DCMAKE_BUILD_TYPE=Release
export PIP_DISABLE_PIP_VERSION_CHECK = 1

.PHONY: help demo test test-python test-cpp test-arm check format clean
help:
	@echo "make demo      run the main job on the sample that ships"
	@echo "make test      run the tests (C++ and Python)"
	@echo "make test-arm  run the C++ tests for 64-bit ARM under qemu-user"
	@echo "make check     formatting, lint and types of both languages"
	@echo "make format    rewrite sources in the project's format"

demo: .venv/installed
	.venv/bin/protomark demo

test: test-cpp test-python

test-python: .venv-test/installed
	.venv-test/bin/python -m pytest

test-cpp: .venv-test/installed
	$(call cmake,.venv-test) -S core -B build/core -DPROTOMARK_BUILD_TESTS=ON > /dev/null
	.venv-test/bin/cmake --build build/core -j$(JOBS)
	.venv-test/bin/ctest --test-dir build/core --output-on-failure
	# The installed library, as another project finds it.
	.venv-test/bin/cmake --install build/core --prefix build/prefix > /dev/null
	$(call cmake,.venv-test) -S core/examples -B build/consumer \
	  -DCMAKE_PREFIX_PATH=$(abspath build/prefix) > /dev/null
	.venv-test/bin/cmake --build build/consumer
	build/consumer/01_build_and_search python/protomark/models/freak.pme build

# 64-bit ARM, NEON included, by Debian's cross compiler and qemu-user.
test-arm: .venv-test/installed
	@command -v aarch64-linux-gnu-g++ >/dev/null && command -v qemu-aarch64 >/dev/null || { \
	  echo "make test-arm needs: apt-get install g++-aarch64-linux-gnu qemu-user"; exit 1; }
	$(call cmake,.venv-test) -S core -B build/arm -DPROTOMARK_BUILD_TESTS=ON \
	  -DCMAKE_TOOLCHAIN_FILE=aarch64-linux.cmake > /dev/null
	.venv-test/bin/cmake --build build/arm -j$(JOBS)
	.venv-test/bin/ctest --test-dir build/arm --output-on-failure

check: .venv-check/installed
	.venv-check/bin/ruff format --check
	.venv-check/bin/ruff check
	cp .venv-check/lib/python3*/site-packages/protomark/_*.pyi python/protomark/
	.venv-check/bin/mypy
	.venv-check/bin/clang-format --dry-run -Werror $(CPP)
	$(call cmake,.venv-check) -S core -B build/tidy -DPROTOMARK_BUILD_TESTS=OFF \
	  -DCMAKE_EXPORT_COMPILE_COMMANDS=ON > /dev/null
	.venv-check/bin/clang-tidy --quiet -p build/tidy $(wildcard core/src/*.cpp)

format: .venv-check/installed
	.venv-check/bin/ruff format
	.venv-check/bin/ruff check --fix
	.venv-check/bin/clang-format -i $(CPP)

clean:
	rm -rf build .venv .venv-test .venv-check

.venv/installed: $(SOURCES)
	test -x .venv/bin/python || $(PYTHON) -m venv .venv
	.venv/bin/pip install --quiet .
	touch $@

.venv-test/installed: $(SOURCES)
	test -x .venv-test/bin/python || $(PYTHON) -m venv .venv-test
	.venv-test/bin/pip install --quiet -c constraints.txt cmake ninja
	.venv-test/bin/pip install --quiet -c constraints.txt '.[test,train]'
	touch $@

.venv-check/installed: $(SOURCES)
	test -x .venv-check/bin/python || $(PYTHON) -m venv .venv-check
	.venv-check/bin/pip install --quiet -c constraints.txt cmake ninja ruff mypy clang-format clang-tidy
	.venv-check/bin/pip install --quiet -c constraints.txt '.[test,train]'
	touch $@
