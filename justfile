# Commands of people and CI. `just` lists them; docs/CONTRIBUTING.md explains them.

# List the recipes.
default:
    @just --list

# Run scenarios with an optimised bench and write a report.
run *ARGS:
    cargo platebench run {{ARGS}}

# Compile everything and check lints.
check:
    cargo clippy --workspace --all-targets --features platebench-rig/probe --locked --ignore-rust-version -- -D warnings

# Format the code.
format:
    cargo fmt --all

# Run all tests.
test:
    cargo test-all

# Run the tests of one crate, for example `just test-crate plate`.
test-crate NAME *ARGS:
    cargo test --ignore-rust-version -p platebench-{{NAME}} {{ARGS}}

# Install the programs that some tests need (Debian).
tools:
    ci/install-test-tools

# Build the firmware and compare the committed images; `just firmware --update` writes them.
firmware *ARGS:
    ci/firmware {{ARGS}}

# Compare the instructions per step of the plate; `just counts --update` writes them.
counts *ARGS:
    ci/counts {{ARGS}}

# Measure the speed of the bench; programs as arguments are measured in turn.
speed *ARGS:
    ci/speed {{ARGS}}

# Regenerate docs/reference-*.md.
reference:
    ci/reference --update

# Build the documentation as a book.
book:
    ci/book

# Print lines of code, tests and comments per crate.
size:
    ci/size

# Build the static executable with debug probes.
release:
    ci/release

# Run everything that must pass before a change lands.
ci:
    .ci/run
