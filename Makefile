# `make lamp` and `make test` do their own set-up. The targets of a run are the stages' manifests;
# vorolight itself decides what is stale, so every recipe is tried and an up-to-date stage is skipped.
PYTHON ?= python3
VENV ?= .venv
INPUT ?= bunny.obj
N ?= 25
SEED ?= 0
THREADS ?= $(shell $(PYTHON) -c "import os; print(os.cpu_count() or 1)")
INNER ?= 800
FABRICATE ?= --lamp
FACES ?= triangle

BIN := $(VENV)/bin
RUN ?= $(if $(RUNS),$(RUNS)/)$(basename $(notdir $(INPUT))).vorolight
COMMON = --run $(RUN) --seed $(SEED) --threads $(THREADS) $(if $(CONFIG),--config $(CONFIG))
PIP = $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt

.DELETE_ON_ERROR:
# The stages of one run share a folder and its lock; each of them uses all threads itself.
ifndef SHAPES
.NOTPARALLEL:
endif
.PHONY: pictures-edges table-spacing corpus lamp run shapes test test-all test-slurm concurrency kills write-points corruptions bench bench-init bench-solvers bench-stages bench-overhead bench-volume side-by-side table table-clouds table-views table-found-views table-photos table-baseline table-lamps tables bench-images table-found table-scales table-inputs check packages schemas pictures clean always

lamp:
	@$(MAKE) --no-print-directory run INPUT=bunny.obj
	@echo "The lamp: $(RUN)/fabricate.stl   What was measured: $(RUN)/report.html"

run: $(RUN)/report.html

# Many shapes, some at a time: make -j2 shapes SHAPES="a.ply heart" THREADS=1
ifneq ($(words $(SHAPES)),$(words $(sort $(basename $(notdir $(SHAPES))))))
$(error two of SHAPES would share a run folder; rename one)
endif
shapes: $(SHAPES:%=shapes/%)
shapes/%: always | $(VENV)/installed
	@$(MAKE) --no-print-directory run INPUT=$* SHAPES=

bunny.obj airplane.obj cow.obj bone.ply: | $(VENV)/installed
	$(BIN)/vorolight sample $(basename $@)

SAMPLE = $(filter bunny.obj airplane.obj cow.obj bone.ply,$(INPUT))
$(RUN)/classify.json: $(SAMPLE) $(wildcard $(INPUT)) always | $(VENV)/installed
	@$(BIN)/vorolight classify $(INPUT) -n $(N) $(COMMON)
$(RUN)/init.json: $(RUN)/classify.json always
	@$(BIN)/vorolight init $(COMMON)
$(RUN)/sphere-train.json: $(RUN)/init.json always
	@$(BIN)/vorolight sphere-train --faces $(FACES) $(COMMON)
$(RUN)/volume.json: $(RUN)/sphere-train.json always
	@$(BIN)/vorolight volume --inner $(INNER) $(COMMON)
$(RUN)/evaluate-%.json: $(RUN)/%.json always
	@$(BIN)/vorolight evaluate --of $* $(COMMON)
$(RUN)/fabricate.json: $(RUN)/sphere-train.json always
	@$(BIN)/vorolight fabricate $(FABRICATE) $(COMMON)
$(RUN)/report.html: $(RUN)/volume.json $(RUN)/evaluate-init.json $(RUN)/evaluate-sphere-train.json \
		$(RUN)/fabricate.json
	@$(BIN)/vorolight report --run $(RUN)

$(VENV)/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(PIP) -e .
	@touch $@
# What the tests need includes all the rest: one installation instead of two.
$(VENV)/tested-with: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(PIP) -e '.[test]'
	@touch $(VENV)/installed $@

$(VENV)/benched-with: $(VENV)/installed
	$(PIP) -e '.[bench]'
	@touch $@

# Two files of tests at a time, the long ones first: most of their time is one thread's.
PYTEST = OMP_WAIT_POLICY=PASSIVE $(BIN)/python -m pytest -n 2 --dist loadscope --no-loadscope-reorder --durations=20
test: $(VENV)/tested-with
	$(PYTEST)
test-all: $(VENV)/tested-with
	$(PYTEST) -m 'not slurm'
# Needs root, and Debian's slurmctld, slurmd, slurm-client and slurm-wlm-basic-plugins.
test-slurm: $(VENV)/tested-with
	$(BIN)/python -m pytest -m slurm tests/test_slurm.py

# Eight shapes by every way of running many at once: the same bytes, and how long each takes.
concurrency: $(VENV)/tested-with
	$(BIN)/python tests/benchmarks/concurrency.py

