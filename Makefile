# make demo   set up, fit the shipped record, sample its posterior, write the report
# make test   set up, run the tests
PY = .venv/bin/python
# what the tests compile by themselves serves the next run; fitact keeps its own programs in the user's cache folder
export JAX_COMPILATION_CACHE_DIR = $(CURDIR)/out/jax
export JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS = 0
# a test runs what it compiles once or twice: XLA compiles in a third of the time where it optimises less; all else that
# is made here runs as users' programs do, and `make test TEST_XLA_FLAGS=` tests those. JAX 0.11 and later, of Python 3.12,
# end where a flag is unknown, as the first is to them; there, the others are left out, too
TEST_XLA_FLAGS = $(shell $(PY) -c 'from fitact.compiled import XLA_OPTIONS as o; print(("--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1 --xla_llvm_disable_expensive_passes=true") * ("xla_cpu_use_fusion_emitters" in o))') \
  --xla_backend_optimization_level=0
# each worker has a core; threads of BLAS that wait for each other's cores took half of the tests' time
PYTEST = XLA_FLAGS="$(TEST_XLA_FLAGS)" OPENBLAS_NUM_THREADS=1 $(PY) -m pytest -n auto
.DEFAULT_GOAL = help
.PHONY: help env demo picture test test-slow test-slow-quick notebooks peers docs wheel extremes calibration calibration-quick session-calibration bench-calibration study-calibration fuzz check lock plotly axe clean

help:
	@sed -n 's/^# \(make .*\)/\1/p' Makefile

env:
	@sh tools/make_env.sh

demo: env
	.venv/bin/fitact run data_synth/records/finger_direct.csv --scene data_synth/records/finger_direct.toml --out out/demo --seed 1

# make picture   the demo's report as the picture of README.md, docs/report.png; needs Chromium
picture: demo
	$(PY) tools/picture_report.py

test: env
	$(PYTEST) --dist loadfile -m "not slow"

# make test-slow   the tests that `make test` leaves out for their time
test-slow: env
	$(PYTEST) -m slow

# make test-slow-quick   a part of these, another for every change that landed
LANDED = $(shell git rev-list --first-parent --count HEAD 2>/dev/null || date +%j)
test-slow-quick: env
	$(PYTEST) -m slow --rotate $(LANDED)/32

# make notebooks   run the notebooks; executed copies in out/notebooks
notebooks: env
	$(PY) tools/run_notebooks.py notebooks/[1-57]_*.py

# make peers   the notebook on other fitters, which run in an environment of their own, out/peers
peers: env
	.venv/bin/uv venv --quiet --allow-existing --python $(PY) out/peers
	.venv/bin/uv pip install --quiet --no-deps --require-hashes --python out/peers/bin/python -r notebooks/peers/requirements.txt
	$(PY) tools/run_notebooks.py notebooks/6_other_fitters.py

# make docs   the documentation, out/site/index.html; runs the notebooks that have no copy yet, or an older one
# (but the sixth, whose other fitters want an environment of their own: its figures are there once it has been run)
docs: env $(patsubst notebooks/%.py,out/notebooks/%.ipynb,$(filter-out notebooks/6_%,$(wildcard notebooks/*.py)))
	NO_MKDOCS_2_WARNING=1 .venv/bin/mkdocs build --quiet --strict

out/notebooks/%.ipynb: notebooks/%.py | env
	$(PY) tools/run_notebooks.py $<

# make wheel   out/wheel, tried alone in an empty environment; `make wheel EXTRA=arviz` with an extra, for its size
wheel: env
	sh tools/try_wheel.sh $(EXTRA)

# make extremes   the worst point of every quantity over the whole range of parameters, against mpmath
extremes: env
	$(PY) -m tests.extremes

# make calibration   1,000 simulated records through fit and sampler: are the posteriors right? (goes on where it ended)
calibration: env
	$(PY) -m tests.calibration --records 1000 --out out/calibration

# make session-calibration   1,000 simulated sessions with errors of instruments: are the stated uncertainties right?
session-calibration: env
	$(PY) -m tests.session_calibration --sessions 1000 --out out/session_calibration

# make bench-calibration   500 simulated benches with noise of V, delays, hum: are the stated uncertainties right?
bench-calibration: env
	$(PY) -m tests.bench_calibration --records 500 --out out/bench_calibration

# make study-calibration   200 simulated studies of people and touches: are the stated spreads and forecasts right?
study-calibration: env
	$(PY) -m tests.study_calibration --studies 200 --out out/study_calibration

# make calibration-quick   the same with the first 100 of them
calibration-quick: env
	$(PY) -m tests.calibration --records 100 --out out/calibration

# make fuzz   20,000 broken files: each ends in a record or in one sentence
fuzz: env
	$(PY) -m tests.fuzz --count 20000

# make check   style, types, the order of the layers, and how docstrings begin
check: env
	.venv/bin/ruff check .
	.venv/bin/ruff check --preview --select PLW1514 fitact data_synth tools benchmarks  # UTF-8 on every system
	.venv/bin/ruff format --check .
	.venv/bin/mypy
	.venv/bin/lint-imports
	$(PY) tools/check_prose.py fitact data_synth tests tools benchmarks notebooks

# make lock   lock the newest versions of the dependencies
lock: env
	.venv/bin/uv pip compile --quiet --upgrade --universal --all-extras --generate-hashes --no-emit-index-url --no-header pyproject.toml -o requirements/all.txt
	.venv/bin/uv pip compile --quiet --upgrade --universal --override notebooks/peers/override.txt --generate-hashes --no-emit-index-url --no-header notebooks/peers/requirements.in -o notebooks/peers/requirements.txt
	echo uv | .venv/bin/uv pip compile --quiet --upgrade --universal --generate-hashes --no-emit-index-url --no-header - -o requirements/uv.txt

# make plotly   renew the script that draws the pages' charts: plotly.js, basic bundle, MIT, from npm
plotly:
	cd fitact/report/templates && npm pack --silent plotly.js-basic-dist-min && tar -xzf plotly.js-*.tgz --strip-components=1 \
	  package/plotly-basic.min.js package/LICENSE && mv LICENSE plotly-basic.LICENSE && rm plotly.js-*.tgz

# make axe   fetch axe-core, the accessibility checks of the page's tests, from npm; it is not part of fitact
axe:
	mkdir -p out && cd out && npm pack --silent axe-core && tar -xzf axe-core-*.tgz --strip-components=1 package/axe.min.js && rm axe-core-*.tgz

# make clean   remove what the above made
clean:
	rm -rf .venv out
