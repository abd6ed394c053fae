# make demo   set up, fit the shipped record, sample its posterior, write the report
# make test   set up, run the tests
PY = .venv/bin/python
# what one process of the tests compiles serves the others, and the next run
COMPILED = JAX_COMPILATION_CACHE_DIR=$(CURDIR)/out/jax JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS=0
.DEFAULT_GOAL = help
.PHONY: help env demo test test-slow test-slow-quick notebooks peers docs extremes calibration calibration-quick fuzz check lock plotly clean

help:
	@sed -n 's/^# \(make .*\)/\1/p' Makefile

env:
	@sh tools/make_env.sh

demo: env
	.venv/bin/fitact run data_synth/records/finger_direct.csv --scene data_synth/records/finger_direct.toml --out out/demo --seed 1

test: env
	$(COMPILED) $(PY) -m pytest -n auto --dist loadfile -m "not slow"

# make test-slow   the tests that `make test` leaves out for their time
test-slow: env
	$(COMPILED) $(PY) -m pytest -n auto -m slow

# make test-slow-quick   the same without the thorough ones, which are more than CI has time for
test-slow-quick: env
	$(COMPILED) $(PY) -m pytest -n auto -m "slow and not thorough"

# make notebooks   run the notebooks; executed copies in out/notebooks
notebooks: env
	$(COMPILED) $(PY) tools/run_notebooks.py notebooks/[1-5]_*.py

# make peers   the notebook on other fitters, which run in an environment of their own, out/peers
peers: env
	.venv/bin/uv venv --quiet --allow-existing --python $(PY) out/peers
	.venv/bin/uv pip install --quiet --no-deps --require-hashes --python out/peers/bin/python -r notebooks/peers/requirements.txt
	$(COMPILED) $(PY) tools/run_notebooks.py notebooks/6_other_fitters.py

# make docs   the documentation, out/site/index.html; runs the notebooks that have no copy yet, or an older one
# (but the sixth, whose other fitters want an environment of their own: its figures are there once it has been run)
docs: env $(patsubst notebooks/%.py,out/notebooks/%.ipynb,$(filter-out notebooks/6_%,$(wildcard notebooks/*.py)))
	NO_MKDOCS_2_WARNING=1 .venv/bin/mkdocs build --quiet --strict

out/notebooks/%.ipynb: notebooks/%.py | env
	$(COMPILED) $(PY) tools/run_notebooks.py $<

# make extremes   the worst point of every quantity over the whole range of parameters, against mpmath
extremes: env
	$(PY) tests/extremes.py

# make calibration   1,000 simulated records through fit and sampler: are the posteriors right? (goes on where it ended)
calibration: env
	$(PY) tests/calibration.py --records 1000 --out out/calibration

# make calibration-quick   the same with the first 100 of them
calibration-quick: env
	$(PY) tests/calibration.py --records 100 --out out/calibration

# make fuzz   20,000 broken files: each ends in a record or in one sentence
fuzz: env
	$(PY) tests/fuzz.py --count 20000

# make check   style, types, and the order of the layers
check: env
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy
	.venv/bin/lint-imports

# make lock   lock the newest versions of the dependencies
lock: env
	.venv/bin/uv pip compile --quiet --upgrade --universal --all-extras --generate-hashes --no-emit-index-url --no-header pyproject.toml -o requirements/all.txt
	.venv/bin/uv pip compile --quiet --upgrade --universal --override notebooks/peers/override.txt --generate-hashes --no-emit-index-url --no-header notebooks/peers/requirements.in -o notebooks/peers/requirements.txt
	echo uv | .venv/bin/uv pip compile --quiet --upgrade --universal --generate-hashes --no-emit-index-url --no-header - -o requirements/uv.txt

# make plotly   renew the script that draws the pages' charts: plotly.js, basic bundle, MIT, from npm
plotly:
	cd fitact/report/templates && npm pack --silent plotly.js-basic-dist-min && tar -xzf plotly.js-*.tgz --strip-components=1 \
	  package/plotly-basic.min.js package/LICENSE && mv LICENSE plotly-basic.LICENSE && rm plotly.js-*.tgz

# make clean   remove what the above made
clean:
	rm -rf .venv out
