//! Plays a scenario with many values: sweeps and Monte Carlo, in shards that any engine may start.
//!
//! * [`campaign`]: the campaign file. [`distribution`]: distributions of its values. [`draw`]: trial i.
//! * `chain`: trials that depend on the ones before: `search` and `rare`. `correlation`: correlated normals.
//! * [`outcome`]: what chains found.
//! * [`sample`]: quantiles and sensitivities. [`sequential`]: decisions before the last trial.
//! * [`confirm`](mod@confirm): replays some trials on the emulated firmware.
//! * [`submit`]: commands of engines for many machines.
//! * [`plan`]: what a campaign folder pins. [`play`]: plays a shard. [`row`], `part`: its results.
//! * [`merge()`]: joins the parts to `results`, [`summary`] and counterexamples (`scenario_files`).
//! * [`worst_run`]: plays the worst trials again for their responses. [`report`]: page with `maps`.
//!
//! Engines of other projects start and restart shards; this crate has no scheduler and no network.

pub mod campaign;
mod chain;
pub mod confirm;
mod correlation;
pub mod distribution;
pub mod draw;
pub mod error;
mod evolution;
mod first_order;
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
pub mod submit;
pub mod summary;
pub mod tally;
pub mod variable;
pub mod worst_run;

pub use campaign::{Campaign, RawCampaign};
pub use confirm::{Agreement, confirm};
pub use error::CampaignError;
pub use merge::{Status, merge, status};
pub use plan::{Plan, shards_of_run};
pub use play::{PlayConfig, TrialEvent, play_shard};
pub use summary::Summary;
pub use worst_run::{ResponseLinks, play_worst, plays_worst, worst_trials};
