//! Simulates a plate with one or two bending modes, in the frame that rotates with the excitation.
//!
//! Symbols and equation numbers are those of Ben Messaoud et al., "Amplitude control of an
//! ultrasonic vibration for a tactile stimulator", IEEE/ASME Transactions on Mechatronics, 2016.
//! `docs/mathematics.md` derives the other equations. Amplitudes are in µm and voltages in Vpp,
//! both peak to peak. Angular frequencies are in rad/s, times in s unless a name has another unit.

#![cfg_attr(not(test), warn(clippy::disallowed_methods))]

mod crossing;
mod demodulator;
mod effect;
mod effects;
mod flow;
mod mode;
mod motion;
mod phase;
mod plant;
mod plate;
pub mod plausible;
mod profile;
mod time;
mod varying;

pub use crossing::{BandMonitor, BandSignal, Crossing};
pub use demodulator::{Demodulator, Lockin};
pub use effect::PlateError;
pub use effects::*;
pub use flow::{Flow, Model, State};
pub use mode::{ConditionProfiles, Conditions, Drive, Mode};
pub use num_complex::Complex64;
pub use phase::{Phase, PhaseRate};
pub use plant::Plant;
pub use plate::Plate;
pub use plausible::ImplausibleValue;
pub use profile::{Profile, ProfileError, RawChirp, RawProfile, RawRepeat, RawShape, RawSine, RawSquare};
pub use time::Time;
