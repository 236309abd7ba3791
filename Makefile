# The six verbs: setup, check, test, bench, docs, release; the demo, and the test with ROS. CI calls the same ones.
# Nothing is needed beforehand but Python 3.10 or later: every verb sets up .venv by itself.

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
PYTEST_ARGS ?=
# Files of tests share the cores, in the order of tests/conftest.py; PYTEST_SHARE= runs them one after the other.
PYTEST_SHARE ?= --numprocesses auto --dist loadfile --no-loadscope-reorder
PYTHONS ?= python3.10 python3.12 python3.13
# The stages, the readers, the files and the command line.
VERSION_TESTS := $(patsubst %,tests/test_%.py,scan angle_function segments anchors graph database alignment \
	evaluation field proposal verification decision matcher settings io_carmen io_damage io_g2o io_recorded \
	io_rosbag io_tables io_tum array_file derived_index reference_set reference_set_file map_file bad_input \
	localizer repetition cli)
FUZZ_TARGETS ?=
FUZZ_RUNS ?= 1000000
FUZZ_SECONDS ?= 3600

.DEFAULT_GOAL := help
.PHONY: help setup check test ros-test bench docs release demo picture lock clean
.PHONY: fuzz test-lowest test-newest test-versions audit kernels package wheel smoke

help: ## show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-11s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup: $(VENV)/.ready ## make .venv with the package (editable) and the pinned tools

# A Python without ensurepip (some distributions split it off) still gets pip, from the one outside.
$(VENV)/.ready: requirements-dev.txt pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || \
		{ echo "error: $(PYTHON) is too old; try make PYTHON=python3.11 (3.10 or later)" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV) 2>/dev/null || { $(PYTHON) -m venv --clear --without-pip $(VENV) && \
		$(PYTHON) -m pip --python $(BIN)/python install --quiet pip; }
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements-dev.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

check: setup ## lint, format and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

test: check ## check, then every test
	$(BIN)/python -m pytest $(PYTEST_SHARE) $(PYTEST_ARGS)

ros-test: $(VENV)-ros/.ready ## the ROS 2 node on the wire, in an environment of its own
	ANCHORSCAN_REQUIRE_ROS=1 $(VENV)-ros/bin/python -m pytest tests/ros $(PYTEST_ARGS)

# Linux only.  These wheels start every Python of their environment anew: keep it to itself.
$(VENV)-ros/.ready: requirements-ros.txt pyproject.toml
	$(PYTHON) -m venv $(VENV)-ros 2>/dev/null || { \
		$(PYTHON) -m venv --clear --without-pip $(VENV)-ros && \
		$(PYTHON) -m pip --python $(VENV)-ros/bin/python install --quiet pip; }
	$(VENV)-ros/bin/python -m pip install --quiet --disable-pip-version-check --require-hashes \
		-r requirements-ros.txt
	$(VENV)-ros/bin/python -m pip install --quiet --disable-pip-version-check --no-deps \
		--no-build-isolation -e .
	@touch $@

fuzz: setup ## damage everything that is read: FUZZ_TARGETS, FUZZ_RUNS and FUZZ_SECONDS a target
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --only-binary :all: atheris || \
		echo "note: no atheris for this Python; inputs are damaged without its guidance"
	cd tests && ../$(BIN)/python -m fuzz $(FUZZ_TARGETS) --runs $(FUZZ_RUNS) \
		--seconds $(FUZZ_SECONDS) --findings ../fuzz-findings

test-lowest: setup ## every test with the oldest versions that pyproject.toml allows
	$(call test_with,lowest-direct,$(VENV)-lowest)

test-newest: setup ## every test with the newest versions that there are, not the pinned ones
	$(call test_with,highest,$(VENV)-newest)

define test_with
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv
	$(PYTHON) -m venv --clear --without-pip $(2)
	$(BIN)/uv pip install --quiet --python $(2)/bin/python --resolution $(1) \
		-e ".[bags,fleet,maps,plot,service]" "rtb-data>=1.0" "pytest>=8" "hypothesis>=6.100"
	$(2)/bin/python -m pytest $(PYTEST_ARGS)
endef

