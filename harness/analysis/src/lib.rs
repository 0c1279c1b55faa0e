//! Loops of a law and a plate in the z plane: poles, margins, and where they fail, predicted and measured.
//!
//! * [`plant`]: the plate around an operating point, as poles that are sampled exactly.
//! * [`controller`]: PI loops and how a continuous design becomes one: forward, backward, matched.
//! * [`closed_loop`]: both and the delay between them, one matrix per period; its poles.
//! * [`margins`]: gain, phase and delay margins.
//! * [`step`]: settling time, overshoot and drive of a setpoint step.
//! * [`case`]: each law of the firmware under test in that form, on a plate in its surroundings.
//! * [`measured`]: the same boundary by the firmware's own code on the exact plate.
//! * [`plain`]: PI loops without a firmware around them, where the ratio Wq/Wd shows that it is not linear.
//! * [`tuning`]: gains for a plate, what they do, what can be met.
//! * [`mod@study`]: all laws in all surroundings, as a table and as maps; [`shown`]: in words and CSV.
//!
//! Amplitudes are µm and voltages Vpp, both peak to peak; times are s, angular frequencies rad/s. Nothing here draws or touches a file.

pub mod case;
pub mod closed_loop;
pub mod controller;
pub mod margins;
pub mod measured;
pub mod plain;
pub mod plant;
pub mod shown;
pub mod step;
pub mod study;
pub mod tuning;

pub use case::{Case, Condition};
pub use closed_loop::{AnalysisError, ClosedLoop, Timing};
pub use controller::{Channel, Controller, Integral, Pi};
pub use margins::{DelayBoundary, Margins, delay_boundary};
pub use measured::{Bench, Motion};
pub use plain::{Found, PlainLoops};
pub use plant::{Plant, Pole};
pub use step::StepResponse;
pub use study::{Map, Order, Row, Study, study};
