//! An acceptance session: a plan, a person, a board, and a record that shows when it was changed.
//!
//! * [`plan`]: the plan file, which owns what each requirement says.
//! * [`session`]: `session.json`, what is known of a session at any time.
//! * [`order`]: what is to be done, and whom a session talks to.
//! * `ask`: what an answer of the person does to a session, and what no answer does.
//! * `basis`: what a session stands on, and nobody goes on with anything else.
//! * [`mod@conduct`]: from step to step; what was killed goes on where it was.
//! * `self_test`: the bench's own timing, its repeatability and how well it catches faulty controllers.
//! * `decide`: from stored runs to a verdict for each requirement.
//! * [`manifest`], [`signature`]: SHA-256 over every file, and who signed that.
//! * [`mod@verify`]: whether a record is still what it was.
//! * [`page`]: `record.html`, for people and for paper.
//! * `durable`: files that are whole or not there, whenever the machine stops.
//!
//! Scenarios are played by `platebench-runner` and judged by `platebench-verdict`; nothing of either is repeated here. Whom to ask, and what a terminal shows, is
//! the command line's.

mod ask;
mod basis;
pub mod conduct;
mod decide;
mod durable;
mod error;
pub mod manifest;
pub mod order;
pub mod page;
pub mod plan;
mod self_test;
pub mod session;
pub mod signature;
pub mod verify;

pub use conduct::conduct;
pub use error::AcceptError;
pub use order::{Answer, Desk, Order, Question, Who};
pub use plan::Plan;
pub use session::SessionRecord;
pub use signature::{PublicKey, SecretKey};
pub use verify::{Finding, Signer, Verification, verify};
