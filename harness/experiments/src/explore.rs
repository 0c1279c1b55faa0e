//! Explores an operating envelope: generates scenes, plays them, checks properties and shrinks
//! failing scenes.
//!
//! A [`scene`] is a judged trial with the trials before it. [`generator`] makes scene i from the
//! envelope, the seed and i. [`properties`] contains the demands on every scene;
//! `docs/exploration.md` derives their limits. [`exploration`] plays scenes on several workers,
//! [`guidance`] derives later scenes from those that reached something new, and [`mod@shrink`] makes
//! a failing scene minimal. [`mod@session`] does all of this and writes the minimal scenes as
//! scenarios. [`mod@kill_rate`] measures which mutants an exploration finds.

pub mod choices;
pub mod coverage;
pub mod envelope;
pub mod exploration;
pub mod generator;
pub mod guidance;
pub mod kill_rate;
mod limits;
mod messages;
mod own_law;
pub mod player;
pub mod properties;
pub mod report;
pub mod scenario_file;
pub mod scene;
pub mod sequence;
pub mod session;
pub mod shrink;
mod timeline;

pub use envelope::{Envelope, RawEnvelope};
pub use exploration::{Exploration, ExplorationBudget, ExploreConfig, explore};
pub use generator::Generator;
pub use limits::{ExploredLaw, LawProperties, OwnLaw};
pub use own_law::measure_own_law;
pub use player::{ExploreError, ScenePlayer};
pub use properties::Property;
pub use report::ExploreReport;
