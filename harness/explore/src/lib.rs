//! Explores an operating envelope: generates scenes, plays them, checks properties, shrinks what fails.
//!
//! * [`mod@envelope`]: the ranges from which scenes are drawn.
//! * `draw`, `event_kind`, `stratum`, `course`: numbers of a scene. [`generator`]: scene i from envelope, seed and i.
//! * [`mod@tuning`], [`line_fault`]: settings of the law and faults of the line in a scene.
//! * [`scene`]: a scene. [`scenario_file`]: the same as scenario file.
//! * `windows`, `limits`, [`law_properties`], [`properties`]: what every scene must meet.
//! * [`player`]: plays and judges a scene. [`mod@explore`]: plays many on several workers.
//! * [`mod@shrink`]: makes a failing scene minimal. [`regression`]: writes it as a scenario.
//! * [`mod@session`]: all of this. [`coverage`], [`report`], [`text`], [`mod@page`]: the result.
//!
//! [`mod@kill_rate`] measures the exploration with mutants and correct variants.
//!
//! `docs/exploration.md` derives the limits.

mod course;
pub mod coverage;
mod draw;
pub mod envelope;
pub mod error;
mod event_kind;
pub mod explore;
pub mod generator;
pub mod kill_rate;
pub mod law_properties;
mod limits;
pub mod line_fault;
pub mod page;
pub mod player;
pub mod properties;
pub mod regression;
pub mod report;
pub mod scenario_file;
pub mod scene;
pub mod session;
pub mod shrink;
mod staging;
mod stratum;
pub mod text;
pub mod tuning;
mod windows;

pub use envelope::{Envelope, RawEnvelope};
pub use error::ExploreError;
pub use explore::{Budget, Exploration, ExploreConfig, explore};
pub use generator::Generator;
pub use law_properties::LawProperties;
pub use player::Player;
pub use properties::Property;
pub use report::ExploreReport;
