# The only entry points. Each target makes the environment first if it is missing.
# The Python that the environment is made of: python3 if it will do, else the newest that does. PY=… decides otherwise.
PY ?= $(shell for p in python3 python3.13 python3.12 python3.11; do \
	$$p -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null && echo $$p && break; done)
JOBS ?= 2
BIN := .venv/bin
READY := .venv/.ready
CACHE := _build/.jupyter_cache
# A file's tests, and a notebook's cells, stay in one process; the files go out in the order of conftest.py.
PARALLEL = -n $(JOBS) --dist loadfile --no-loadscope-reorder

help:            ## list the targets
	@grep -E '^[a-z]+: .*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/' | expand -t 10

book: $(READY)   ## build the book into _build/html; runs only notebooks that `make test` has not
	@echo "Building the book …"
	@# The cache knows the notebooks' cells only: with another package its outputs are stale.
	@if [ -n "$$(find nrsfm_lite requirements.txt -newer $(CACHE)/global.db -not -name '*.pyc' -type f 2>/dev/null)" ]; then rm -rf $(CACHE); fi
	@$(BIN)/jupyter-book build . --toc book/_toc.yml --quiet -W --keep-going --all
	@echo "Open _build/html/index.html"

test: $(READY)   ## check style and types, test the package, execute every notebook once; JOBS=4 for four processes
	@echo "Checking style and types …"
	@$(BIN)/ruff check --quiet .
	@$(BIN)/ruff format --check --quiet .
	@$(BIN)/mypy --no-error-summary
	@echo "Testing the package and executing the notebooks …"
	@$(BIN)/python -m pytest -q $(PARALLEL)

kernels: $(READY) ## test the package twice more, with the linear algebra of two older processors
	@echo "Testing under other kernels …"
	@$(BIN)/python tests/kernels.py $(PARALLEL)

lab: $(READY)    ## open the notebooks in JupyterLab
	@echo "Opening JupyterLab …"
	@$(BIN)/jupyter lab notebooks

bench: $(READY)  ## time a training step and inference on this machine, into _build/bench
	@echo "Timing …"
	@rm -rf _build/bench
	@$(BIN)/nrsfm experiment speed --out _build/bench

site: $(READY)   ## look at the built book in headless Chromium (needs chromium; keeps pictures in _build/shots)
	@echo "Opening every page of _build/html …"
	@$(BIN)/python -m pytest -q -p no:nbval -o addopts= book/check_site.py

picture: $(READY) ## remake book/_static/reconstruction.png, the picture of the README
	@$(BIN)/python book/make_picture.py book/_static/reconstruction.png

clean:           ## remove the environment and everything built
	@echo "Removing .venv and _build …"
	@rm -rf .venv _build build *.egg-info book/_ext/*.egg-info book/_ext/build .pytest_cache .ruff_cache .hypothesis

$(READY): requirements.txt pyproject.toml book/_ext/pyproject.toml
	@[ -n "$(PY)" ] || { echo "Python 3.11, 3.12 or 3.13 is needed, and none was found. Name one: make PY=/path/to/python3.13"; exit 1; }
	@$(PY) -c 'import sys; v = sys.version_info[:2]; sys.exit(0 if (3, 11) <= v <= (3, 13) else f"Python 3.11, 3.12 or 3.13 is needed, this is {v[0]}.{v[1]}. Try: make PY=python3.13")'
	@echo "Making the environment in .venv (once, a few minutes) …"
	@$(PY) -m venv .venv
	@if [ -n "$(TORCH_INDEX)" ]; then $(BIN)/pip install --quiet --index-url $(TORCH_INDEX) "$$(grep '^torch==' requirements.txt)"; fi
	@$(BIN)/pip install --quiet -r requirements.txt
	@touch $@

.PHONY: help book test kernels lab bench site picture clean
