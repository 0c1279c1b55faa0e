#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed fixture fails the test")]

mod between;
mod divergence;
mod fixtures;
mod inserted_rows;
mod laws;
mod line_faults;
mod live_tap;
mod lock_in;
mod model;
mod non_finite_drive;
mod peaks;
mod refused_configuration;
mod rejected_commands;
mod replaced_board;
mod returning_port;
mod safe_end;
mod second_answers;
