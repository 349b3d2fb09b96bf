# make demo   simulate and invert the paper's toroidal shot, write figures to demo/
# make test   check style and types, build the site, run the whole test suite, try the wheel
# make docs   build the documentation site into build/docs; GALLERY=1 runs the examples for it, too
# make coverage  run the tests once more and report which lines they reach
# make test-oldest  test the core with the lowest versions that pyproject.toml allows
# make test-newest CORE_PYTHON=python3.14  test the core with the newest versions, on any Python
# make gallery make the pictures of docs/gallery.md again
# make dist   build the source distribution and the wheel in dist/
# make check-wheel  install the wheel into an empty environment and use it there
# make placeholders  list what must be filled in before a release
# make paper  build the paper of paper/ into build/paper.html
# make format put the code into the project's format

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
ON_SCREEN := xvfb-run -a -s "-screen 0 2560x1440x24"
ON_BOTH_CORES := -n 2 --dist loadfile --no-loadscope-reorder
CORE_PYTHON ?= $(BIN)/python
CORE_TOOLS := "pytest>=8.2" "pytest-xdist>=3.6" "hypothesis>=6.100" "shapely>=2.0" "pyamg>=5.1" \
	"pyyaml>=6.0" "pooch>=1.8"
CORE_TESTS := tests/geometry tests/transport tests/fitting tests/physics tests/io tests/inversion tests/preprocessing \
	tests/cli/test_shot_commands.py tests/plotting tests/stack/test_sites.py tests/stack/test_run.py \
	tests/cli/test_mistakes.py tests/stack/test_alone.py tests/test_faces.py

# Two tests run at a time: threads of linear algebra beside them would wait for each other.
test coverage test-oldest test-newest: export OPENBLAS_NUM_THREADS := 1

# Keep byte code, though a container may say otherwise: the tests start hundreds of processes.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo test test-pyside kernels coverage test-oldest test-newest docs gallery lint dist check-wheel placeholders paper format clean

demo: $(VENV)/installed
	$(BIN)/shadowinv demo --out demo

gallery: $(VENV)/installed
	$(BIN)/python docs/make_gallery.py

docs: $(VENV)/installed-dev
	GALLERY=$(GALLERY) $(BIN)/sphinx-build -W --keep-going -q docs build/docs
	@echo "open build/docs/index.html"

test: $(VENV)/installed-dev
	@sh .ci/need-display
	@$(MAKE) --no-print-directory -j3 lint docs kernels
	QT_API=pyqt6 $(ON_SCREEN) $(BIN)/python -m pytest $(ON_BOTH_CORES) --durations=40
	@$(MAKE) --no-print-directory -j2 check-wheel test-pyside

test-pyside: $(VENV)/installed-dev
	QT_API=pyside6 PYTEST_QT_API=pyside6 $(ON_SCREEN) $(BIN)/python -m pytest -q \
		tests/napari/widgets/test_windows.py tests/napari/widgets/test_forms.py

# Compiled beforehand, so that not every process of the tests compiles them.
kernels: $(VENV)/installed-dev
	@$(BIN)/python -c "from napari_shadowinv.fitting.compilation import ensure_compiled; ensure_compiled()"

coverage: $(VENV)/installed-dev
	@sh .ci/need-display
	QT_API=pyqt6 $(ON_SCREEN) $(BIN)/python -m pytest $(ON_BOTH_CORES) -q --cov=napari_shadowinv \
		--cov-report=term:skip-covered

# Without pytest-qt its setting is unknown, so the configuration is not strict here.
test-oldest: RESOLUTION := lowest-direct
test-newest: RESOLUTION := highest
test-oldest test-newest: CORE = $(CURDIR)/$(VENV)-$(@:test-%=%)
test-oldest test-newest: $(VENV)/installed-dev
	$(BIN)/uv venv --quiet --clear --python $(CORE_PYTHON) $(CORE)
	$(BIN)/uv pip install --quiet --python $(CORE)/bin/python --resolution $(RESOLUTION) \
		--editable . $(CORE_TOOLS)
	NUMBA_CACHE_DIR=$(CORE)/numba $(CORE)/bin/python -m pytest \
		-o addopts="--strict-markers --import-mode=importlib" $(ON_BOTH_CORES) -q $(CORE_TESTS)

lint: $(VENV)/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/npe2 validate --imports napari.yaml
	@sh .ci/lint-workflows
	$(BIN)/check-jsonschema --builtin-schema vendor.citation-file-format CITATION.cff
	$(BIN)/check-jsonschema --builtin-schema vendor.readthedocs .readthedocs.yaml
	$(BIN)/check-jsonschema --builtin-schema vendor.github-workflows .github/workflows/*.yml
	$(BIN)/check-jsonschema --builtin-schema vendor.github-issue-forms \
		.github/ISSUE_TEMPLATE/bug_report.yml .github/ISSUE_TEMPLATE/feature_request.yml

dist: $(VENV)/installed-dev
	rm -rf dist
	$(BIN)/python -m build

check-wheel: dist
	sh .ci/check-wheel $(BIN)/python

placeholders:
	@git grep -n PLACEHOLDER_ -- . ':!tests' ':!Makefile' ':!.github' ':!CHANGELOG.md' || echo "none is left"

# Embedded pictures make it a page of its own.
paper: $(VENV)/installed-dev
	@mkdir -p build
	$(BIN)/uv run --quiet --no-project --with pypandoc_binary python -c 'import pypandoc; \
		pypandoc.convert_file("paper/paper.md", "html", outputfile="build/paper.html", extra_args=[ \
		"--standalone", "--citeproc", "--mathml", "--embed-resources", "--resource-path=paper"])'
	@echo "open build/paper.html"

format: $(VENV)/installed-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

$(VENV)/installed: pyproject.toml | $(BIN)/pip
	$(BIN)/pip install --quiet --editable .
	touch $@

$(VENV)/installed-dev: pyproject.toml | $(BIN)/pip
	$(BIN)/pip install --quiet --no-compile --editable '.[dev]'
	touch $@ $(VENV)/installed

$(BIN)/pip:
	@PYTHON=$(PYTHON) sh .ci/need-venv
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --upgrade pip

clean:
	rm -rf $(VENV) $(VENV)-oldest $(VENV)-newest demo dist build .pytest_cache .mypy_cache .ruff_cache .hypothesis