test-versions: setup ## answers and tests under other Pythons: PYTHONS="python3.10 python3.13"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv
	for python in $(PYTHONS); do \
		$$python -m venv --clear --without-pip $(VENV)-$$(basename $$python) || exit 1; \
		$(BIN)/uv pip install --quiet --python $(VENV)-$$(basename $$python)/bin/python \
			--constraint requirements-dev.txt -e ".[bags,maps,plot]" "rtb-data>=1.0" pytest hypothesis || exit 1; \
		$(VENV)-$$(basename $$python)/bin/python -m pytest $(VERSION_TESTS) $(PYTEST_ARGS) || exit 1; \
	done
	$(BIN)/anchorscan endure repeat $(foreach python,$(PYTHONS),--python $(VENV)-$(notdir $(python))/bin/python)

audit: setup ## look the pinned versions up among the known weaknesses; needs pypi.org
	$(BIN)/python -m pip install --quiet --disable-pip-version-check pip-audit
	$(BIN)/pip-audit --strict --disable-pip --require-hashes -r requirements-dev.txt

kernels: setup ## compile the kernels once, so that processes side by side do not all do it
	$(BIN)/python -c 'from anchorscan import Localizer, Matcher, Settings; \
		all_of = [Matcher((), Settings.preset(name)) for name in ("default", "paper")]; \
		[each.prepare() for each in all_of]; Localizer(all_of[0]).prepare()'

package: wheel ## build both distributions and try the wheel in an empty environment
	$(MAKE) --no-print-directory smoke

wheel: setup
	rm -rf dist $(VENV)-package
	$(BIN)/python -m build --no-isolation --quiet
	$(PYTHON) -m venv $(VENV)-package 2>/dev/null || { \
		$(PYTHON) -m venv --clear --without-pip $(VENV)-package && \
		$(PYTHON) -m pip --python $(VENV)-package/bin/python install --quiet pip; }
	$(VENV)-package/bin/python -m pip install --quiet --disable-pip-version-check dist/*.whl

smoke: # what `make wheel` has installed; it compiles everything once more
	cd dist && ../$(VENV)-package/bin/anchorscan --version && \
		../$(VENV)-package/bin/python ../tests/smoke.py

bench: setup ## the protocols on the logs in ANCHORSCAN_DATA
	$(BIN)/anchorscan bench

docs: setup ## build the documentation strictly, into site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

release: setup ## build both distributions and try the wheel in an empty environment
	rm -rf dist $(VENV)-release
	$(BIN)/python -m build --no-isolation
	$(PYTHON) -m venv $(VENV)-release
	$(VENV)-release/bin/python -m pip install --quiet --disable-pip-version-check \
		"anchorscan[demo] @ file://$(CURDIR)/$$(ls dist/*.whl)"
	cd dist && ../$(VENV)-release/bin/anchorscan --version && ../$(VENV)-release/bin/anchorscan demo
	@grep -q "^## $$($(BIN)/anchorscan --version | cut -d' ' -f2) " CHANGELOG.md || \
		echo "note: CHANGELOG.md has no entry for this version yet; tag only after it has one"

demo: setup ## build a map of MIT Killian Court and locate later visits in it
	$(BIN)/anchorscan demo

picture: setup ## draw the pictures of README and documentation again
	$(BIN)/anchorscan demo --output docs/images
	$(BIN)/python docs/pictures.py

lock: setup ## resolve the pinned requirements anew, for Python 3.10 and later
	$(BIN)/python -m pip install --quiet uv
	$(BIN)/uv pip compile --quiet --upgrade --universal --python-version 3.10 --all-extras \
		--generate-hashes --no-emit-index-url --custom-compile-command "make lock" \
		pyproject.toml --output-file requirements-dev.txt
	$(BIN)/uv pip compile --quiet --upgrade --python-version 3.10 --extra bags --extra maps \
		--generate-hashes --no-emit-index-url --custom-compile-command "make lock" \
		pyproject.toml requirements-ros.in --output-file requirements-ros.txt

clean: ## remove what the verbs made
	rm -rf $(VENV) $(VENV)-release $(VENV)-ros $(VENV)-lowest $(VENV)-newest $(VENV)-package $(VENV)-python* site dist build .mypy_cache .ruff_cache .pytest_cache
