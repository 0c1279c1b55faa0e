//! Charts of the bench itself: drawings with logarithmic axes that stand alone, and a page that holds them.
//!
//! * `loglog`: points and edges to SVG.
//! * `page`: `charts.html`, one file that needs nothing else.
//!
//! Neighbours: the command line measures and says what is drawn; nothing here knows a method or a scenario.

mod loglog;
mod page;

pub use loglog::{LogLog, Series};
pub use page::{Block, Page, Table};
