//! Analyses the loop of a law and a plate in the z plane: poles, margins, predicted and measured
//! boundaries.
//!
//! * [`plant`]: the plate around an operating point, as exactly sampled poles.
//! * [`controller`]: PI loops, and the readings of equation 24: forward, backward, matched.
//! * [`closed_loop`]: plant, controller and delay as one matrix per period; its poles.
//! * [`margins`]: gain, phase and delay margins.
//! * [`step_response`]: settling time, overshoot and drive of a setpoint step.
//! * [`case`]: each law of the firmware in this form, on a plate under given conditions.
//! * [`measured_boundary`]: the delay boundary of the firmware's code on the exact plate.
//! * [`plain_loops`]: PI loops without a firmware; shows that the ratio Wq/Wd is not linear.
//! * [`tuning`]: gains for a plate, their behaviour, feasibility of a target.
//! * [`mod@study`]: all laws under all conditions, as a table and as maps; [`table`]: text and CSV.
//!
//! Amplitudes are µm and voltages Vpp, both peak to peak; times are s, angular frequencies rad/s.
//! Drawings and files do not belong here.

pub mod case;
pub mod closed_loop;
pub mod controller;
pub mod margins;
pub mod measured_boundary;
pub mod plain_loops;
pub mod plant;
pub mod step_response;
pub mod study;
pub mod table;
pub mod tuning;

pub use case::{LoopCase, OperatingCondition};
pub use closed_loop::{AnalysisError, ClosedLoop, LoopTiming};
pub use controller::{LinearController, LoopChannel, PiGains, Reading};
pub use margins::{StabilityMargins, delay_boundary};
pub use measured_boundary::{LoopMotion, LoopSimulation};
pub use plain_loops::{PlainLoops, StartResult};
pub use plant::{LinearPlant, Pole};
pub use step_response::StepResponse;
pub use study::{StabilityMap, Study, StudyConfig, StudyRow, study};
