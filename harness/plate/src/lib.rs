//! Simulates a plate with one or two bending modes, in the frame that rotates with the excitation.
//!
//! Symbols and equation numbers are those of Ben Messaoud et al., "Amplitude control of an
//! ultrasonic vibration for a tactile stimulator", IEEE/ASME Transactions on Mechatronics, 2016.
//! `docs/mathematics.md` derives the other equations. Amplitudes are in µm and voltages in Vpp,
//! both peak to peak. Angular frequencies are in rad/s, times in s unless a name has another unit.

mod amplifier;
mod crossing;
mod demodulator;
mod effects;
mod flow;
mod forced_flow;
mod heating;
pub mod input;
mod lockin;
mod mode;
mod motion;
mod phase;
mod plant;
mod plant_effects;
mod plate;
mod plate_error;
pub mod plausible;
mod profile;
mod raw_plate;
mod raw_profile;
mod second_mode;
mod sensor;
mod tier;
mod time;
mod varying;

pub use amplifier::{Amplifier, DriveConverter};
pub use crossing::{BandMonitor, BandSignal, Crossing};
pub use demodulator::Demodulator;
pub use flow::{Flow, State};
pub use heating::Heating;
pub use lockin::{ConverterResolution, Lockin};
pub use mode::{Conditions, Drive, Mode};
pub use num_complex::Complex64;
pub use phase::{Phase, PhaseRate};
pub use plant::{ConditionProfiles, Plant};
pub use plate::{Plate, Uncertainty};
pub use plate_error::PlateError;
pub use plausible::ImplausibleValue;
pub use profile::Profile;
pub use raw_plate::{RawDrive, RawFinger, RawHeating, RawMode, RawPlate, RawSecondMode, RawSensor, RawUncertainty};
pub use raw_profile::{ProfileError, RawProfile, RawShape, RawSine};
pub use second_mode::SecondMode;
pub use sensor::Sensor;
pub use tier::Tier;
pub use time::Time;
