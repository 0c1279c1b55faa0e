//! Analyses the loop of a law and a plate in the z plane: poles, margins and boundaries.
//! Amplitudes are in µm and voltages in Vpp, both peak to peak. Times are in s, angular frequencies
//! in rad/s.

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

pub use case::{LoopCase, OperatingCondition};
pub use closed_loop::{AnalysisError, ClosedLoop, LoopTiming};
pub use controller::{Discretisation, LinearController, LoopChannel, PiGains};
pub use margins::{StabilityMargins, delay_boundary};
pub use measured_boundary::{LoopMotion, LoopSimulation};
pub use plain_loops::{PlainLoops, StartResult};
pub use plant::{LinearPlant, Pole};
pub use step_response::StepResponse;
pub use study::{StabilityMap, Study, StudyConfig, StudyRow, study};
