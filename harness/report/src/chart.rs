//! Charts of the bench itself: drawings with logarithmic axes that stand alone, and a page that holds them.
//!
//! * `ink`: what all drawings have in common.
//! * `loglog`: lines of points on two logarithmic axes.
//! * `scatter`: points by colour and shape, with limits.
//! * `strip`: a line of marks for each of many things.
//! * `page`: `charts.html`, one file that needs nothing else.
//!
//! Neighbours: the command line measures and says what is drawn; nothing here knows a method or a scenario.

mod ink;
mod loglog;
mod page;
mod scatter;
mod strip;

pub use loglog::{LogLog, Series};
pub use page::{Block, Page, Table};
pub use scatter::{Panel, Point, Scatter};
pub use strip::{Row, Strip};
