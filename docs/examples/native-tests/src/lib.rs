//! Holds the project's own code. `tests/scenarios.rs` runs its scenarios.
