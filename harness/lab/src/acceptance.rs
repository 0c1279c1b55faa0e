//! Conducts an acceptance session with plan, operator and board, and writes a sealed, signed
//! record.

mod ask;
pub mod config;
mod decision;
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

pub use config::{SessionConfig, SessionHooks, SessionObserver};
pub use decision::PlanDecision;
pub use error::AcceptError;
pub use plan::Plan;
pub use session_record::{SessionDetails, SessionRecord};
pub use session_runner::play_session;
pub use signature::{PublicKey, SecretKey};
pub use verify::{Finding, Signer, Verification, verify};
