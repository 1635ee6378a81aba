# Every target runs in a virtual environment, made on first use with the newest Python that
# scripts/python.sh finds. Nothing is needed beforehand but make and Python 3.11 or newer.
#
#   make demo ARGS="--help"            arguments for the command
#   make test PYTEST_ARGS="-k riccati" arguments for pytest
#   make test PYTHON=python3.12        another interpreter (before .venv exists)

SHELL := /bin/sh
.DEFAULT_GOAL := help
.NOTPARALLEL:
.DELETE_ON_ERROR:

VENV ?= .venv
ARGS ?=
PYTEST_ARGS ?=

bin := $(VENV)/bin
pip := $(bin)/python -m pip --disable-pip-version-check -qq

# The tests run one process a core, so that each process keeps to one thread.
one_thread := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 \
	XLA_FLAGS="--xla_cpu_multi_thread_eigen=false $$XLA_FLAGS"
# The checks of annotations take a seventh of the time, and those in single precision see
# the same code.
unhooked := --jaxtyping-packages=
pytest := $(one_thread) $(bin)/python -m pytest -n logical --maxprocesses=8 --dist worksteal

# The tests keep compiled programs on disk by themselves; notebooks are told to.
kept := JAX_COMPILATION_CACHE_DIR="$${JAX_COMPILATION_CACHE_DIR:-$(CURDIR)/.cache/programs}" \
	JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS=0

# The examples of pages and docstrings run once, in single precision.
examples := tests/contracts/test_public.py tests/test_docs.py
no_examples := $(addprefix --ignore=,$(examples))
# An expression may select no test of a part.
or_none := || [ $$? -eq 5 ]
# What meets other packages, and the spine: what all else is made of.
spine := tests/contracts/test_controllers.py tests/contracts/test_systems.py tests/simulation \
	tests/planning/test_ilqr.py tests/riccati/test_dare.py tests/riccati/test_care.py \
	tests/training/test_fit.py
outward := tests/dynamics/test_integration.py tests/experiments tests/interop \
	tests/plotting/test_plot.py tests/plotting/test_animate.py

# LLVM's optimiser takes half of the time, for programs that run for milliseconds.
lightly := XLA_FLAGS="--xla_backend_optimization_level=0 \
	--xla_llvm_disable_expensive_passes=true $$XLA_FLAGS"; export XLA_FLAGS;

##@ Use

.PHONY: help
help: ## list the targets
	@awk 'BEGIN { FS = ":.*## " } \
		/^##@ / { printf "\n%s\n", substr($$0, 5) } \
		/^[a-z0-9-]+:.*## / { printf "  make %-14s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

.PHONY: demo
demo: $(VENV)/.demo ## train a swing-up, then the paper at reduced size; into demo/
	$(bin)/python -u -m delucax demo $(ARGS)

.PHONY: bench
bench: $(VENV)/.bench ## speed against other libraries
	$(bin)/python -u -m benchmarks $(ARGS)

##@ Check

.PHONY: test
test: test-float32 test-float64 notebooks ## the tests in both precisions, then the notebooks

.PHONY: test-float32
test-float32: $(VENV)/.tests ## the tests in single precision
	$(lightly) JAX_ENABLE_X64=0 $(pytest) $(PYTEST_ARGS) $(or_none)

.PHONY: test-float64
test-float64: $(VENV)/.tests ## the tests in double precision; the docs' examples ran before
	$(lightly) JAX_ENABLE_X64=1 $(pytest) $(unhooked) $(no_examples) --ignore tests/plotting \
		$(PYTEST_ARGS) $(or_none)

.PHONY: test-optimised
test-optimised: $(VENV)/.tests ## the tests in single precision, compiled as for users
	JAX_ENABLE_X64=0 $(pytest) $(PYTEST_ARGS)

.PHONY: thorough
thorough: $(VENV)/.tests ## the few tests that take minutes by their nature
	JAX_ENABLE_X64=0 $(pytest) -m minutes $(PYTEST_ARGS)
	JAX_ENABLE_X64=1 $(pytest) -m minutes $(no_examples) $(PYTEST_ARGS)

.PHONY: outputs
outputs: $(VENV)/.tests ## the outputs under the code of the pages; `test` runs all of the code
	$(lightly) JAX_ENABLE_X64=0 $(pytest) tests/test_docs.py --only-outputs $(PYTEST_ARGS)

