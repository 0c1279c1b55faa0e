//! Where a project has its own code. Its scenarios are played by `tests/scenarios.rs`.
