# make demo     an environment, an example mesh, its octree, a surface of it, its distance field; an example
#               volume, and pictures
# make quick    a contributor's loop: one driver, nothing slow; under two minutes
# make test     the whole suite; ARGS=--every-driver runs each case on every driver, not on one in turn
# make soak     the long tests: kills, many calls, all models and digests; SECONDS= and SEED= choose a slice;
#               from ten minutes on also each case on the drivers on which make test does not run it
# make fuzz     mutated files and extreme arguments; SECONDS=, SEED= and ARGS= as python -m tests.fuzz -h
# make golden  the golden digests of KIND= anew: svo, mesh, adf, ... (tests/golden)
# make gpu-report  selftest, golden digests and bench of DEVICE= (a GPU), in docs/gpu; again goes on
# make lint     style, types and imports, also of the scripts of pages
# make docs     the site, in build/site
# make headers  the headers that the host generates for the kernels
# Only Python 3.11 or newer and a package index are needed; PYTHON= names another interpreter.

PYTHON ?= python3
# Without a network: WHEELS= names a folder of wheels, EXTRAS= the extras that it has.
WHEELS ?=
EXTRAS ?= all
PIP_INSTALL := .venv/bin/python -m pip install --quiet --disable-pip-version-check \
    $(if $(WHEELS),--no-index --find-links $(WHEELS))
# A test that takes ten minutes ends its process with a traceback and fails by name.
PYTEST := .venv/bin/python -m pytest -n auto --maxprocesses 4 --dist worksteal \
	-o faulthandler_timeout=600 -o faulthandler_exit_on_timeout=true
SECONDS ?= 3600
SEED ?=
ARGS ?=
DEVICE ?= gpu
# With it each process of the tests, hundreds, would compile the package and the tests anew.
unexport PYTHONDONTWRITEBYTECODE
# The processes of the tests share the cores, and numpy's threads for matrices spin while they wait.
export OPENBLAS_NUM_THREADS := 1

.PHONY: demo quick test soak fuzz golden gpu-report lint docs headers clean

demo: .venv/all.done bunny.obj volume.vtu
	.venv/bin/voxtool voxelize bunny.obj --dim 512 --mode solid
	.venv/bin/voxtool svo-info bunny.svo.h5
	.venv/bin/voxtool extract bunny.svo.h5 -o nets.ply
	.venv/bin/voxtool adf-build bunny.obj
	.venv/bin/voxtool render bunny.adf.h5
	.venv/bin/voxtool tet-build volume.vtu --scalar density
	.venv/bin/voxtool render volume.tet.h5 --opacity-range 0.1,0.5 --legend

quick: .venv/test.done
	$(PYTEST) --quick $(ARGS)

test: .venv/test.done
	$(PYTEST) $(ARGS)

soak: .venv/test.done
	.venv/bin/python -m pytest -m soak --soak $(SECONDS) $(if $(SEED),--seed $(SEED)) $(ARGS)

fuzz: .venv/test.done
	.venv/bin/python -m tests.fuzz --seconds $(SECONDS) $(if $(SEED),--seed $(SEED)) $(ARGS)

gpu-report: .venv/all.done
	.venv/bin/python -m tests.gpu_report $(DEVICE) $(ARGS)

golden: .venv/test.done
	.venv/bin/python -m tests.golden.$(KIND)

lint: .venv/test.done node_modules/lint.done
	.venv/bin/ruff check
	.venv/bin/ruff format --check
	.venv/bin/basedpyright
	.venv/bin/lint-imports
	PATH="$$PWD/.venv/bin:$$PATH" node_modules/.bin/tsc -p .
	PATH="$$PWD/.venv/bin:$$PATH" node_modules/.bin/biome lint --error-on-warnings voxtool/viewer/assets

docs: .venv/docs.done
	NO_MKDOCS_2_WARNING=1 .venv/bin/mkdocs build --clean --quiet

headers: .venv/all.done
	.venv/bin/python -m voxtool.opencl.headers

clean:
	rm -rf .venv node_modules bunny.obj bunny.svo.h5 nets.ply bunny.adf.h5 bunny.png volume.vtu volume.tet.h5 volume.png \
	    build dist .pytest_cache .ruff_cache .hypothesis .import_linter_cache
	find voxtool tests examples -name __pycache__ -type d -prune -exec rm -rf {} +

bunny.obj: examples/make_bunny.py | .venv/all.done
	.venv/bin/python examples/make_bunny.py -o $@

volume.vtu: examples/make_volume.py | .venv/all.done
	.venv/bin/python examples/make_volume.py -o $@

# The package is installed in place: again only when its metadata change.
.venv/all.done: pyproject.toml | .venv/bin/python
	$(PIP_INSTALL) -e '.[$(EXTRAS)]'
	@touch $@

.venv/test.done: pyproject.toml | .venv/bin/python
	$(PIP_INSTALL) -e '.[test]'
	@touch $@ .venv/all.done

# Tools for the scripts of pages: a type checker and a linter, of the npm registry, by pip's node.
node_modules/lint.done: package.json | .venv/test.done
	PATH="$$PWD/.venv/bin:$$PATH" .venv/bin/npm install --no-package-lock --no-fund --no-audit --silent
	@touch $@

.venv/docs.done: pyproject.toml | .venv/bin/python
	$(PIP_INSTALL) -e '.[docs]'
	@touch $@

.venv/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	    echo "voxtool needs Python 3.11 or newer, '$(PYTHON)' is not: make PYTHON=python3.12" >&2; \
	    exit 1; }
	$(PYTHON) -m venv .venv