.PHONY: test-oldest
test-oldest: $(VENV)-oldest/.tests ## the spine, with the oldest Python and dependencies allowed
	$(lightly) JAX_ENABLE_X64=0 $(one_thread) $(VENV)-oldest/bin/python -m pytest \
		-n logical --maxprocesses=8 --dist worksteal -W default \
		$(spine) $(outward) $(PYTEST_ARGS)

.PHONY: notebooks
notebooks: $(VENV)/.tests ## run every notebook from top to bottom, with little of everything
	$(lightly) $(kept) CI=1 MPLBACKEND=agg $(pytest) -o addopts= -W default \
		--nbmake --nbmake-timeout=600 notebooks

.PHONY: notebooks-full
notebooks-full: $(VENV)/.tests ## run every notebook as it is shown
	CI= MPLBACKEND=agg $(pytest) -o addopts= -W default \
		--nbmake --nbmake-timeout=1800 notebooks

.PHONY: lint
lint: $(VENV)/.dev ## style, formatting, imports between layers, the ledger of claims
	$(bin)/ruff check
	$(bin)/ruff format --check
	$(bin)/lint-imports --no-cache --no-logo
	$(bin)/python scripts/claims.py

.PHONY: format
format: $(VENV)/.dev ## apply style and formatting
	$(bin)/ruff check --fix
	$(bin)/ruff format

.PHONY: types
types: $(VENV)/.dev ## static types
	$(bin)/pyright

.PHONY: docs
docs: $(VENV)/.docs ## build the site into site/ and check it; a warning is an error
	$(bin)/properdocs build --strict --config-file mkdocs.yml
	$(bin)/python scripts/check_site.py

.PHONY: serve
serve: $(VENV)/.docs ## show the site on this machine while editing it
	$(bin)/properdocs serve --config-file mkdocs.yml

##@ Set up

.PHONY: dev
dev: $(VENV)/.dev ## everything a contributor needs, and the commit hooks
	if [ -e .git ]; then $(bin)/prek install; fi

.PHONY: clean
clean: ## remove what the other targets wrote, but not the environment
	rm -rf build demo dist site .cache .hypothesis .pytest_cache .ruff_cache
	find . -path ./$(VENV) -prune -o -name __pycache__ -type d -exec rm -rf {} +

.PHONY: distclean
distclean: clean ## remove the environment too
	rm -rf $(VENV) $(VENV)-oldest

# A stamp is renewed when pyproject.toml changes; with nothing to do a target starts at
# once. The group `dev` holds `tests` and `docs`, so that its stamp renews theirs.

$(VENV)/.pip:
	@if $(bin)/python -m pip --version >/dev/null 2>&1; then :; else \
		python="$(PYTHON)"; \
		if [ -z "$$python" ]; then python=$$(sh scripts/python.sh) || exit 1; fi; \
		echo "making $(VENV) with $$("$$python" --version)"; \
		"$$python" -m venv --clear $(VENV); \
	fi
	@$(pip) install --upgrade 'pip>=25.1'
	@touch $@

# uv finds the oldest versions that go together; pip finds only the newest.
$(VENV)-oldest/.tests: pyproject.toml
	@python=$$(sh scripts/python.sh oldest) || exit 1; \
		echo "making $(@D) with $$("$$python" --version) and the oldest dependencies"; \
		"$$python" -m venv --clear $(@D)
	@$(@D)/bin/python -m pip --disable-pip-version-check -qq install uv
	@$(@D)/bin/uv pip install --quiet --python $(@D)/bin/python \
		--resolution lowest-direct --editable '.[all]' --group tests
	@touch $@

$(VENV)/.demo: $(VENV)/.pip pyproject.toml
	@echo "installing delucax into $(VENV)"
	@$(pip) install --editable '.[demo]'
	@touch $@

$(VENV)/.tests $(VENV)/.docs $(VENV)/.dev $(VENV)/.bench: $(VENV)/.pip pyproject.toml
	@echo "installing delucax and its $(@F:.%=%) group into $(VENV)"
	@$(pip) install --editable '.[all]' --group $(@F:.%=%)
	@touch $@ $(if $(filter %/.dev,$@),$(VENV)/.tests $(VENV)/.docs)
