# The only entry points. Each target makes the environment first if it is missing.
PY ?= python3
BIN := .venv/bin
READY := .venv/.ready
CACHE := _build/.jupyter_cache

help:            ## list the targets
	@grep -E '^[a-z]+: .*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/' | expand -t 10

book: $(READY)   ## build the book into _build/html; runs only notebooks that `make test` has not
	@echo "Building the book …"
	@# The cache knows the notebooks' cells only: with another package its outputs are stale.
	@if [ -n "$$(find nrsfm_lite requirements.txt -newer $(CACHE)/global.db -not -name '*.pyc' -type f 2>/dev/null)" ]; then rm -rf $(CACHE); fi
	@$(BIN)/jupyter-book build . --toc book/_toc.yml --quiet -W --keep-going --all
	@echo "Open _build/html/index.html"

test: $(READY)   ## check the style, test the package, execute every notebook once
	@echo "Testing the package and executing the notebooks …"
	@$(BIN)/ruff check --quiet .
	@$(BIN)/ruff format --check --quiet .
	@$(BIN)/python -m pytest -q

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
	@rm -rf .venv _build build *.egg-info book/_ext/*.egg-info book/_ext/build .pytest_cache .ruff_cache

$(READY): requirements.txt pyproject.toml book/_ext/pyproject.toml
	@$(PY) -c 'import sys; v = sys.version_info[:2]; sys.exit(0 if v >= (3, 11) else f"Python 3.11 or newer is needed, this is {v[0]}.{v[1]}; try: make PY=python3.11")'
	@echo "Making the environment in .venv (once, a few minutes) …"
	@$(PY) -m venv .venv
	@if [ -n "$(TORCH_INDEX)" ]; then $(BIN)/pip install --quiet --index-url $(TORCH_INDEX) "$$(grep '^torch==' requirements.txt)"; fi
	@$(BIN)/pip install --quiet -r requirements.txt
	@touch $@

.PHONY: help book test lab bench site picture clean
