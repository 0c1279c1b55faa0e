//! What mistakes do at the line.
//!
//! * [`values`]: numbers that are wrong, without a memory.
//! * [`timing`]: right numbers at the wrong time.
//! * [`excitation`]: what goes wrong between a frequency that was meant and one that acts.
//! * [`line`]: frames that are taken for what they are not.
//! * [`loops`]: a control law written by hand, with one line missing.

pub(crate) mod excitation;
pub(crate) mod line;
pub(crate) mod loops;
pub(crate) mod timing;
pub(crate) mod values;
