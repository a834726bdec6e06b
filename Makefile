PYTHON ?= python3
VENV := .venv
EXTRAS ?= dev
MESH ?=
NAME := $(if $(MESH),$(basename $(notdir $(MESH))),demo)
INSTANT := runs/$(if $(MESH),$(NAME),vase)-instant

.PHONY: setup demo test test-fast docs bench vendor

setup: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "flx needs Python 3.11 or newer; say make PYTHON=/path/to/python3.11"; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/pip install --quiet --disable-pip-version-check --editable '.[$(EXTRAS)]'
	@touch $@

demo: setup  # four variations of the embedded vase (or MESH=your.glb) at once, then four by a model that learns it
	$(VENV)/bin/flx sample $(if $(MESH),'$(MESH)') --instant --count 4 --out '$(INSTANT)'
	$(VENV)/bin/flx train experiments/demo.py --name '$(NAME)' $(if $(MESH),--surface.path '$(MESH)')
	$(VENV)/bin/flx sample 'runs/$(NAME)' --count 4 --beside '$(INSTANT)'

test: setup  # the linters and every test
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/pyright
	$(VENV)/bin/lint-imports
	$(VENV)/bin/python -m pytest --durations=15

test-fast: setup  # without the linters and the slow tests
	$(VENV)/bin/python -m pytest -m 'not slow'

docs: $(VENV)/.docs  # the site, in build/docs; FLX_DOCS_EXECUTE=cache runs the notebooks in it
	$(VENV)/bin/python -m sphinx -W --keep-going -q -c docs . build/docs

$(VENV)/.docs: $(VENV)/.installed
	$(VENV)/bin/pip install --quiet --disable-pip-version-check --editable '.[docs,notebook]'
	@touch $@

bench: setup  # timings of this machine, as JSON
	$(VENV)/bin/flx bench

vendor:  # three.js, three-mesh-bvh and uPlot for the pages, bundled again from the npm registry; needs Node. docs/credits.md has the hashes
	cd vendor && npm ci --silent && npm run --silent build
	for name in three three-mesh-bvh uplot; do \
	  { echo "/*! $$name $$(node -p "require('./vendor/node_modules/$$name/package.json').version")"; \
	    cat vendor/node_modules/$$name/LICENSE; echo '*/'; cat vendor/$$name.min.js; } \
	    > flx/viewer/$$name.min.js; done
	cp vendor/node_modules/uplot/dist/uPlot.min.css flx/viewer/uplot.min.css
	sha256sum flx/viewer/*.min.*
