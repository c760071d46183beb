# `make demo` and `make test` work on a fresh Debian-like machine; no target needs a GPU.

SHELL := /bin/bash
CARGO := . scripts/env.sh && cargo

# How targets that use target/debug/tcgs build it; `make BUILD=: TARGET` takes it as the tests have built it.
BUILD ?= $(CARGO) build --locked --quiet

# Where the photo sets for `make results` are.
DATA ?= $(or $(TCGS_SHARED),../shared)/data

# What `make swiftshader` runs: kernels against their twins, gradients, repeated runs, and whole jobs.
SWIFTSHADER_TESTS ?= accuracy::every primitives raster_device loss:: neural:: offset_masks first_light::

# How long `make fuzz` gives each target.
FUZZ_SECONDS ?= 600

# How often `make soak` kills a process on each of two kinds of storage, and the tests that it runs.
KILLS ?= 105
SOAK_TESTS ?= system::soak system::crash_points system::io_faults system::reordered bucket_faults

.PHONY: help setup web build demo poses results long-results opponents ladder gate test examples schemathesis generated-client deb container-smoke manifests swiftshader validation interop viewer-pictures frame-times external-formats gpu-kit hardware-report fuzz soak lint clean

help: ## list the targets
	@sed -n 's/^\([a-z-]*\):.*## /  make \1\t/p' Makefile | expand -t 16

setup: ## install what this machine lacks (apt, rustup); silent when nothing is missing
	@scripts/setup.sh

web: setup ## build the viewer for browsers, which builds of tcgs after it embed
	@scripts/web.sh

build: web ## build target/release/tcgs
	@$(CARGO) build --release --locked

demo: web ## the bundled scene through the service: train, download, render into out/demo
	@scripts/demo.sh

poses: setup ## install pycolmap, through PyPI, and ffmpeg: with them jobs take photographs without cameras, and videos
	@scripts/poses.sh

# The runs of benches/$(1).toml, reported into out/$(1) and docs/$(2).md.
define report
@target="$${CARGO_TARGET_DIR:-target}"; "$$target/release/tcgs" bench report --suite "$(DATA)" --matrix benches/$(1).toml --output out/$(1) --table docs/$(2).md --figure docs/img/$(1).svg $(REPORT_FLAGS)
endef

results: build ## make the runs of benches/report.toml on the sets of DATA, report speed against error into out/report and rewrite docs/RESULTS.md; hours on a CPU
	$(call report,report,RESULTS)

long-results: build ## the same of benches/long.toml, whole runs of preview, into out/long and docs/LONG_RUNS.md
	$(call report,long,LONG_RUNS)

opponents: build ## the same of benches/opponents.toml, plain Gaussians pruned to a number beside the method, into docs/OPPONENTS.md
	$(call report,opponents,OPPONENTS)

ladder: build ## the same of benches/ladder.toml, sets at several sizes, into docs/LADDER.md
	$(call report,ladder,LADDER)

gate: setup ## hold PSNR, bytes and speed of two fixed scenes to scripts/gate.json; UPDATE=1 rewrites it
	@$(BUILD)
	@. scripts/env.sh && scripts/gate.py $(if $(UPDATE),--update)

test: setup ## all tests, with a count of those that were skipped; first installs what they need, where it can
	@. scripts/test_tools.sh; scripts/web.sh; scripts/test.sh

examples: setup ## run the documented session with curl and the client in Python against a service
	@$(CARGO) test --locked --test it examples::

schemathesis: setup ## hold a running service to openapi.yaml with schemathesis, which comes through PyPI
	@$(BUILD)
	@scripts/schemathesis.sh

swiftshader: setup ## tests of kernels and whole jobs on SwiftShader, a driver with narrow limits, from a Debian package
	@. scripts/env.sh && cargo test --locked --workspace --no-run --test it
	@. scripts/env.sh && scripts/swiftshader.sh cargo test --locked --workspace --test it -- $(SWIFTSHADER_TESTS)

gpu-kit: setup ## pack binaries and photographs for scripts/gpu_day.sh, to run on a GPU without cargo or a network
	@scripts/gpu_kit.sh

hardware-report: ## rewrite the tables of docs/HARDWARE.md from RUNS, the JSON files of scripts/gpu_day.sh
	@scripts/hardware.py $(RUNS)

frame-times: web ## print how long the viewer page takes for a picture in Chromium, on the processor, and the program beside it
	@$(CARGO) test --locked --test it -- --ignored --nocapture frame_times

deb: web ## pack target/release/tcgs as a Debian package in target/deb
	@scripts/build_deb.sh

validation: setup ## one short job under the Khronos validation layer, which comes from a Debian package
	@$(BUILD)
	@scripts/validation.sh

generated-client: setup ## generate a client in Python from openapi.yaml, through PyPI, and use it for a session
	@$(BUILD)
	@scripts/generated_client.sh

container-smoke: setup ## build the image of docker/Dockerfile around the debug build and use it, where podman and buildah run
	@$(BUILD)
	@scripts/container.sh

manifests: ## hold docker/kubernetes to Kubernetes' schemas, which come through PyPI
	@scripts/manifests.sh

interop: setup ## hold exports to splat-transform and usd-core, which come through npm and PyPI
	@scripts/splat_transform.sh --version
	@. scripts/env.sh && TCGS_SPLAT_TRANSFORM="$$(scripts/splat_transform.sh --where)" TCGS_USD_PYTHON="$$(scripts/usd_python.sh)" cargo test --locked --test it export:: -- --nocapture

viewer-pictures: ## draw the exports of SCENE with PlayCanvas in a browser, from the cameras in POSES; DATASET is what it was trained on
	@scripts/viewer_pictures.sh "$(SCENE)" "$(DATASET)" "$(OUT)" $(POSES)

external-formats: ## convert IN (a .ply of plain Gaussians) to .sog and .spz and back, into OUT
	@scripts/external_formats.sh "$(IN)" "$(OUT)"

fuzz: setup ## fuzz the decoder and every reader, FUZZ_SECONDS a target
	@scripts/fuzz.sh $(FUZZ_SECONDS)

soak: setup ## kill services and workers KILLS times on each kind of storage, then fail them at every named point and call; half an hour
	@. scripts/env.sh && TCGS_S3_SERVER="$$(scripts/s3_server.sh)" TCGS_SOAK_KILLS=$(KILLS) \
	timeout 3h cargo test --locked --test it -- --nocapture --test-threads 1 $(SOAK_TESTS)

lint: setup ## formatting, clippy, documentation, licenses
	@$(CARGO) fmt --all --check
	@$(CARGO) clippy --locked --workspace --all-targets -- -D warnings
	@$(CARGO) doc --locked --workspace --no-deps --quiet
	@. scripts/env.sh && scripts/deny.sh

lint: export RUSTDOCFLAGS := -D warnings

clean: ## remove what was built and what the demo wrote; reports in out/ stay
	@$(CARGO) clean --quiet
	@rm -rf out/demo out/gpu-kit
