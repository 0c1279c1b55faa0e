//! Explores an operating envelope: generates scenes, plays them, checks properties and shrinks
//! failing scenes.
//!
//! A [`scene`] is a judged trial with the trials before it. [`generator`] makes scene i from the
//! envelope, the seed and i. [`properties`] contains the demands on every scene;
//! `docs/exploration.md` derives their limits. [`exploration`] plays scenes on several workers,
//! [`mod@shrink`] makes a failing scene minimal, and [`regression`] writes it as a scenario.
//! [`mod@session`] does all of this. [`mod@kill_rate`] measures which mutants an exploration finds.

mod course;
pub mod coverage;
mod draw;
pub mod envelope;
pub mod error;
mod event_kind;
pub mod exploration;
pub mod generator;
pub mod kill_rate;
pub mod law_properties;
mod limits;
pub mod line_fault;
pub mod player;
pub mod properties;
pub mod regression;
pub mod report;
pub mod scenario_file;
pub mod scene;
pub mod session;
pub mod shrink;
mod stratum;
pub mod tuning;
mod windows;

pub use envelope::{Envelope, RawEnvelope};
pub use error::ExploreError;
pub use exploration::{Budget, Exploration, ExploreConfig, explore};
pub use generator::Generator;
pub use law_properties::LawProperties;
pub use player::Player;
pub use properties::Property;
pub use report::ExploreReport;
