# make demo   simulate and invert the paper's toroidal shot, write figures to demo/
# make test   check style and types, build the site, then run the whole test suite
# make docs   build the documentation site into build/docs; GALLERY=1 runs the examples for it, too
# make gallery make the pictures of docs/gallery.md again
# make dist   build the source distribution and the wheel in dist/
# make check-wheel  install the wheel into an empty environment and use it there
# make format put the code into the project's format

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
ON_SCREEN := xvfb-run -a -s "-screen 0 2560x1440x24"
ON_BOTH_CORES := -n 2 --dist loadfile

.PHONY: demo test docs gallery lint dist check-wheel format clean

demo: $(VENV)/installed
	$(BIN)/shadowinv demo --out demo

gallery: $(VENV)/installed
	$(BIN)/python docs/make_gallery.py

docs: $(VENV)/installed-dev
	GALLERY=$(GALLERY) $(BIN)/sphinx-build -W --keep-going -q docs build/docs
	@echo "open build/docs/index.html"

test: lint docs
	@sh .ci/need-display
	QT_API=pyqt6 $(ON_SCREEN) $(BIN)/python -m pytest $(ON_BOTH_CORES)
	QT_API=pyside6 PYTEST_QT_API=pyside6 $(ON_SCREEN) $(BIN)/python -m pytest $(ON_BOTH_CORES) -q \
		tests/napari/widgets/test_tools.py tests/napari/widgets/test_forms.py

lint: $(VENV)/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/npe2 validate --imports napari.yaml

dist: $(VENV)/installed-dev
	rm -rf dist
	$(BIN)/python -m build

check-wheel: dist
	sh .ci/check-wheel $(BIN)/python

format: $(VENV)/installed-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

$(VENV)/installed: pyproject.toml | $(BIN)/pip
	$(BIN)/pip install --quiet --editable .
	touch $@

$(VENV)/installed-dev: pyproject.toml | $(BIN)/pip
	$(BIN)/pip install --quiet --editable '.[dev]'
	touch $@ $(VENV)/installed

$(BIN)/pip:
	@PYTHON=$(PYTHON) sh .ci/need-venv
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --upgrade pip

clean:
	rm -rf $(VENV) demo dist build .pytest_cache .mypy_cache .ruff_cache .hypothesis
