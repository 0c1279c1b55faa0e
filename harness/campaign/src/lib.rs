//! Plays a scenario with many values: sweeps and Monte Carlo, in shards that any engine may start.
//!
//! * [`campaign`]: the campaign file. [`distribution`]: distributions of its values. [`draw`]: trial i.
//! * [`plan`]: what a campaign folder pins. [`play`]: plays a shard. [`row`], `part`: its results.
//! * [`merge()`]: joins the parts to `results`, [`summary`], `report` and `counterexample`.
//!
//! Engines of other projects start and restart shards; this crate has no scheduler and no network.

pub mod campaign;
mod counterexample;
pub mod distribution;
pub mod draw;
pub mod error;
pub mod merge;
mod part;
pub mod plan;
pub mod play;
pub mod report;
pub mod results;
pub mod row;
pub mod summary;

pub use campaign::{Campaign, RawCampaign};
pub use error::CampaignError;
pub use merge::{Status, merge, status};
pub use plan::Plan;
pub use play::{PlayConfig, TrialEvent, play_shard};
pub use summary::Summary;