bench: $(VENV)/benched-with
	$(BIN)/python tests/benchmarks/interface.py

# The linear systems of the training, by several solvers.
bench-solvers: $(INPUT) $(VENV)/benched-with
	$(BIN)/python tests/benchmarks/solvers.py $(INPUT) -n $(RESOLUTIONS)

# Time, memory and their growth, stage by stage.
RESOLUTIONS ?= 25 50
BACKEND ?= scipy
bench-stages: $(INPUT) $(VENV)/installed
	$(BIN)/python tests/benchmarks/stages.py $(INPUT) -n $(RESOLUTIONS) --faces $(TABLE_FACES) --backend $(BACKEND)

# What checkpoints, manifests, checksums, logs and locks cost, as a share of each stage.
bench-overhead: $(INPUT) $(VENV)/installed
	$(BIN)/python tests/benchmarks/overhead.py $(INPUT) -n $(N)

# Certificate, distances and smoothness of shapes, beside another method's.
MESHES ?= $(wildcard *.ply)
TABLE_FACES ?= triangle
table: $(VENV)/installed
	$(BIN)/python tests/benchmarks/surfaces.py -n $(N) --faces $(TABLE_FACES) \
		$(if $(PEER),--peer $(PEER)) $(foreach shape,$(MESHES),$(or $(wildcard $(shape)/*.ply),$(shape)))

# Shapes of known topology, made by exact solids: certificate, topology, distance, time, one by one.
COUNT ?= 200
corpus: $(VENV)/tested-with
	$(BIN)/python tests/corpus.py -n $(N) --count $(COUNT) --folder corpus

# Varied edge lengths beside even ones, with the same number of triangles.
FACES_TARGET ?= 4000
table-spacing: $(VENV)/installed
	$(BIN)/python tests/benchmarks/spacings.py -n $(N) --faces $(FACES_TARGET) \
		$(foreach shape,$(MESHES),$(or $(wildcard $(shape)/*.ply),$(shape)))

# Edges without creases, along creases, and of varied lengths, side by side: examples/edges.png.
pictures-edges: $(VENV)/installed $(if $(MESHES),,bunny.obj)
	$(BIN)/python tests/benchmarks/edges.py -n 15 --output examples/edges.png \
		$(or $(MESHES),cube-cavity bunny.obj)

# Point clouds sampled on meshes, compared with them; NOISE is in percent of the diagonal.
POINTS ?= 153600
NOISE ?= 0
table-clouds: $(VENV)/installed
	$(BIN)/python tests/benchmarks/clouds.py -n $(N) --points $(POINTS) --noise $(NOISE) \
		$(if $(PEER),--peer $(PEER)) $(foreach shape,$(MESHES),$(or $(wildcard $(shape)/*.ply),$(shape)))

# Pictures drawn of meshes, run and compared with them; MASKS=1 leaves the normal maps out.
COUNT ?= 300
table-views: $(VENV)/installed
	$(BIN)/python tests/benchmarks/views.py --count $(COUNT) $(if $(MASKS),--masks-only) \
		$(foreach shape,$(MESHES),$(or $(wildcard $(shape)/*.ply),$(shape)))

# Six views spoiled as generators and people spoil them, with a row for each way; none silently wrong.
table-found-views: cow.obj $(VENV)/installed
	$(BIN)/python tests/benchmarks/found_views.py cow.obj

# Another method's published algorithm, beside what its own code reaches.
METHOD ?= voromesh
table-baseline: $(VENV)/installed
	$(BIN)/python tests/benchmarks/baseline.py --method $(METHOD) --seed $(SEED) \
		$(if $(PEER),--peer $(PEER)) $(foreach shape,$(MESHES),$(or $(wildcard $(shape)/*.ply),$(shape)))

# Views as found: how well masks and pictures are met.
table-photos: $(VENV)/installed
	$(BIN)/python tests/benchmarks/photos.py $(VIEWS)

# Lamps that were built: RUNS are their run folders.
table-lamps: $(VENV)/installed
	$(BIN)/python tests/benchmarks/lamps.py $(RUNS)

# The paper's tables and studies, to examples/results.md: DATA is a folder of meshes, ONLY some of
# fields meshes resolutions inner pipeline noise images, QUICK=1 small runs for trying it out.
WORK ?= examples/$(if $(QUICK),quick,tables)
tables: $(VENV)/installed
	$(BIN)/python tests/benchmarks/tables.py --work $(WORK) $(if $(DATA),--data $(DATA)) \
		--output $(if $(QUICK),$(WORK),examples)/results.md $(if $(QUICK),--quick) \
		$(if $(ONLY),--only $(ONLY))

# A step of the image losses, against an independent renderer.
bench-images: $(VENV)/benched-with
	$(BIN)/python tests/benchmarks/rasterizing.py

# Shapes as found, compared with what is made of them.
table-found: $(VENV)/installed
	$(BIN)/python tests/benchmarks/found.py -n $(N) $(MESHES)

# One mesh in other units and frames.
table-scales: $(INPUT) $(VENV)/installed
	$(BIN)/python tests/benchmarks/scales.py -n $(N) $(INPUT)

# All tables of inputs: MESHES is a folder of clean meshes, FOUND are files as found.
table-inputs:
	for noise in 0 0.1 0.5 1 2; do $(MAKE) --no-print-directory table-clouds NOISE=$$noise || exit; done
	$(MAKE) --no-print-directory table-clouds POINTS=10000
	$(MAKE) --no-print-directory table-found MESHES="$(FOUND)"
	$(MAKE) --no-print-directory table-scales

# Small runs that are killed at random times, meet a fault at every write, or whose files are damaged.
KILLS ?= 200
kills: $(VENV)/tested-with
	$(BIN)/python tests/benchmarks/kills.py --kills $(KILLS) --seed $(SEED)
write-points: $(VENV)/tested-with
	$(BIN)/python tests/benchmarks/write_points.py --seed $(SEED)
corruptions: COUNT = 1000
corruptions: $(VENV)/tested-with
	$(BIN)/python tests/benchmarks/corruptions.py --count $(COUNT) --seed $(SEED)
	$(BIN)/python tests/benchmarks/attacks.py --seed $(SEED)

# Loss against iterations, by several optimisers of the first surface.
bench-init: $(INPUT) $(VENV)/installed
	$(BIN)/python tests/benchmarks/first_surface.py $(INPUT) -n $(N)

# Inner cells: time, memory, how far the tessellation is, and what checkMesh says if it is there.
INNER_COUNTS ?= 800 20000
bench-volume: $(SAMPLE) $(wildcard $(INPUT)) $(VENV)/installed
	$(BIN)/python tests/benchmarks/volume.py $(INPUT) -n $(N) --inner $(INNER_COUNTS)

# Initial surface, the paper's training, triangles and polygons, for the eye.
OUTPUT ?= build/pictures
side-by-side: $(VENV)/installed
	$(BIN)/python tests/benchmarks/pictures.py $(MESHES) -n $(N) --output $(OUTPUT)

# Lint, and type-check the package as the wheel installs it while that runs a first shape.
check: $(VENV)/tested-with
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	rm -rf build && mkdir -p build/check
	$(BIN)/python -m pip wheel --quiet --no-deps -w build/check/dist .
	$(BIN)/python -m pip install --quiet --no-deps --target build/check/site build/check/dist/*.whl
	cd build/check && { MYPYPATH=site ../../$(BIN)/mypy --config-file ../../pyproject.toml \
		--python-executable ../../$(BIN)/python --namespace-packages --explicit-package-bases \
		-p vorolight.cli -p vorolight.schemas -p vorolight.stages & types=$$!; \
		PYTHONPATH=site ../../$(BIN)/python -m vorolight.cli run sphere -n 6 \
		--until volume --inner 20 --force --quiet; ran=$$?; wait $$types && exit $$ran; }

# The wheel, built from the source archive, in clean environments of these Pythons.
PYTHONS ?= python3.11 python3.12 python3.13
packages: $(VENV)/tested-with
	rm -rf build/packages
	$(BIN)/python -m build --outdir build/packages .
	$(BIN)/python tests/benchmarks/packages.py --wheel build/packages/*.whl $(PYTHONS)

schemas: $(VENV)/installed
	$(BIN)/python -m vorolight.schemas.build

# The pictures of the README, from runs of the tool itself.
pictures: | $(VENV)/installed
	@$(MAKE) --no-print-directory run INPUT=bunny.obj
	@$(MAKE) --no-print-directory run INPUT=heart
	$(BIN)/vorolight report --run bunny.vorolight --pictures examples
	$(BIN)/vorolight report --run heart.vorolight --pictures examples
	test -f chameleon.pts || $(BIN)/vorolight sample chameleon
	$(BIN)/vorolight classify chameleon.pts --preview
	cp chameleon.vorolight/classify.png examples/chameleon-preview.png
	@$(MAKE) --no-print-directory -C examples

clean:
	rm -rf build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
always:
