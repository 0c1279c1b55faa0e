//! The plant: a plate with one bending mode, seen in the frame that rotates with the excitation.
//!
//! * [`tier`]: how much of the plate is modelled.
//! * [`time`]: instants in whole nanoseconds since the start of a trial.
//! * [`mod@file`]: the plate file, read once and checked once.
//! * [`profile`]: setpoint, temperature offset and finger force over time.
//! * [`mode`]: what a finger and a temperature make of the mode's damping and resonance.
//! * [`input`]: files that people hand in.
//! * [`flow`]: exact propagation between two events, per tier.
//! * `varying`: propagation while the mode moves.
//! * [`crossing`]: entering and leaving bands.
//! * [`plant`]: a plate playing its profiles: events in, state out.
//! * [`phase`]: the carrier's phase.
//! * [`demodulator`]: the sensor's converter and lock-in demodulator.
//! * [`batch`]: many envelopes at once.
//! * [`sensor`]: what the controller gets to see.
//! * [`bound`]: how far a tier can be from the exact plate, before anything is played.
//!
//! Symbols and equations are those of Ben Messaoud et al., "Amplitude control of an ultrasonic vibration for a tactile
//! stimulator", IEEE/ASME Transactions on Mechatronics, 2016; derivations stand in `docs/mathematics.md`. Amplitudes are µm and
//! voltages Vpp, both peak to peak; angular frequencies are rad/s; times are s unless a name says otherwise.
//!
//! The plate knows no wall clock, no controller and no file of a run.

pub mod batch;
pub mod bound;
pub mod crossing;
pub mod demodulator;
pub mod file;
pub mod flow;
pub mod input;
pub mod mode;
pub mod phase;
pub mod plant;
pub mod profile;
pub mod sensor;
pub mod tier;
pub mod time;
mod varying;

pub use batch::Envelopes;
pub use bound::Beforehand;
pub use crossing::{Crossing, Watch};
pub use demodulator::{Demodulator, Lockin, Resolution};
pub use file::{Plate, PlateError, Uncertainty};
pub use flow::{Flow, State};
pub use mode::{Conditions, Drive, Mode};
pub use num_complex::Complex64;
pub use phase::{Phase, Rate};
pub use plant::{Plant, Scene};
pub use profile::{Profile, ProfileError};
pub use sensor::Sensor;
pub use tier::Tier;
pub use time::Time;
