//! How often the bench itself is wrong.
//!
//! * [`middleware`]: a link around a controller that makes one mistake; in lockstep it can stand around any rig.
//! * [`mod@catalogue`]: the mistakes, each with the metrics by which it should be caught.
//! * `mistakes`: what they do to samples, commands and frames.
//! * [`mod@play`]: a scenario played and judged in memory.
//! * [`mod@measure`]: kill rate over the catalogue, false alarms over clean runs.
//! * [`report`], [`shown`]: what came of it, for machines and for people.
//!
//! A faulty controller counts as caught where an expectation on one of its own metrics fails which the same controller without the mistake does not fail; a
//! doubt catches nobody. What the numbers mean stands in `docs/trust.md`.

pub mod catalogue;
pub mod measure;
pub mod middleware;
mod mistakes;
pub mod play;
pub mod report;
pub mod shown;

pub use catalogue::{Entry, Reference, catalogue};
pub use measure::{Order, measure};
pub use middleware::{Mistake, Mistaken};
pub use play::{TrustError, play};
pub use report::Report;
