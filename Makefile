# make demo    real nodes recover superquadrics from a simulated camera; writes demo.png and demo.glb
# make quick   the tests of the core: no processes, no ROS, no browser; about a minute
# make test    lint and the whole test suite, against the installed package
# make lint    ruff and mypy alone
# make speed   what a frame costs against a fixed loop and the classic fit, beside the figures last recorded
# make bench   every benchmark that needs no files of yours, hours
# make docs    the pages of docs/ as a site: site/index.html
# make clean   remove everything that these commands made
#
# PYTHON=python3.12     the interpreter, 3.10 to 3.13
# VENV=folder           where to install; .venv, or .venv-<distro> where a ROS 2 installation is sourced
# PIP_FLAGS='...'       options for pip, for instance --extra-index-url with PyTorch's index of CPU builds

PYTHON ?= python3
PIP_FLAGS ?=
SECONDS_SHOWN ?= 20

ifdef AMENT_PREFIX_PATH
# A ROS installation brings its own rclpy, whose compiled messages need the NumPy they were built for.
VENV ?= .venv-$(or $(ROS_DISTRO),ros)
REQUIREMENTS := '.[test]' 'numpy<2'
else
VENV ?= .venv
REQUIREMENTS := '.[ros,interfaces,test]'
endif

PIP := $(VENV)/bin/python -m pip --disable-pip-version-check
SOURCES := setup.py setup.cfg pyproject.toml package.xml resource/sq_perception $(wildcard resource/ros2_run/*) \
	$(wildcard config/*) $(wildcard launch_scripts/*.py) $(wildcard sq_msgs_py/*.py) \
	$(wildcard sq_perception/*.py) $(wildcard sq_perception/*/*.py) $(wildcard sq_perception/*/*/*.yaml) $(wildcard sq_perception/weights/*)

BESIDE := evaluation tracking
# Benchmarks that want files or another network.
ASKING := contact_graspnet known_frames picking_pictures point_pictures public_frames sensor_pictures worst_things
CORE := geometry files imaging segmentation fitting tracking sq_msgs_py

.PHONY: demo quick test test-computing test-processes lint speed bench docs install clean
.DEFAULT_GOAL := install

install: $(VENV)/.package

# Where python3-venv is missing, pip is brought into the environment from outside.
$(VENV)/bin/python:
	$(PYTHON) -c "import sys; sys.exit(0 if (3, 10) <= sys.version_info[:2] <= (3, 13) else \
		'Python 3.10 to 3.13 is needed, this is ' + sys.version)"
	@$(PYTHON) -m venv $(VENV) || { \
		echo "no ensurepip here: using the pip of $(PYTHON)" && \
		$(PYTHON) -m venv --clear --without-pip $(VENV) && \
		$(PYTHON) -m pip install --quiet --target \
			"$$($(VENV)/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')" pip; }

$(VENV)/.dependencies: setup.py | $(VENV)/bin/python
	$(PIP) install $(PIP_FLAGS) --upgrade pip 'setuptools>=68,<80' wheel
	$(PIP) install $(PIP_FLAGS) --no-build-isolation $(REQUIREMENTS)
	rm -rf build/lib build/bdist.* *.egg-info
	touch $@

$(VENV)/.package: $(VENV)/.dependencies $(SOURCES)
	$(PIP) install --quiet --no-deps --no-build-isolation --force-reinstall .
	rm -rf build/lib build/bdist.* *.egg-info
	$(VENV)/bin/sq-perception warm-up
	touch $@

demo: $(VENV)/.package
	$(VENV)/bin/sq-perception demo --seconds $(SECONDS_SHOWN)

# Of the sources, so that it need not wait for the package.
lint: $(VENV)/.dependencies
	$(VENV)/bin/ruff check .
	$(VENV)/bin/mypy

quick: $(VENV)/.package
	$(VENV)/bin/pytest $(addprefix test/,$(CORE)) -m "not process"

# Two at once: the lint while kernels are compiled, then tests that start processes, and mostly wait for them, beside
# those that compute.  Those of two rooms go with the first, so that both halves take equally long.
test: $(VENV)/.dependencies
	$(MAKE) --no-print-directory --jobs 2 --output-sync=target lint test-computing test-processes

# The executable, not `python -m pytest`: that would put the source tree before the installed package.
test-computing: $(VENV)/.package
	$(VENV)/bin/pytest test -m "not process" $(addprefix --ignore=test/,$(BESIDE))

test-processes: $(VENV)/.package
	$(VENV)/bin/pytest test -m process
	$(VENV)/bin/pytest $(addprefix test/,$(BESIDE)) -m "not process"

speed: $(VENV)/.package
	$(VENV)/bin/python benchmarks/speed.py --repeats 3

bench: $(VENV)/.package
	for script in $(filter-out $(addprefix benchmarks/,$(ASKING:=.py)),$(wildcard benchmarks/*.py)); do $(VENV)/bin/python "$$script" || exit 1; done

docs: $(VENV)/.package
	$(VENV)/bin/mkdocs build --strict

clean:
	rm -rf $(VENV) build install log dist site *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	rm -f demo.png demo.glb
