//! Plays one scenario with many values (sweep, Monte Carlo, search) and judges the share of failing
//! trials.
//!
//! A [campaign](definition) file names the scenario, its varied values and the number of trials.
//! [`draw`] computes the values of trial i. A [`plan`] divides the trials into shards, which
//! several machines can play. Each shard writes its results to a file, the part, and [`merge()`]
//! joins the parts. With the methods `search` and `rare`, trials form chains, in which a trial
//! depends on earlier results. This module has no job scheduler and no network; see [`submit`].

mod chain;
pub mod confirm;
mod correlation;
pub mod definition;
pub mod distribution;
pub mod draw;
pub mod error;
mod evolution;
mod first_order;
pub mod lock;
mod maps;
pub mod merge;
pub mod outcome;
mod part;
pub mod plan;
pub mod play;
pub mod rare;
pub mod report;
pub mod results;
pub mod row;
pub mod sample;
mod scenario_files;
mod search;
pub mod sequential;
mod shard_end;
pub mod submit;
pub mod summary;
pub mod tally;
pub mod variable;
pub mod worst_run;

pub use confirm::{Agreement, confirm};
pub use definition::{Campaign, RawCampaign};
pub use error::CampaignError;
pub use lock::{ShardLock, lock_folder};
pub use merge::{Status, merge, status};
pub use plan::{Plan, shards_of_run};
pub use play::{PlayConfig, TrialEvent, play_shard};
pub use shard_end::ShardEnd;
pub use summary::Summary;
pub use worst_run::{ResponseLinks, play_worst, worst_trials};
