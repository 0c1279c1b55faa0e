//! Conducts an acceptance session: plan, operator, board, and a sealed, signed record.
//!
//! * [`plan`]: the plan file, which states the requirements.
//! * [`config`]: describes a session and who observes it.
//! * [`conduct()`]: conducts it step by step (`steps`); a session that was interrupted resumes.
//! * `ask`: questions; `self_test`: tests the bench; `scenario_run`: plays a scenario; `judge`:
//!   judges requirements.
//! * `provenance`: the bench, rig, inputs and firmware that a session may not change.
//! * [`session_record`] reads and writes `session.json`.
//! * [`manifest`], [`signature`]: SHA-256 of every file, and the signature of that list.
//! * [`mod@verify`]: checks a sealed record.
//! * [`page`] writes `record.html`.
//!
//! `platebench-runner` plays scenarios and `platebench-verdict` judges them. The terminal belongs
//! to the command line.

mod ask;
pub mod config;
mod error;
mod judge;
pub mod manifest;
pub mod page;
pub mod plan;
mod provenance;
mod scenario_run;
mod self_test;
pub mod session_record;
pub mod session_runner;
pub mod signature;
mod steps;
pub mod verify;

pub use config::{SessionConfig, SessionDetails, SessionHooks, SessionObserver};
pub use error::AcceptError;
pub use plan::Plan;
pub use session_record::SessionRecord;
pub use session_runner::conduct;
pub use signature::{PublicKey, SecretKey};
pub use verify::{Finding, Signer, Verification, verify};
