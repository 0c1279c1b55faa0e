//! Simulates a plate with one bending mode, in the frame that rotates with the excitation.
//!
//! Symbols and equations are those of Ben Messaoud et al., "Amplitude control of an ultrasonic
//! vibration for a tactile stimulator", IEEE/ASME Transactions on Mechatronics, 2016;
//! `docs/mathematics.md` derives the others. Amplitudes are µm and voltages Vpp, both peak to peak;
//! angular frequencies are rad/s; times are s unless a name has another unit.

mod crossing;
mod demodulator;
mod flow;
pub mod input;
mod lockin;
mod mode;
mod phase;
mod plant;
mod plate;
mod plate_error;
mod profile;
mod raw_plate;
mod raw_profile;
mod sensor;
mod tier;
mod time;
mod varying;

pub use crossing::{BandMonitor, BandSignal, Crossing};
pub use demodulator::Demodulator;
pub use flow::{Flow, State};
pub use lockin::{ConverterResolution, Lockin};
pub use mode::{Conditions, Drive, Mode};
pub use num_complex::Complex64;
pub use phase::{Phase, PhaseRate};
pub use plant::{ConditionProfiles, Plant};
pub use plate::{Plate, Uncertainty};
pub use plate_error::PlateError;
pub use profile::Profile;
pub use raw_plate::{RawDrive, RawFinger, RawMode, RawPlate, RawSensor, RawUncertainty};
pub use raw_profile::{ProfileError, RawProfile, RawShape, RawSine};
pub use sensor::Sensor;
pub use tier::Tier;
pub use time::Time;
