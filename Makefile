# Each target needs only make and a Python 3.12 or newer; .venv is made when it is missing or stale.

.PHONY: style validate stability bench beside contact refine design scenes paper notebooks pictures demo test test-all lint lock clean environment flanges cad strangers fuzz killed docs quick waiting planted sweeps

# Byte code is kept in .venv even where the environment tells Python to write none (many containers do): without it
# every start of a command compiles JAX and matplotlib anew, for three seconds.
export PYTHONDONTWRITEBYTECODE :=

# Whole files go to two processes, in the order of tests/conftest.py.
PARALLEL := -n 2 --dist loadfile --no-loadscope-reorder

# The variable keeps pyright from asking the network whether there is a newer one.
TYPES := PYRIGHT_PYTHON_IGNORE_WARNINGS=1 .venv/bin/pyright

# A command, and the check of types beside it, which waits for no program to compile; both have to pass.
define beside_types
@$(TYPES) >.venv/types.txt 2>&1 & types=$$!; $(1); tests=$$?; wait $$types; types=$$?; \
cat .venv/types.txt; exit $$((tests + types > 0))
endef

# Inverse design: the initial thickness that forms a dish of uniform wall.
demo: environment
	.venv/bin/jaxform optimize dish-uniform-wall --out out/demo --force
	@echo
	@echo "Look in out/demo: design.png, thickness.png and convergence.png (pictures), summary.json, history.csv,"
	@echo "final.vtu (for ParaView), best.toml (run it again with: .venv/bin/jaxform simulate out/demo/best.toml --out out/best)"

# Of each property the cheapest test that holds it. Types are checked meanwhile: their findings are printed in the end.
test: style
	$(call beside_types,.venv/bin/python -m pytest -m "not long" $(PARALLEL))

# Every test; those marked `long` hold by more or larger scenes what a shorter one holds, or what a user waits for as long.
test-all: style
	$(call beside_types,.venv/bin/python -m pytest $(PARALLEL))

# The site, in out/docs; a warning is an error. No network is used.
docs: environment
	.venv/bin/python -m sphinx --fail-on-warning --keep-going --quiet --builder html docs out/docs
	@echo "Open out/docs/index.html"

# What a developer runs while working; the first time it compiles what the next ones find.
quick: environment
	.venv/bin/python -m pytest -m quick -n 2 --dist loadfile -q

style: environment
	.venv/bin/ruff check
	.venv/bin/ruff format --check

lint: style
	$(TYPES) --threads 2

lock:
	@tools/environment.sh lock

# The pictures of the README, drawn from runs.
pictures: environment
	.venv/bin/jaxform simulate dish --out out/dish --force
	.venv/bin/jaxform optimize dish-uniform-wall --out out/demo --force
	cp out/dish/thickness.png docs/dish.png
	cp out/demo/design.png docs/design.png

# What refinement buys and costs, against exact and fine solutions; about ten minutes.
refine: environment
	.venv/bin/python -m benchmarks.accuracy.refinement

# How thin the soap bottle becomes, and what that depends on; a few minutes.
scenes: environment
	.venv/bin/python -m benchmarks.paper.bottle

# The paper's figures, animations and tables of docs/scenes.md, from our own runs; about ten minutes.
paper: environment
	.venv/bin/python -m benchmarks.paper

# Runs the notebooks and writes their outputs back; about ten minutes.
notebooks: environment
	.venv/bin/python -m benchmarks.notebooks

# Errors against exact and independent solutions at three meshes each, what an error costs in time, how slow is slow
# enough; writes docs/accuracy.md from docs/accuracy.json; about ten minutes. Parts by name:
# `.venv/bin/python -m benchmarks.accuracy cases`.
validate: environment
	.venv/bin/python -m benchmarks.accuracy

# The built-in studies' figures, and the search beside Nelder-Mead, CMA-ES and others; writes docs/design.md from
# docs/design.json; about half an hour. Parts by name: `.venv/bin/python -m benchmarks.design pressure`.
design: environment
	.venv/bin/python -m benchmarks.design

# How hard it is to break: steps against the true limit, energy over a million steps, two thousand random scenes,
# gradients, float32; writes docs/stability.md from docs/stability.json; the random scenes
# take five minutes, those with several tools ten. Parts by name: `.venv/bin/python -m benchmarks.stability edge drift random gradients float32`.
stability: environment
	.venv/bin/python -m benchmarks.stability
	.venv/bin/python -m benchmarks.stability.tools

# Damaged scenes, studies, meshes, caches and journals in thousands: no traceback, no hang, no memory without bounds; about half
# an hour. Parts by name: `.venv/bin/python -m benchmarks.hostile.fuzz meshes=100`; one case: `... meshes:17`.
fuzz: environment
	.venv/bin/python -m benchmarks.hostile.fuzz
	.venv/bin/python -m benchmarks.hostile.fuzz_journals 200

# Whether the tests find faults of one line in element, step, contact, refinement, adjoint, models and readers, planted one
# at a time in a copy of the tree; an hour. Some: `.venv/bin/python -m benchmarks.planted_faults adjoint`.
planted: environment
	.venv/bin/python -m benchmarks.planted_faults

# What `kill -9` at random moments loses: simulate and optimize killed 40 times each, then run again; ten minutes.
killed: environment
	.venv/bin/python -m benchmarks.hostile.killed

# Contact: hits against brute force, its cost, gradients through it, penetration; about five minutes.
contact: environment
	.venv/bin/python -m benchmarks.speed.contact

# Molds whose flange lies in the sheet's plane or a rounding error beside it: sixty scenes, stable and within one percent
# of a fine uniform sheet; about a quarter of an hour on a quiet machine, `--few` an eighth of it.
flanges: environment
	.venv/bin/python -m benchmarks.strangers.flanges

# Molds from a CAD kernel through `jaxform check` and `jaxform simulate`: forty scenes, about half an hour. Gmsh is in no
# lock: it is 90 MB and needs libraries of a desktop, so whoever runs this installs it (`pip install gmsh`).
cad: environment
	.venv/bin/python -m benchmarks.strangers.cad

# Thirty-eight kinds of files as strangers have them (bucks, scans, cups, crates, bottles, tubes) through `jaxform new` and
# `jaxform simulate`: what is refused, what is filled; about an hour. Some of them: `.venv/bin/python -m
# benchmarks.strangers.files --few`.
strangers: environment
	.venv/bin/python -m benchmarks.strangers.files

# Speed beside C++, NumPy and numba, cost of gradients, what each skip saves; about ten minutes.
bench: environment
	.venv/bin/python -m benchmarks.speed

# What a command does beside the steps, for sheets of 100 000 and 400 000 elements; a few minutes.
beside: environment
	.venv/bin/python -m benchmarks.speed.beside

# How long one waits before the first step: first and second scenes of a kind, the command, a sweep; some minutes.
waiting: environment
	.venv/bin/python -m benchmarks.speed.waiting

# Sweeps: 200 designs on four workers of a Dask cluster that are killed every few seconds, the client, too; four workers on
# a cold cache; 64 designs on one worker and on two; memory of a worker; about ten minutes. Parts by name:
# `.venv/bin/python -m benchmarks.sweeps stress client cold designs memory`.
sweeps: environment
	.venv/bin/python -m benchmarks.sweeps

# Removes what the other targets made, results of other runs under out/ excepted.
clean:
	rm -rf .venv .uv .pytest_cache .ruff_cache .hypothesis jaxform.egg-info out/demo
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

environment:
	@tools/environment.sh venv
