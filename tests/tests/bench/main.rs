//! Tests the whole bench with its program and its libraries.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test that cannot go on ends by panicking"
)]

mod accept;
mod board_matrix;
mod board_quarantine;
mod boards;
mod campaign;
mod campaign_chains;
mod campaign_engines;
mod campaign_responses;
mod changing_controller;
mod chip_faults;
mod closed_loop;
mod controller_end;
mod crate_layers;
mod debugger;
mod deciding_reason;
mod determinism;
mod ends_from_outside;
mod exit_codes;
mod explore;
mod extreme_inputs;
mod fail_fast;
mod files_of_0_3;
mod firmware_output;
mod fmi;
mod golden;
mod identify;
mod line_faults;
mod live;
mod margins;
mod merge;
mod output_formats;
mod own_law;
mod planted_links;
mod python_package;
mod real_plate;
mod real_time;
mod replay;
mod report_content;
mod rigs;
mod safe_exit;
mod scenarios;
mod schemas;
mod sealed_trials;
mod serial_line;
mod settings_of_others;
mod signals;
mod starter_c;
mod stored_runs;
mod terminal;
mod test_folder;
mod time_limit;
mod trend;
mod tune;
mod watch;
mod ways_of_playing;
